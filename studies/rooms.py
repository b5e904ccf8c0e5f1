"""Random rooms: worlds with zones to avoid, in the plane and in space.

A room has 1 to 6 zones about the line from the entry to the target: spheres, capsules, boxes, curved vessels and walls
with a gap. None encloses the target or, with its margin, the fixed entry.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.worlds import PLANE, WIDE, has_rig, world
from flexneedle.simulator.zones import ZoneMap, zones_of

_RIGS = ("two-axes", "one-axis", "no-guide", "two-axes-half-turns")
_FREE = {"entry.free_radius_mm": 15.0, "entry.free_slope_mrad": 200.0}
_ROOM_MM = 0.5  # of the target beyond the margin
_TRIES = 200
_Make = Callable[[Any], list[dict[str, Any]]]


def room(number: int, *, free: bool, space: bool, case: str = "real") -> Scenario:
    """Return the room of a number, with a free or a fixed entry."""
    base = world(number, case, PLANE, WIDE)
    rng = np.random.default_rng([20261129, number])
    if space:
        rigs = [rig for rig in _RIGS if has_rig(base, rig)]
        base = world(number, case, rigs[int(rng.integers(len(rigs)))], WIDE)
    zones: list[dict[str, Any]] = []
    wanted = int(rng.integers(1, 7))
    for _ in range(_TRIES):
        if len(zones) >= wanted:
            break
        made = _draw(rng, base, space)
        if _is_clear_of_ends(base, made):
            zones += made
    named = [{"name": f"{zone['shape']} {k + 1}", **zone} for k, zone in enumerate(zones)]
    return base.with_values({"zone": named, **(_FREE if free else {})})


def _is_clear_of_ends(base: Scenario, zones: list[dict[str, Any]]) -> bool:
    """Return whether target and entry keep the margin from zones."""
    entry = base.entry.lateral(1e-3)
    points = np.array([base.target.position, (1e-3, entry.real, entry.imag)])
    found = _map(base, zones)
    return bool(found.clearances(points).min() >= found.margin + _ROOM_MM)


def _map(base: Scenario, zones: list[dict[str, Any]]) -> ZoneMap:
    return zones_of(base.with_values({"zone": [{"name": "zone", **zone} for zone in zones]}))


def _draw(rng: np.random.Generator, base: Scenario, space: bool) -> list[dict[str, Any]]:
    """Return the tables of a sphere, a capsule, a box, a vessel or a wall beside the line to the target.

    The surface is on the line at a random depth, or up to 4 mm beyond it, or up to 3 mm before it; a wall's gap may be
    anywhere.
    """
    depth, *ends = base.target.position
    line = np.linspace(0.0, 1.0, 60)[1:, None] * [depth, *ends]
    x = depth * rng.uniform(0.15, 0.95)
    at = np.array([x, *(np.array(ends) * x / depth)])
    kind = rng.choice(["sphere", "capsule", "box", "vessel", "wall"])
    if kind == "wall":
        return _wall(rng, at, space)
    angle = rng.uniform(0.0, 2.0 * math.pi) if space else math.pi * rng.integers(2)
    away = np.array([0.0, math.cos(angle), math.sin(angle) if space else 0.0])
    make, wanted = _SHAPES[kind](rng, space), rng.uniform(-4.0, 3.0)
    for off in np.arange(0.0, 20.0, 0.5):
        made = make(at + off * away)
        if _map(base, made).clearances(line).min() >= wanted:
            return made
    return made


def _sphere(rng: np.random.Generator, _space: bool) -> _Make:
    radius = float(rng.uniform(1.5, 6.0))
    return lambda at: [{"shape": "sphere", "center_mm": at.tolist(), "radius_mm": radius}]


def _capsule_at(rng: np.random.Generator, space: bool) -> _Make:
    half, radius = rng.uniform(3.0, 20.0) * _direction(rng, space), rng.uniform(1.0, 4.0)
    return lambda at: [_capsule(at - half, at + half, radius)]


def _box(rng: np.random.Generator, space: bool) -> _Make:
    size, angle = rng.uniform(2.0, 12.0, 3).tolist(), rng.uniform(0.0, math.pi)
    turn = rng.normal(size=4) if space else np.array([math.cos(angle), 0.0, 0.0, math.sin(angle)])
    rotation = (turn / np.linalg.norm(turn)).tolist()
    return lambda at: [{"shape": "box", "center_mm": at.tolist(), "size_mm": size, "rotation": rotation}]


def _direction(rng: np.random.Generator, space: bool) -> Any:
    vector = rng.normal(size=3)
    vector[0] *= 0.4  # rather across the needle
    if not space:
        vector[2] = 0.0
    return vector / np.linalg.norm(vector)


def _capsule(first: Any, last: Any, radius: float) -> dict[str, Any]:
    return {"shape": "capsule", "from_mm": first.tolist(), "to_mm": last.tolist(), "radius_mm": float(radius)}


def _vessel(rng: np.random.Generator, space: bool) -> _Make:
    """Return capsules along a curved line through a point."""
    radius, direction = float(rng.uniform(1.0, 3.0)), _direction(rng, space)
    turn = rng.normal(0.0, 0.25, 3) * [1.0, 1.0, float(space)]
    points = [-12.0 * direction]
    for _ in range(4):
        points.append(points[-1] + 6.0 * direction)
        direction = direction + turn
        direction /= np.linalg.norm(direction)
    line = np.array(points)
    return lambda at: [_capsule(at + a, at + b, radius) for a, b in pairwise(line)]


def _wall(rng: np.random.Generator, at: Any, space: bool) -> list[dict[str, Any]]:
    """Return two boxes with a gap between them, somewhere beside the line."""
    gap, thick, long = rng.uniform(6.0, 12.0), rng.uniform(1.0, 4.0), 20.0
    off = at[1] + rng.uniform(-8.0, 8.0)
    wide = 40.0 if space else 10.0
    return [
        {
            "shape": "box",
            "center_mm": [float(at[0]), float(off + side * 0.5 * (gap + long)), 0.0],
            "size_mm": [float(thick), long, wide],
        }
        for side in (-1.0, 1.0)
    ]


_SHAPES = {"sphere": _sphere, "capsule": _capsule_at, "box": _box, "vessel": _vessel}
