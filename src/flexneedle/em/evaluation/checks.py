"""What a row of measurements may hold. Errors name the first row that breaks a rule (1: the first below the header)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError

FARTHEST_MM = 1e6  # a tracker's code for "no value" is beyond (−3.7e28 in NDI's replies), a room is not
UNIT_TOLERANCE = 0.01  # devices round to 4 digits

Floats = NDArray[np.float64]
Columns = Sequence[Floats]
Mask = Any  # an array of booleans; numpy types all() of one as a boolean, too


def refuse(wrong: Mask, start: int, what: str) -> None:
    """Raise InputError if any of the rows (r,), the first of which is row `start`, is wrong."""
    if wrong.any():
        raise InputError(f"row {start + int(np.argmax(wrong))}: {what}")


def seen_rows(position: Columns, start: int) -> Mask | None:
    """Return which samples (r,) of x, y, z (r,) have a position, None if all: those without have none of the three.

    Raises InputError for a part of a position and for numbers that are none (infinite, or beyond 1 km).
    """
    if _all_within(position):
        return None
    known = ~np.isnan(position)
    seen = known.all(axis=0)
    refuse(
        known.any(axis=0) & ~seen,
        start,
        "x_mm, y_mm, z_mm: all three must be there, or none (a missing sample)",
    )
    far = (np.abs(position) > FARTHEST_MM).any(axis=0)
    refuse(
        far,
        start,
        f"x_mm, y_mm, z_mm: must be finite and at most {FARTHEST_MM:g} mm (a code for a missing place?)",
    )
    return seen


def check_true(true: Columns, start: int) -> None:
    """Raise InputError where a part of the true position (r,) is not there, or no number."""
    if not _all_within(true):
        wrong = ~(np.abs(true) <= FARTHEST_MM).all(axis=0)
        refuse(
            wrong, start, f"true_x_mm, true_y_mm, true_z_mm: must be there, and at most {FARTHEST_MM:g} mm"
        )


def _all_within(columns: Columns) -> bool:
    """Whether all numbers are finite and near; NaN is not."""
    return all(column.min() >= -FARTHEST_MM and column.max() <= FARTHEST_MM for column in columns)


def unit_quaternions(quaternion: Floats, start: int) -> tuple[Floats, Mask]:
    """Return quaternions (4, r) scaled to length 1 and which rows (r,) have one: those without have no component.

    Raises InputError for a part of a quaternion and for a length more than 1 % off.
    """
    known = ~np.isnan(quaternion)
    there: Mask = known.all(axis=0)
    refuse(known.any(axis=0) & ~there, start, "qw, qx, qy, qz: all four must be there, or none")
    length = np.sqrt(np.einsum("kr,kr->r", quaternion, quaternion))
    off = ~(np.abs(length - 1.0) <= UNIT_TOLERANCE) & there
    refuse(off, start, "qw, qx, qy, qz: must be a unit quaternion, to 1 %")
    with np.errstate(invalid="ignore"):
        return quaternion / length, there
