"""Requests in received messages, with checks: peers may send anything."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.igtl.messages import (
    Message,
    NamedPoint,
    PointMessage,
    StringMessage,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.types import FARTHEST_MM, Point

STOP = "STOP"
"""Text of a STRING that stops the insertion, in any case of letters."""
TARGET, ENTRY = "target", "entry"
"""Beginnings of the names of points, in any case of letters: 3D Slicer names points after their list, as Target-1."""
FAR_FROM_SKIN_MM = 5.0
"""Largest distance of an entry from the skin, the plane x = 0 of the needle's frame."""
_DIGITS = 4


@dataclass(frozen=True)
class StopRequest:
    """A STRING with the text STOP."""


@dataclass(frozen=True)
class PathRequest:
    """Entry, target, both or neither, in the frame of the peer (mm)."""

    entry: Point | None
    target: Point | None


Request = StopRequest | ImageRegistration | PathRequest


def read_request(message: Message, registration: str) -> Request | None:
    """Return the request of a message; None for a message that is not used.

    registration: device name of the TRANSFORM from the image to the needle's frame. Raises InputError for a
    registration that is not rigid.
    """
    match message:
        case StringMessage(text=text) if text.strip().upper() == STOP:
            return StopRequest()
        case TransformMessage(name=name, matrix=matrix) if name == registration:
            return ImageRegistration.of_matrix(matrix)
        case PointMessage(points=points):
            return PathRequest(_find(points, ENTRY), _find(points, TARGET))
        case TrajectoryMessage(trajectories=[first, *_]):
            return PathRequest(first.entry, first.target)
    return None


def to_needle(registration: ImageRegistration | None, point: Point) -> Point:
    """Return a point of a peer (mm) in the needle's frame, to 0.1 µm. Raises InputError for one farther than 10 m."""
    given = np.array(point)
    # Numbers have 32 bits: a point in the plane may be off by their rounding.
    mapped = given if registration is None else registration.apply(given)
    x, y, z = (np.round(mapped, _DIGITS) + 0.0).tolist()  # −0 becomes 0
    if not hypot(x, y, z) <= FARTHEST_MM:
        raise InputError(f"point {_to_text(point)}: farther than 10 m")
    return x, y, z


def check_entry(entry: Point) -> Point:
    """Return an entry point in the needle's frame. Raises InputError for one far from the skin."""
    if abs(entry[0]) > FAR_FROM_SKIN_MM:
        rule = f"must be within {FAR_FROM_SKIN_MM:g} mm of the skin (x = 0)"
        raise InputError(
            f"entry {_to_text(entry)} mm in the needle's frame: {rule}: is the registration right?"
        )
    return entry


def _find(points: Sequence[NamedPoint], begin: str) -> Point | None:
    """Return the first point whose name begins so."""
    return next((one.position for one in points if one.name.casefold().startswith(begin)), None)


def _to_text(point: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in point)
