"""Response of the tip's slope to motions of the guide over depth, as recorded and by the model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexneedle.lab.calibration.comparison import Tested
from flexneedle.lab.calibration.verdicts import bootstrap
from flexneedle.types import Floats

_BINS, _LEAST_MOVES = 8, 8  # bins by depth at most; motions in each at least
_LEAST_MM = 0.3  # motion of the guide that counts


@dataclass(frozen=True, eq=False)
class Response:
    """Turn of the tip (rad/mm) for a motion of the guide, about a depth (mm), with an interval of 95 % as recorded."""

    depth: float
    moves: int
    recorded: float
    low: float
    high: float
    model: float


def responses(tested: Sequence[Tested], deepest: float) -> Iterator[Response]:
    """Yield the responses by depth, in bins that hold enough motions of the guide.

    The change of the slope in a step is regressed on the motion of the guide, with a constant for the bevel.
    """
    rows = np.concatenate([_changes(n, one) for n, one in enumerate(tested)])
    rows = rows[np.isfinite(rows).all(axis=1)]
    depth, low = np.sort(rows[np.abs(rows[:, 2]) > _LEAST_MM, 1]), 0.0
    while len(ahead := depth[depth >= low]) >= _LEAST_MOVES:
        high = max(low + deepest / _BINS, float(np.nextafter(ahead[_LEAST_MOVES - 1], np.inf)))
        part, moves = rows[(rows[:, 1] >= low) & (rows[:, 1] < high)], int(np.count_nonzero(ahead < high))
        ends = _interval(part)
        yield Response(0.5 * (low + high), moves, _slope(part, 3), *ends, _slope(part, 4))
        low = high


def _changes(number: int, tested: Tested) -> Floats:
    """Return rows (r, 5) of all intervals and axes: insertion, depth, motion of the guide, changes of the slope."""
    one, axes = tested.recording, tested.recording.axes
    moved, turned = np.diff(one.guide, axis=0), np.diff(one.slope, axis=0)
    model = np.diff(tested.forecast.slope, axis=0)
    depth = np.repeat(one.depth[:-1], axes)
    return np.column_stack([np.full(len(depth), number), depth, moved.ravel(), turned.ravel(), model.ravel()])


def _slope(rows: Floats, column: int) -> float:
    moved = rows[:, 2] - rows[:, 2].mean()
    return float(moved @ rows[:, column] / max(moved @ moved, 1e-12))


def _interval(rows: Floats) -> tuple[float, float]:
    return bootstrap(rows[:, 0], lambda drawn: _slope(rows[drawn], 3))
