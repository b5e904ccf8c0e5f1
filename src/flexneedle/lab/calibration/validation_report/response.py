"""Response of the tip's slope to motions of the guide over depth, as recorded and by the model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexneedle.lab.calibration.comparison import Tested
from flexneedle.types import Floats

_BINS, _LEAST_MOVES = 8, 8
_LEAST_MM = 0.3  # motion of the guide that counts
_DRAWS = 200  # of insertions in a bootstrap


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
    """Yield the responses by depth, where the recordings have enough motions of the guide.

    The change of the slope in a step is regressed on the motion of the guide, with a constant for the bevel.
    """
    rows = np.concatenate([_changes(n, one) for n, one in enumerate(tested)])
    rows = rows[np.isfinite(rows).all(axis=1)]
    edges = np.linspace(0.0, deepest, _BINS + 1)
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = rows[(rows[:, 1] >= low) & (rows[:, 1] < high)]
        moves = int(np.count_nonzero(np.abs(part[:, 2]) > _LEAST_MM))
        if moves >= _LEAST_MOVES:
            ends = _interval(part)
            yield Response(0.5 * (low + high), moves, _slope(part, 3), *ends, _slope(part, 4))


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
    """Return the interval of the recorded response, by bootstrap over insertions."""
    groups = [np.flatnonzero(rows[:, 0] == one) for one in np.unique(rows[:, 0])]
    random, found = np.random.default_rng(0), []
    for _ in range(_DRAWS):
        drawn = np.concatenate([groups[k] for k in random.integers(len(groups), size=len(groups))])
        found.append(_slope(rows[drawn], 3))
    low, high = np.quantile(found, (0.025, 0.975)).tolist()
    return low, high
