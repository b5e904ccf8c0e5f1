"""What motors did, from samples of their encoders: when a motion began and ended. Pure functions."""

from collections.abc import Sequence
from statistics import fmean

_LOW, _HIGH, _FEWEST, _LEAST_SPREAD = 0.05, 0.95, 3, 0.2


def span(
    samples: Sequence[tuple[float, float]], begun: float, ended: float, last: float = 1.0
) -> tuple[float, float]:
    """Begin and end (s) of the motion at constant speed that fits best to samples (time in s, share of the way).

    last: share at which it ended.

    A motor accelerates and slows down, so that a tip at constant speed from the command on would be ahead of it and
    then behind. begun, ended: the times returned where too few samples are on the way.
    """
    way = [(time, share) for time, share in samples if _LOW < share < _HIGH]
    if len(way) < _FEWEST or max(way)[1] - min(way)[1] < _LEAST_SPREAD:
        return begun, ended
    time, share = fmean(one for one, _ in way), fmean(one for _, one in way)
    varied = sum((one - share) ** 2 for _, one in way)
    slope = sum((at - time) * (one - share) for at, one in way) / varied  # s for the whole way
    first = time - slope * share
    return first, first + slope * last
