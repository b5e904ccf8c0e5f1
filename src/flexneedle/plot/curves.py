"""What the figures show, as arrays: paths, turns of the bevel, errors, guide and energy over depth."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.trace import Insertion, PlanRecord

__all__ = [
    "Turn",
    "applied_turns",
    "estimated_path",
    "good_samples",
    "lateral_error",
    "planned_turns",
    "refused_samples",
    "shapes_on_the_way",
    "true_energy",
    "true_path",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Turn:
    """A turn of the bevel at a tip position (mm), to the side +1 (+y) or −1."""

    x: float
    y: float
    side: int


def planned_turns(plan: PlanRecord) -> list[Turn]:
    """Return the turns of a plan, each where the tip stands as the bevel turns."""
    steps = np.flatnonzero(plan.controls[:, 4] > 0.0)
    sides = plan.bevel * (-1) ** np.arange(1, len(steps) + 1)
    places = plan.tips[steps, :2].tolist()
    return [Turn(x, y, int(side)) for (x, y), side in zip(places, sides, strict=True)]


def applied_turns(insertion: Insertion) -> list[Turn]:
    """Return the turns as applied, each where the tip was estimated as the bevel turned."""
    before = [insertion.plan.tips[0].tolist(), *(period.estimate for period in insertion.periods)]
    return [
        Turn(float(tip[0]), float(tip[1]), period.bevel)
        for tip, period in zip(before, insertion.periods, strict=False)
        if period.applied[4] > 0
    ]


def estimated_path(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the estimated tip."""
    return _points(period.estimate[:2] for period in insertion.periods)


def true_path(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the true tip, where it is known."""
    return _points(period.true_tip[:2] for period in insertion.periods if period.true_tip is not None)


def good_samples(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the readings that were used."""
    return _points((p.sample.x, p.sample.y) for p in insertion.periods if p.verdict == "ok")


def refused_samples(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the readings that were there, but were not used."""
    refused = (p.sample for p in insertion.periods if p.verdict != "ok")
    return _points((sample.x, sample.y) for sample in refused if sample.x is not None)


def lateral_error(plan: PlanRecord, points: Floats) -> Floats:
    """Return how far aside (mm, signed) of the planned path points (k, 2) lie, at their own depth."""
    order = np.argsort(plan.tips[:, 0], kind="stable")
    planned = np.interp(points[:, 0], plan.tips[order, 0], plan.tips[order, 1])
    return np.asarray(points[:, 1] - planned)


def true_energy(insertion: Insertion) -> Floats:
    """Return depth of the true tip (mm) and energy of the true tissue (mJ) (k, 2), where they are known."""
    return _points(
        (period.true_tip[0], period.true_strain_energy)
        for period in insertion.periods
        if period.true_tip is not None and period.true_strain_energy is not None
    )


def shapes_on_the_way(tips: Floats, shapes: list[Floats], count: int = 4) -> list[Floats]:
    """Return up to `count` shapes at equal distances of the tip from start to end, without the last."""
    depth = tips[:, 0]
    wanted = np.linspace(depth[0], depth[-1], count + 1)[:-1]
    chosen = dict.fromkeys(int(np.argmin(np.abs(depth - x))) for x in wanted)
    return [shapes[k] for k in chosen if k != len(shapes) - 1]


def _points(pairs: Iterable[tuple[float | None, float | None]]) -> Floats:
    return np.array(list(pairs), dtype=float).reshape(-1, 2)
