"""Layers of tissue along the insertion from a label map, and how far they are from flat and parallel."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.images.label_map import Segment
from flexneedle.lab.images.sampling import Sampler, disc, fit_plane, rays
from flexneedle.types import Floats

_STEP_MM, _BESIDE_MM = 0.2, 3.0
_THINNEST_MM = 1.0


@dataclass(frozen=True, eq=False)
class Run:
    """A layer on the axis: which of the choices, its top and end (mm)."""

    choice: int
    top: float
    end: float


@dataclass(frozen=True, eq=False)
class Boundary:
    """The lower end of a layer on lines around the axis.

    share: of the lines on which it is found; tilt: angle (rad) of its normal to the insertion; least, most: thickness
    (mm) of the layer above it.
    """

    run: Run
    share: float
    tilt: float
    least: float
    most: float


@dataclass(frozen=True, eq=False)
class Layers:
    """Layers from the skin down; gaps, by top and end, and thin layers that were ignored on the axis."""

    runs: tuple[Run, ...]
    boundaries: tuple[Boundary, ...]
    gaps: tuple[tuple[float, float], ...]
    thin: tuple[Run, ...]


def find_layers(
    sampler: Sampler, groups: list[list[Segment]], depth: float, deepest: float, radius: float
) -> Layers:
    """Return the layers on the axis down to a depth `deepest`, gaps down to `depth`, and boundaries within a radius.

    A gap, or a layer thinner than 1 mm, is part of the layer above it; gaps of less than 1 mm are not reported. groups:
    segments of each choice. Depths in mm. There is no layer if none of the groups is on the axis.
    """
    depths = np.arange(0.5 * _STEP_MM, deepest, _STEP_MM)
    found = sampler.which(groups, rays(np.zeros((1, 2)), depths))[0]
    pieces = [Run(choice, top, end) for choice, top, end in _pieces(found)]
    open_ones = [(each.top, min(each.end, depth)) for each in pieces if each.choice < 0]
    gaps = tuple((top, end) for top, end in open_ones if end - top >= _THINNEST_MM)
    layers = [each for each in pieces if each.choice >= 0]
    thin = tuple(each for each in layers if each.end - each.top < _THINNEST_MM and each.top < depth)
    runs = _join([each for each in layers if each.end - each.top >= _THINNEST_MM])
    above = [each for each in runs if each.end < min(depth, deepest - _STEP_MM)]
    boundaries = tuple(_boundaries(sampler, groups, above, deepest, radius))
    return Layers(tuple(runs), boundaries, gaps, thin)


def _pieces(found: NDArray[np.int64]) -> list[tuple[int, float, float]]:
    """Return value, top and end (mm) of each stretch of equal values."""
    ends = np.flatnonzero(np.diff(found)) + 1
    bounds = [0, *ends.tolist(), len(found)]
    return [(int(found[low]), _STEP_MM * low, _STEP_MM * high) for low, high in pairwise(bounds)]


def _join(layers: list[Run]) -> list[Run]:
    """Return layers without gaps, from 0 on, those joined that follow each other and are of one choice."""
    joined: list[Run] = []
    for each in layers:
        top = joined[-1].top if joined and joined[-1].choice == each.choice else each.top
        if joined and joined[-1].choice == each.choice:
            joined.pop()
        joined.append(Run(each.choice, top, each.end))
    tops = [0.0, *(each.top for each in joined[1:])]
    ends = [*tops[1:], joined[-1].end if joined else 0.0]
    return [Run(each.choice, top, end) for each, top, end in zip(joined, tops, ends, strict=False)]


def _boundaries(
    sampler: Sampler, groups: list[list[Segment]], runs: list[Run], deepest: float, radius: float
) -> list[Boundary]:
    """Return the lower ends of layers on lines around the axis: the deepest point of the layer's segments near it."""
    across = disc(radius, _BESIDE_MM)
    depths = np.arange(-0.5 * radius, deepest, 2.0 * _STEP_MM)
    found = sampler.which(groups, rays(across, depths))
    made = []
    tops = _skin(found, depths)
    for each in runs:
        ends = _ends(found == each.choice, depths, each)
        known = np.isfinite(ends)
        if known.sum() < 3:
            made.append(Boundary(each, float(known.mean()), math.nan, math.nan, math.nan))
            continue
        plane, _ = fit_plane(across[known], ends[known])
        thickness = (ends - tops)[known & np.isfinite(tops)]
        made.append(
            Boundary(
                each,
                float(known.mean()),
                math.atan(math.hypot(plane[1], plane[2])),
                float(thickness.min(initial=math.inf)),
                float(thickness.max(initial=-math.inf)),
            )
        )
        tops = ends
    return made


def _skin(found: NDArray[np.int64], depths: Floats) -> Floats:
    """Return the depth at which each line enters the first segment, NaN if it does not."""
    inside = found >= 0
    return np.where(inside.any(axis=1), depths[inside.argmax(axis=1)], np.nan)


def _ends(inside: NDArray[np.bool_], depths: Floats, run: Run) -> Floats:
    """Return the end (n,) of a layer on each line: of its stretch that begins above the middle of the run; or NaN."""
    ends = np.full(len(inside), np.nan)
    for number, line in enumerate(inside):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        stretches = [(depths[a], depths[b - 1] + 2.0 * _STEP_MM) for a, b in edges.reshape(-1, 2)]
        near = [each for each in stretches if each[0] <= run.end and each[1] >= run.top]
        if near:
            ends[number] = max(near, key=lambda each: min(each[1], run.end) - max(each[0], run.top))[1]
    return ends
