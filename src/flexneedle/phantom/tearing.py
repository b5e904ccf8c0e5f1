"""Tissue that tears in the phantom alone: laws of the channel (docs/theory.md, 11).

The bevel's spring keeps the law of the tissue: its offset is a measure of the force on the tip, not a displacement of
tissue.
"""

from collections.abc import Sequence

from flexneedle.mechanics.law import tables
from flexneedle.mechanics.model import Model, with_channel_laws
from flexneedle.scenario.tissue.layer import Layer, all_laws
from flexneedle.scenario.tissue.torn import TornLaw
from flexneedle.types import Law


def channel_laws(tissue: Sequence[Layer], yield_mm: float | None) -> tuple[Sequence[Law], Sequence[int]]:
    """Return the laws along the channel, and for each layer the index of its law.

    yield_mm: displacement from which all layers tear; None: as in the scenario.
    """
    if yield_mm is None:
        laws, _, place = all_laws(tissue)
        return laws, place
    return [TornLaw(layer, yield_mm / layer.compression_length_mm) for layer in tissue], range(len(tissue))


def tear(model: Model, tissue: Sequence[Layer], yield_mm: float) -> Model:
    """Return the model of a tissue with torn laws at its contact points; its tip spring has the intact ones."""
    laws, place = channel_laws(tissue, yield_mm)
    return with_channel_laws(model, tables(laws), place)
