"""The law of a channel that tears beyond a displacement, where its force saturates (docs/theory.md, 2)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flexneedle.scenario.tissue.layer import Layer

if TYPE_CHECKING:
    from flexneedle.scenario.tissue.layer import Floats

_LENGTH = 0.5  # over which the stiffness falls by 1/e, as a share of the displacement at which tearing begins
_RESIDUAL = 0.02  # share of the stiffness that is left; above 0, so that the energy remains convex
# Displacements at which tearing begins, up to which the law is tabled: e^(−8) of the fall is left.
_TABLED = 5.0


@dataclass(frozen=True)
class TornLaw:
    """The law of a layer up to the relative compression `start`; from there on its stiffness falls exponentially.

    Tearing is without memory: a displacement always has the same force.
    """

    layer: Layer
    start: float

    @property
    def limit(self) -> float:
        """Relative compression e from which the force continues linearly."""
        return min(self.layer.limit, _TABLED * self.start)

    def energy(self, e: "Floats") -> "Floats":
        """Return the energy at relative compressions e, over k h²."""
        inside, beyond, left, fall = self._split(e)
        length = _LENGTH * self.start
        straight = (self.layer.force(inside) + 0.5 * left * beyond) * beyond
        return (
            self.layer.energy(inside) + straight + fall * length * (beyond - length * _rise(beyond, length))
        )

    def force(self, e: "Floats") -> "Floats":
        """Return the force, over k h."""
        inside, beyond, left, fall = self._split(e)
        length = _LENGTH * self.start
        return self.layer.force(inside) + left * beyond + fall * length * _rise(beyond, length)

    def stiffness(self, e: "Floats") -> "Floats":
        """Return the stiffness, over k."""
        inside, beyond, left, fall = self._split(e)
        torn = left + fall * (1.0 - _rise(beyond, _LENGTH * self.start))
        return np.where(beyond > 0.0, torn, self.layer.stiffness(inside))

    def _split(self, e: "Floats") -> tuple["Floats", "Floats", float, float]:
        """Return e within the intact law and beyond it, and the stiffness that is left, and that falls, beyond it."""
        inside = np.minimum(e, self.start)
        stiffness = float(self.layer.stiffness(np.array([min(self.start, self.layer.limit)]))[0])
        return inside, e - inside, _RESIDUAL * stiffness, (1.0 - _RESIDUAL) * stiffness


def _rise(beyond: "Floats", length: float) -> "Floats":
    rise: Floats = -np.expm1(-beyond / length)
    return rise
