"""Structural differences between phantom and scenario, as set by `[phantom.structure]`."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.ogden import Ogden

_THINNEST_MM = 1e-3  # least thickness of a piece of a layer


def guide_to_skin(scenario: Scenario) -> float | None:
    """Return the distance (mm) of the phantom's guide from the skin, or None without a guide."""
    guide = scenario.setup.guide_to_skin_mm
    return None if guide is None else guide - scenario.phantom.structure.guide_shift_mm


def structure_values(scenario: Scenario) -> dict[str, Any]:
    """Return α, compression lengths, bevel length and guide of the phantom, by dotted key.

    They replace `phantom.structure`, which is empty in a true scenario.
    """
    structure = scenario.phantom.structure
    values: dict[str, Any] = {
        "phantom.structure": {},
        "needle.bevel.length_mm": structure.bevel_length_factor * scenario.needle.bevel.length_mm,
        "setup.guide_to_skin_mm": guide_to_skin(scenario),
    }
    for k, layer in enumerate(scenario.tissue):
        length = structure.compression_length_factor * layer.compression_length_mm
        values[f"tissue.{k}.compression_length_mm"] = length
        if structure.alpha is not None and isinstance(layer, Ogden):
            values[f"tissue.{k}.alpha"] = structure.alpha
    return values


def with_hidden_layer(truth: Scenario, scenario: Scenario) -> Scenario:
    """Return the true scenario with the hidden layer of the scenario, if any; layers that it intersects are split."""
    hidden = scenario.phantom.structure.hidden_layer
    if hidden is None:
        return truth
    top, bottom = hidden.top_mm, hidden.top_mm + hidden.thickness_mm
    pieces: list[dict[str, Any]] = []
    for layer, (first, last) in zip(truth.values()["tissue"], _extents(truth), strict=True):
        for start, end in pairwise(_edges(first, last, (top, bottom))):
            inside = top <= 0.5 * (start + end) < bottom
            modulus = layer["shear_modulus_kpa"] * (hidden.modulus_factor if inside else 1.0)
            pieces.append({**layer, "shear_modulus_kpa": modulus, "thickness_mm": end - start})
    pieces[-1].pop("thickness_mm")
    return truth.with_values({"tissue": pieces})


def _extents(scenario: Scenario) -> Iterator[tuple[float, float]]:
    """Return the first and last depth (mm) of each layer; the last layer is unbounded."""
    return pairwise((*scenario.layer_tops, math.inf))


def _edges(first: float, last: float, cuts: tuple[float, ...]) -> list[float]:
    """Return the depths (mm) at which a layer begins, is split, and ends."""
    return [first, *(cut for cut in cuts if first + _THINNEST_MM < cut < last - _THINNEST_MM), last]
