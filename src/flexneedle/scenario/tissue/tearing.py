"""Tissue that tears: the Ogden law up to a displacement, from which the force of the channel saturates."""

from typing import Annotated, Literal

from pydantic import Field

from flexneedle.scenario.sections.fields import Positive
from flexneedle.scenario.tissue.ogden import OneTermOgden
from flexneedle.scenario.tissue.torn import TornLaw


class Tearing(OneTermOgden):
    """A layer with the one-term Ogden law, whose channel tears; the bevel's spring has the intact law."""

    law: Literal["tearing"]
    """Law of radial compression."""
    yield_mm: Annotated[Positive, Field(examples=[0.5])]
    """Lateral displacement from which tissue with `law = "tearing"` tears: the force saturates."""

    @property
    def channel(self) -> TornLaw:
        """The law along the channel."""
        return TornLaw(self, self.yield_mm / self.compression_length_mm)
