"""Data of the figures as arrays: paths, rolls of the bevel, errors, guide and energy over depth, the field."""

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

from flexneedle.types import Action, Floats, Frame, Insertion, Plan, VerdictKind

_TIP = "tip"  # the sensor in the needle; all others of a frame are references
# Verdicts of readings that the monitor excludes from its window.
_EXCLUDED = (VerdictKind.STALE, VerdictKind.NOT_A_NUMBER)


@dataclass(frozen=True)
class Roll:
    """A roll of the bevel at a tip position (mm), to the side +1 (+y) or −1."""

    x: float
    y: float
    side: int


def planned_rolls(plan: Plan) -> list[Roll]:
    """Return the rolls of a plan, each at the tip position before its step."""
    steps = np.flatnonzero(plan.controls[:, 4] > 0.0)
    sides = plan.bevel * (-1) ** np.arange(1, len(steps) + 1)
    positions = plan.tips[steps, :2].tolist()
    return [Roll(x, y, int(side)) for (x, y), side in zip(positions, sides, strict=True)]


def applied_rolls(insertion: Insertion) -> list[Roll]:
    """Return the rolls as applied, each at the estimated tip position before its period."""
    before = [insertion.plan.tips[0].tolist(), *(period.estimate for period in insertion.periods)]
    return [
        Roll(float(tip[0]), float(tip[1]), period.bevel)
        for tip, period in zip(before, insertion.periods, strict=False)
        if period.applied[4] > 0
    ]


def estimated_path(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the estimated tip."""
    return _points(period.estimate[:2] for period in insertion.periods)


def true_path(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the true tip, where it is known."""
    return _points(period.true_tip[:2] for period in insertion.periods if period.true_tip is not None)


def good_measurements(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the readings that were used."""
    return _points((p.measurement.x, p.measurement.y) for p in insertion.periods if p.verdict.ok)


def rejected_measurements(insertion: Insertion) -> Floats:
    """Return x, y (k, 2) of the readings that were rejected."""
    rejected = (p.measurement for p in insertion.periods if not p.verdict.ok)
    return _points((one.x, one.y) for one in rejected if one.x is not None)


def lateral_error(plan: Plan, points: Floats) -> Floats:
    """Return the lateral deviation (k,), mm, signed, of points (k, 2) from the planned path at their depth."""
    order = np.argsort(plan.tips[:, 0], kind="stable")
    planned = np.interp(points[:, 0], plan.tips[order, 0], plan.tips[order, 1])
    return np.asarray(points[:, 1] - planned)


def planned_motion(plan: Plan, guided: bool) -> Floats:
    """Return the lateral position (k,), mm, of the guide at each tip position, or of the base if there is no guide."""
    return plan.guide if guided else np.cumsum([0.0, *plan.controls[:, 1]])


def true_energy(insertion: Insertion) -> Floats:
    """Return depth of the true tip (mm) and energy of the true tissue (mJ) (k, 2), where they are known."""
    return _points(
        (period.true_tip[0], period.true_strain_energy)
        for period in insertion.periods
        if period.true_tip is not None and period.true_strain_energy is not None
    )


def intermediate_shapes(tips: Floats, shapes: list[Floats], count: int = 4) -> list[Floats]:
    """Return up to `count` shapes at equal distances of the tip from start to end, without the last one."""
    depth = tips[:, 0]
    wanted = np.linspace(depth[0], depth[-1], count + 1)[:-1]
    chosen = dict.fromkeys(int(np.argmin(np.abs(depth - x))) for x in wanted)
    return [shapes[k] for k in chosen if k != len(shapes) - 1]


def held_spans(insertion: Insertion) -> list[tuple[float, float]]:
    """Return begin and end (s) of each time span in which the needle was held."""
    ends = [0.0, *(period.time for period in insertion.periods)]
    spans: list[tuple[float, float]] = []
    for period, (begin, end) in zip(insertion.periods, pairwise(ends), strict=True):
        if period.action is not Action.HOLD:
            continue
        if spans and spans[-1][1] == begin:
            spans[-1] = (spans[-1][0], end)
        else:
            spans.append((begin, end))
    return spans


def worst_indicator(insertion: Insertion, window: float) -> Floats:
    """Return time (s) of each reading and the largest median indicator of a reference then (k, 2).

    The median of a sensor is over the preceding window (s), as in the monitor. NaN where no reference has an indicator
    within it; no rows if none has any.
    """
    frames = list(_frames(insertion))
    if not any(_indicators(frame) for frame in frames):
        return np.empty((0, 2))
    times = [frame.time for frame in frames]
    begins = [bisect_right(times, time - window + 1e-9) for time in times]
    return np.array([(time, _worst(frames[begins[k] : k + 1])) for k, time in enumerate(times)])


def _frames(insertion: Insertion) -> Iterator[Frame]:
    for period in insertion.periods:
        for checked in period.readings:
            if checked.measurement.frame is not None and checked.verdict.kind not in _EXCLUDED:
                yield checked.measurement.frame


def _indicators(frame: Frame) -> dict[str, float]:
    return {
        name: reading.indicator
        for name, reading in frame.readings.items()
        if name != _TIP and reading.indicator is not None
    }


def _worst(frames: Sequence[Frame]) -> float:
    by_sensor: dict[str, list[float]] = {}
    for frame in frames:
        for name, value in _indicators(frame).items():
            by_sensor.setdefault(name, []).append(value)
    return max(map(median, by_sensor.values()), default=float("nan"))


def _points(pairs: Iterable[tuple[float | None, float | None]]) -> Floats:
    return np.array(list(pairs), dtype=float).reshape(-1, 2)
