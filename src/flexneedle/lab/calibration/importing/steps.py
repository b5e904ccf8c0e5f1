"""Steps of a recording: its rows, or the still phases of a stream."""

import numpy as np

from flexneedle.types import Floats

_SPEED_SHARE = 0.2  # of the typical speed of a motion, below which the tip rests
_WINDOW_S = 0.2  # over which speeds are measured


def still_phases(time: Floats, position: Floats, guide: Floats, least_s: float) -> list[slice]:
    """Return the rows of each phase in which tip (r, 3) and guide (r, a) rest, mm, for at least a time (s).

    The threshold follows from the recording: a share of the speed of its motions, above the noise at rest.
    """
    speed = np.maximum(_speed(time, position), _speed(time, guide))
    moving = speed[speed > np.quantile(speed, 0.25)]
    limit = max(_SPEED_SHARE * float(np.quantile(moving, 0.75)), 3.0 * float(np.quantile(speed, 0.1)))
    still = np.concatenate([[False], speed <= limit, [False]])
    edges = np.flatnonzero(np.diff(still.astype(int)))
    phases = zip(edges[::2], edges[1::2], strict=True)
    return [slice(a, b) for a, b in phases if time[b - 1] - time[a] >= least_s]


def _speed(time: Floats, values: Floats) -> Floats:
    """Return speeds (r,) over a window centred at each row, mm/s."""
    before = np.searchsorted(time, time - 0.5 * _WINDOW_S, side="left")
    after = np.minimum(np.searchsorted(time, time + 0.5 * _WINDOW_S, side="right"), len(time)) - 1
    before = np.minimum(before, np.maximum(after - 1, 0))
    span = np.maximum(time[after] - time[before], 1e-6)
    found: Floats = np.linalg.norm(values[after] - values[before], axis=1) / span
    return found


def mean_of(phases: list[slice], values: Floats) -> Floats:
    """Return medians (k, …) of values in each phase."""
    with np.errstate(all="ignore"):
        return np.array([np.nanmedian(values[phase], axis=0) for phase in phases])
