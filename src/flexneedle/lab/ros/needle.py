"""Curvatures and points along the needle in messages, with checks.

A `std_msgs/msg/Float64MultiArray` should state its order in its layout. The nodes of the SmartNeedle stack state there
the size of one column of their array, in bytes, in each of two dimensions: 16 for an array (2, n) and 8 n for (n, 2).
Its data have the columns one after the other.
"""

from collections.abc import Sequence
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.link.sensing import MOST_POINTS
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.types import Matrix, Point

_BYTES = 8  # of a number


def read_curvatures(message: Any, order: str | None) -> Matrix:
    """Return both curvatures of each grating, as they are in the message.

    order: `sites`, `components`, or None for the order of the layout. Raises InputError if the numbers are not two for
    each grating, or the layout has no known order.
    """
    values = message.data
    if len(values) % 2 or not 2 <= len(values) <= 2 * MOST_POINTS:
        raise InputError(f"{len(values)} numbers: must be two for each grating, at most {2 * MOST_POINTS}")
    if message.layout.data_offset:
        raise InputError(f"layout.data_offset is {message.layout.data_offset}: must be 0")
    sizes = [one.size for one in message.layout.dim]
    by_site = (order or _find_order(sizes, len(values) // 2)) == "sites"
    pairs = values.reshape(-1, 2) if by_site else values.reshape(2, -1).T
    return tuple((first, second) for first, second in pairs.tolist())


def _find_order(sizes: Sequence[int], gratings: int) -> str:
    """Return the order of a layout with dimensions of these sizes."""
    if sizes in ([], [2 * gratings]):
        return "sites"
    known = {
        "sites": ([gratings, 2], [2 * _BYTES, 2 * _BYTES]),
        "components": ([2, gratings], [gratings * _BYTES, gratings * _BYTES]),
    }
    found = [order for order, layouts in known.items() if sizes in layouts]
    if len(found) != 1:
        shown = ", ".join(map(str, sizes[:5]))
        raise InputError(f"layout ({shown}) of {2 * gratings} numbers: set order in the profile")
    return found[0]


def pose_to_point(frame: FrameMap, pose: Any) -> Point:
    """Return the position (mm) of a pose. Raises InputError for an unfilled one, as `FrameMap.to_point` for others."""
    if is_unfilled(pose):
        raise InputError("missing (position and orientation are 0)")
    return frame.to_point(pose.position)


def is_unfilled(pose: Any) -> bool:
    """Return True if all numbers of a pose are 0, as in no measured one."""
    return not any(getattr(part, axis, 0.0) for part in (pose.position, pose.orientation) for axis in "xyzw")
