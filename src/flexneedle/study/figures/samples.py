"""True errors of insertions, as the figures of their distributions take them."""

from dataclasses import dataclass

import numpy as np

from flexneedle.figures.layout import Floats, Look

LEAST = 1e-3  # mm; smaller errors are drawn here


@dataclass(frozen=True, eq=False)
class Sample:
    """True errors (k,) (mm) of the finished ones among `count` insertions."""

    name: str
    look: Look
    errors: Floats
    count: int

    @property
    def drawn(self) -> Floats:
        """The errors (k,) where a logarithmic scale shows them."""
        return np.maximum(self.errors, LEAST)

    @property
    def missing(self) -> int:
        """How many insertions did not finish."""
        return self.count - len(self.errors)
