"""Distances of a state beyond the limits of needle and tissue: section `guard` of the scenario (decision 0021)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import all_laws
from flexneedle.simulator.state import State
from flexneedle.types import Floats

_SHARE_OF_LAW = 0.95  # of the compression at which a law ends


@dataclass(frozen=True)
class Excess:
    """Distance of a load beyond its limit, negative within it.

    share: the load over its limit; text: both values; key: of the limit in the section `guard`.
    """

    beyond: float
    text: str
    share: float = 0.0
    key: str = ""


@dataclass(frozen=True, eq=False)
class LoadLimits:
    """Largest compression e of the tissue by law (l,), strain of the needle by bending, force of the guide (N)."""

    compression: Floats
    strain: float
    force: float

    @staticmethod
    def of(scenario: Scenario) -> "LoadLimits":
        """Return the limits of a scenario."""
        settings, (laws, place, channel) = scenario.guard, all_laws(scenario.tissue)
        least = settings.least_stretch
        compression = np.array([_SHARE_OF_LAW * law.limit if least is None else 1.0 - least for law in laws])
        compression[channel] = compression[place]  # tissue that tears may be compressed as if it were intact
        force = math.inf if settings.guide_force_n is None else settings.guide_force_n
        return LoadLimits(compression, 1e-2 * settings.needle_strain_percent, force)

    @property
    def values(self) -> dict[str, float]:
        """The limits by name, the smallest compression of all laws."""
        return {"strain": self.strain, "compression": float(self.compression.min()), "force": self.force}

    def excesses(self, state: State) -> Iterator[Excess]:
        """Yield the excess of tissue, needle and guide."""
        yield self._compression_excess(state)
        strain = bending_strain(state)
        text = f"needle strain {1e2 * strain:.3f} % > {1e2 * self.strain:g} %"
        yield Excess(strain - self.strain, text, strain / self.strain, "needle_strain_percent")
        force = math.hypot(*state.reactions.guide_force)
        text = f"guide force {force:.3g} N > {self.force:.3g} N"
        yield Excess(force - self.force, text, force / self.force, "guide_force_n")

    def _compression_excess(self, state: State) -> Excess:
        """Return the excess of the contact that is farthest beyond the limit of its law."""
        contacts = state.contacts
        if not contacts.active.any():
            return Excess(-math.inf, "")
        stretch, least = contacts.stretch, 1.0 - self.compression[contacts.law]
        worst = int((least - stretch).argmax())
        text = f"tissue stretch {stretch[worst]:.3f} < {least[worst]:.3f}"
        share = (1.0 - stretch[worst]) / (1.0 - least[worst])
        return Excess(float(least[worst] - stretch[worst]), text, float(share), "least_stretch")


NO_LIMITS = LoadLimits(np.array([1.0]), math.inf, math.inf)


def bending_strain(state: State) -> float:
    """Return the largest strain M d/2EI of the needle's surface by bending.

    Moments are largest where a force acts.
    """
    needle = state.scenario.needle
    moments = np.append(np.abs(state.mesh["moment"]), math.hypot(*state.reactions.base_moment))
    return float(moments.max() * needle.outer_diameter / (2.0 * needle.bending_stiffness))
