"""Data of the figures as arrays: paths, rolls of the bevel, errors, guide and energy over depth, the field.

Points are rows x, y, z; a figure draws two of their columns.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

from flexneedle.results import Action, Insertion, Period, Plan
from flexneedle.types import ROLL, SPIN, TIP, Floats, Frame, Pose, VerdictKind, X, Y

# Verdicts of readings that the monitor excludes from its window.
_EXCLUDED = (VerdictKind.STALE, VerdictKind.NOT_A_NUMBER)
_MARKED = math.radians(5.0)  # smaller rolls have no mark


@dataclass(frozen=True)
class Roll:
    """A roll of the needle to an angle (rad) at a tip position x, y, z (mm)."""

    point: tuple[float, ...]
    angle: float

    @property
    def side(self) -> int:
        """The side of the bevel in the plane, +1 (+y) or −1."""
        return 1 if math.cos(self.angle) >= 0.0 else -1

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector x, y, z of the bevel."""
        return 0.0, math.cos(self.angle), math.sin(self.angle)


def start_roll(plan: Plan) -> Roll:
    """Return the angle of the needle at the start of a plan."""
    return Roll(_place(plan.tips[0]), plan.roll)


def planned_rolls(plan: Plan) -> list[Roll]:
    """Return the rolls of a plan that are large enough for a mark, each at the tip position before its step."""
    angles = planned_angles(plan)[1::2, 1]
    steps = np.flatnonzero(np.abs(plan.controls[:, ROLL]) > _MARKED)
    return [Roll(_place(plan.tips[k]), float(angles[k])) for k in steps]


def applied_rolls(insertion: Insertion) -> list[Roll]:
    """Return the rolls as applied, as `planned_rolls`, each at the estimated tip position before its period."""
    before = [Pose.of(insertion.plan.tips[0]), *(period.estimate for period in insertion.periods)]
    return [
        Roll(tip.point, period.roll - period.applied.spin)
        for tip, period in zip(before, insertion.periods, strict=False)
        if abs(period.applied.roll) > _MARKED
    ]


def planned_angles(plan: Plan) -> Floats:
    """Return depth of the tip (mm) and angle of the needle (rad), (2m + 1, 2).

    The rows are the start, then begin and end of each step.
    """
    rolls, spins = plan.controls[:, ROLL], plan.controls[:, SPIN]
    ends = plan.roll + np.cumsum(rolls + spins)
    angles = np.column_stack([ends - spins, ends]).ravel()
    depths = np.column_stack([plan.tips[:-1, X], plan.tips[1:, X]]).ravel()
    return np.column_stack([[plan.tips[0, X], *depths], [plan.roll, *angles]])


def applied_angles(insertion: Insertion) -> Floats:
    """Return depth of the estimated tip (mm) and angle of the needle (rad) (2k, 2), begin and end of each period."""
    before = [float(insertion.plan.tips[0, X]), *(period.estimate.x for period in insertion.periods)]
    pairs = zip(pairwise(before), insertion.periods, strict=True)
    rows = (((begin, p.roll - p.applied.spin), (end, p.roll)) for (begin, end), p in pairs)
    return np.array(list(rows)).reshape(-1, 2)


def prediction(insertion: Insertion) -> Period | None:
    """Return the last period up to half the target depth in which the shape at the target was predicted."""
    half = 0.5 * insertion.target[0]
    known = [p for p in insertion.periods if p.predicted is not None and p.estimate.x <= half]
    return known[-1] if known else None


def estimated_path(insertion: Insertion) -> Floats:
    """Return x, y, z (k, 3) of the estimated tip."""
    return _points(period.estimate.point for period in insertion.periods)


def true_path(insertion: Insertion) -> Floats:
    """Return x, y, z (k, 3) of the true tip, where it is known."""
    return _points(period.true_tip.point for period in insertion.periods if period.true_tip is not None)


def good_measurements(insertion: Insertion) -> Floats:
    """Return x, y, z (k, 3) of the readings that were used; z is NaN where it was not measured."""
    return _points(
        (p.measurement.x, p.measurement.y, p.measurement.z) for p in insertion.periods if p.verdict.ok
    )


def rejected_measurements(insertion: Insertion) -> Floats:
    """Return x, y, z (k, 3) of the readings that were rejected."""
    rejected = (p.measurement for p in insertion.periods if not p.verdict.ok)
    return _points((one.x, one.y, one.z) for one in rejected if one.x is not None)


def lateral_error(plan: Plan, points: Floats, axis: int = Y) -> Floats:
    """Return the deviation (k,), mm, signed, of points (k, 3) along y or z from the planned path at their depth."""
    order = np.argsort(plan.tips[:, X], kind="stable")
    planned = np.interp(points[:, 0], plan.tips[order, X], plan.tips[order, axis])
    return np.asarray(points[:, axis] - planned)


def planned_motion(plan: Plan, guided: bool, axis: int = Y) -> Floats:
    """Return y or z (k,), mm, of the guide at each tip position, or of the base if there is no guide."""
    return plan.guide[:, axis - Y] if guided else plan.shapes[:, 0, axis]


def applied_motion(insertion: Insertion, guided: bool, axis: int = Y) -> Floats:
    """Return y or z (k,), mm, of the guide after each period, or of the base if there is no guide."""
    lateral = axis - Y
    return np.array([p.guide[lateral] if guided else p.base[axis] for p in insertion.periods])


def estimated_energy(insertion: Insertion) -> Floats:
    """Return depth of the estimated tip (mm) and energy of the estimated tissue (µJ) (k, 2)."""
    rows = [(period.estimate.x, 1e3 * period.strain_energy) for period in insertion.periods]
    return np.array(rows, dtype=float).reshape(-1, 2)


def true_energy(insertion: Insertion) -> Floats:
    """Return depth of the true tip (mm) and energy of the true tissue (µJ) (k, 2), where they are known."""
    known = [
        (period.true_tip.x, 1e3 * period.true_strain_energy)
        for period in insertion.periods
        if period.true_tip is not None and period.true_strain_energy is not None
    ]
    return np.array(known, dtype=float).reshape(-1, 2)


def estimated_clearance(insertion: Insertion) -> Floats:
    """Return depth of the estimated tip (mm) and clearance of the estimated needle from zones (mm) (k, 2)."""
    rows = [(period.estimate.x, period.clearance) for period in insertion.periods]
    return np.array(rows, dtype=float).reshape(-1, 2)


def true_clearance(insertion: Insertion) -> Floats:
    """Return depth of the true tip (mm) and clearance of the true needle from zones (mm) (k, 2), where known."""
    known = [
        (period.true_tip.x, period.true_clearance)
        for period in insertion.periods
        if period.true_tip is not None and period.true_clearance is not None
    ]
    return np.array(known, dtype=float).reshape(-1, 2)


def known_shapes(insertion: Insertion) -> list[Floats]:
    """Return the true shapes (n, 3) of the needle; if one is unknown, the estimated ones (n, 5)."""
    true = [period.true_shape for period in insertion.periods if period.true_shape is not None]
    complete = len(true) == len(insertion.periods)
    return true if complete else [period.shape for period in insertion.periods]


def known_clearance(insertion: Insertion) -> float:
    """Return the least clearance (mm) of the true needle from zones; if unknown, of the estimated one."""
    true = insertion.true_clearance_mm
    return insertion.least_clearance_mm if math.isnan(true) else true


def last_shape(insertion: Insertion) -> Floats:
    """Return points (n, ≥ 3) of the needle at the end: true, or estimated where the true shape is not known."""
    return known_shapes(insertion)[-1]


def intermediate_shapes(tips: Floats, shapes: list[Floats], count: int = 4) -> list[Floats]:
    """Return up to `count` shapes at equal distances of the tip from start to end, without the last one."""
    depth = tips[:, X]
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
        if name != TIP and reading.indicator is not None
    }


def _worst(frames: Sequence[Frame]) -> float:
    by_sensor: dict[str, list[float]] = {}
    for frame in frames:
        for name, value in _indicators(frame).items():
            by_sensor.setdefault(name, []).append(value)
    return max(map(median, by_sensor.values()), default=float("nan"))


def _points(rows: Iterable[tuple[float | None, ...]]) -> Floats:
    return np.array(list(rows), dtype=float).reshape(-1, 3)


def _place(pose: Floats) -> tuple[float, ...]:
    return tuple(map(float, pose[:3]))
