"""Readings of sensors along the needle that another program sends."""

from collections.abc import Callable, Iterable
from typing import Annotated, TypeVar

from pydantic import Field

from flexneedle.errors import InputError
from flexneedle.types import VISIBLE, Matrix, Point

MOST_POINTS = 10_000
"""Largest number of points in a message."""

LateMs = Annotated[float, Field(gt=0, le=60_000)]
"""Time without a reading (ms)."""

Place = TypeVar("Place")

_PERIODS, _LEAST_S = 3.0, 0.25
_MISSING = (float("nan"),) * 3


def find_late_s(given_ms: float | None, rate_hz: float) -> float:
    """Return the time (s) without a reading after which a status is not ok.

    Not given: three periods of the rate, at least 0.25 s.
    """
    return max(_LEAST_S, _PERIODS / rate_hz) if given_ms is None else 1e-3 * given_ms


def read_points(places: Iterable[Place], to_point: Callable[[Place], Point]) -> tuple[Matrix, str]:
    """Return the rows and the status of a reading of places along the needle.

    to_point: returns x, y, z (mm) in the frame of the insertion, or raises InputError for a place that is none. Its row
    is NaN; without any other there are no rows, and the status is the reason.
    """
    rows: list[Point] = []
    reason = "no points"
    for place in places:
        try:
            rows.append(to_point(place))
        except InputError as error:
            rows.append(_MISSING)
            reason = str(error)
    return (tuple(rows), VISIBLE) if any(row is not _MISSING for row in rows) else ((), reason)
