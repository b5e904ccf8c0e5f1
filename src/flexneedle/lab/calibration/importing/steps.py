"""Steps of an insertion: its rows, the still phases of a stream, or every few millimetres of one."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.map_file import StepMap
from flexneedle.lab.calibration.importing.rows import Rows
from flexneedle.types import Floats

_WINDOW = 1.0 / 3.0  # of the shortest rest, over which positions are averaged
_CERTAIN = 4.0  # standard deviations
_MEDIAN_SD = 0.6745  # median of the size of a normal deviate
_MOTION_SHARE = 0.15  # of the usual motion, by which half of the path is longer and half shorter
_SAME_MM = 0.05  # between phases that are one
_AGAIN = 3.0  # advance after a retreat that may be another insertion, relative to the retreat
_ROLL_MM = 5.0  # lateral motion that counts as 1 rad of rotation


def find_steps(rows: Rows, steps: StepMap) -> Rows:
    """Return the steps of the rows, of which all have a position and a guide. Raises InputError for a contradiction."""
    _check_rows(rows, steps)
    if steps.rows == "steps":
        return rows
    if not np.isfinite(rows.time).all():
        raise InputError(f"{rows.source}: a stream needs the time of each row: set time.columns")
    if steps.every_mm is not None:
        return rows.choose(_every(rows.position, steps.every_mm))
    stages = np.column_stack([rows.guide, rows.base, _ROLL_MM * rows.roll])
    phases = still_phases(rows.time, rows.position, stages, steps.least_still_s)
    return rows.with_table(medians(phases, rows.table)) if phases else rows.choose(slice(0))


def _check_rows(rows: Rows, steps: StepMap) -> None:
    """Raise InputError for times that run backwards, and positions too far from each other."""
    time = rows.time[np.isfinite(rows.time)]
    if (np.diff(time) < 0.0).any():
        row = int((np.diff(time) < 0.0).argmax())
        raise InputError(
            f"{rows.source}: time runs backwards at {time[row]:.10g} s: check time.columns, or sort the rows"
        )
    jumps = np.linalg.norm(np.diff(rows.position, axis=0), axis=1)
    if jumps.max(initial=0.0) > steps.gap_mm:
        row = int((jumps > steps.gap_mm).argmax())
        place = ", ".join(f"{each:.4g}" for each in rows.position[row + 1])
        raise InputError(
            f"{rows.source}: the tip jumps by {jumps[row]:.4g} mm to ({place}), more than steps.gap_mm = "
            f"{steps.gap_mm:g}: check tip.unit, tip.position and table.missing"
        )


def _every(position: Floats, distance: float) -> Any:
    """Return the first row (k,) at each multiple of a distance along the path's chord."""
    path = position - position[0]
    far = path[np.linalg.norm(path, axis=1).argmax()]
    advance = np.maximum.accumulate(path @ far / max(float(np.linalg.norm(far)), 1e-9))
    return np.searchsorted(advance, np.arange(0.0, advance[-1], distance), side="left")


def still_phases(time: Floats, position: Floats, stages: Floats, least_s: float) -> list[slice]:
    """Return the rows of each phase in which tip (r, 3) and stages (r, a) rest, mm, for at least a time (s).

    Means over n rows before and after a time differ by less than the noise at rest, or a share of the usual motion. The
    2 n rows about such a time rest. Neighbouring phases with the same tip and stages are one.
    """
    if len(time) < 2:
        return []
    n = max(1, round(_WINDOW * least_s / max(float(np.median(np.diff(time))), 1e-9)))
    still = np.concatenate([[False], _is_still(position, n) & _is_still(stages, n), [False]])
    begins, ends = np.flatnonzero(np.diff(still.astype(int))).reshape(-1, 2).T
    phases = [slice(a, b + 2 * n - 1) for a, b in zip(begins.tolist(), ends.tolist(), strict=True)]
    long = [each for each in phases if time[each.stop - 1] - time[each.start] > 0.99 * least_s]
    return _merge(long, position, stages)


def _is_still(values: Floats, n: int) -> NDArray[np.bool_]:
    """Return whether means over n rows (r, a) are the same as over the next n, (r − 2 n + 1,)."""
    sums = np.cumsum(np.vstack([np.zeros(values.shape[1]), values]), axis=0)
    means = (sums[n:] - sums[:-n]) / n
    motion = np.linalg.norm(means[n:] - means[:-n], axis=1)
    least = _CERTAIN * _noise(values) * np.sqrt(2.0 / n)
    moving = np.sort(motion[motion > max(least, 1e-6)])
    usual = moving[np.searchsorted(np.cumsum(moving), 0.5 * moving.sum())] if len(moving) else 0.0
    still: NDArray[np.bool_] = motion <= max(least, _MOTION_SHARE * usual, 1e-6)
    return still


def _noise(values: Floats) -> float:
    """Return the standard deviation, over all columns, of independent noise of rows (r, a), from second differences."""
    if len(values) < 3:
        return 0.0
    sizes = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / (_MEDIAN_SD * np.sqrt(6.0))
    return float(np.linalg.norm(sizes))


def _merge(phases: list[slice], position: Floats, stages: Floats) -> list[slice]:
    """Return phases, of which neighbours with the same tip and stages are one."""
    if not phases:
        return []
    places = medians(phases, np.hstack([position, stages]))
    same = max(_SAME_MM, _noise(position))
    merged = [phases[0]]
    for k, moved in enumerate(np.diff(places, axis=0), 1):
        tip, place = np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])
        if tip < same and place < _SAME_MM:
            merged[-1] = slice(merged[-1].start, phases[k].stop)
        else:
            merged.append(phases[k])
    return merged


def medians(phases: list[slice], values: Floats) -> Floats:
    """Return medians (k, c) of the columns of values (r, c) in each phase, NaN where all are."""
    return np.array([_median(values[phase]) for phase in phases])


def _median(values: Floats) -> Floats:
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    columns = np.arange(values.shape[1])
    median: Floats = 0.5 * (ordered[(count - 1) // 2, columns] + ordered[count // 2 - (count == 0), columns])
    return median


def before_retreat(steps: Rows, depth: Floats, retreat_mm: float) -> tuple[Rows, Floats, str]:
    """Return steps and depths (k,) up to the deepest one before a retreat, and a note, "" without a retreat."""
    back = np.flatnonzero(np.maximum.accumulate(depth) - depth > retreat_mm)
    if not len(back):
        return steps, depth, ""
    end = int(depth[: back[0]].argmax()) + 1
    note = (
        f"{steps.source}: {len(depth) - end} steps after {depth[end - 1]:.4g} mm left out: the tip retreats"
    )
    if (
        np.ptp(depth[back[0] :]) > _AGAIN * retreat_mm
        and depth[back[0] :].argmax() > depth[back[0] :].argmin()
    ):
        note += ", then advances again: name each insertion in table.insertion"
    return steps.choose(slice(0, end)), depth[:end], note


def in_order(found: list[Rows]) -> list[Rows]:
    """Return insertions in the order of their times, where these are known and do not overlap; else unchanged."""
    spans = [(float(one.time[0]), float(one.time[-1])) for one in found]
    order = sorted(range(len(found)), key=spans.__getitem__)
    apart = all(spans[a][1] <= spans[b][0] for a, b in pairwise(order))
    return [found[k] for k in order] if apart and np.isfinite(spans).all() else found
