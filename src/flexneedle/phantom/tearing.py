"""Tissue that tears: laws of the channel whose force saturates beyond a lateral displacement (docs/theory.md, 11).

Tearing is without memory: a displacement always has the same force. The bevel's spring keeps the law of the tissue:
its offset is a measure of the force on the tip, not a displacement of tissue.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexneedle.mechanics.law import Floats, Law, tables
from flexneedle.mechanics.model import CONTACT, Model
from flexneedle.scenario.tissue.layer import Layer, laws_of

_LENGTH = 0.5  # over which the stiffness falls by 1/e, as a share of the displacement at which tearing begins
_RESIDUAL = 0.02  # share of the stiffness that is left; above 0, so that the energy remains convex
# Displacements at which tearing begins, up to which the law is tabled: e^(−8) of the fall is left.
_TABLED = 5.0


@dataclass(frozen=True)
class TornLaw:
    """The law of a layer up to the relative compression `start`; from there on its stiffness falls exponentially."""

    layer: Layer
    start: float

    @property
    def limit(self) -> float:
        """Relative compression e from which the force continues linearly."""
        return min(self.layer.limit, _TABLED * self.start)

    def energy(self, e: Floats) -> Floats:
        """Return the energy at relative compressions e, over k h²."""
        inside, beyond, left, fall = self._split(e)
        length = _LENGTH * self.start
        straight = (self.layer.force(inside) + 0.5 * left * beyond) * beyond
        return (
            self.layer.energy(inside) + straight + fall * length * (beyond - length * _rise(beyond, length))
        )

    def force(self, e: Floats) -> Floats:
        """Return the force, over k h."""
        inside, beyond, left, fall = self._split(e)
        length = _LENGTH * self.start
        return self.layer.force(inside) + left * beyond + fall * length * _rise(beyond, length)

    def stiffness(self, e: Floats) -> Floats:
        """Return the stiffness, over k."""
        inside, beyond, left, fall = self._split(e)
        torn = left + fall * (1.0 - _rise(beyond, _LENGTH * self.start))
        return np.where(beyond > 0.0, torn, self.layer.stiffness(inside))

    def _split(self, e: Floats) -> tuple[Floats, Floats, float, float]:
        """Return e within the intact law and beyond it, and the stiffness that is left, and that falls, beyond it."""
        inside = np.minimum(e, self.start)
        stiffness = float(self.layer.stiffness(np.array([min(self.start, self.layer.limit)]))[0])
        return inside, e - inside, _RESIDUAL * stiffness, (1.0 - _RESIDUAL) * stiffness


def _rise(beyond: Floats, length: float) -> Floats:
    return -np.expm1(-beyond / length)


def channel_laws(tissue: Sequence[Layer], yield_mm: float | None) -> tuple[Sequence[Law], Sequence[int]]:
    """Return the laws along the channel, and for each layer the index of its law."""
    if yield_mm is None:
        return laws_of(tissue)
    return [TornLaw(layer, yield_mm / layer.compression_length_mm) for layer in tissue], range(len(tissue))


def tear(model: Model, tissue: Sequence[Layer], yield_mm: float) -> Model:
    """Return the model of a tissue with torn laws at its contact points; its tip spring has the intact ones."""
    laws, place = channel_laws(tissue, yield_mm)
    nodes = model.nodes.copy()
    contact = nodes["kind"] == CONTACT
    layer = model.layers["end"].searchsorted(nodes["x"][contact], side="right")
    nodes["law"][contact] = len(model.laws) + np.array(place)[layer]
    return model._replace(nodes=nodes, laws=np.concatenate([model.laws, tables(laws)]))
