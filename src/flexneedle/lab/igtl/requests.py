"""Requests in received messages, with checks: peers may send anything."""

from collections.abc import Sequence
from dataclasses import dataclass

from flexneedle.lab.igtl.messages import (
    Message,
    NamedPoint,
    PointMessage,
    StringMessage,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.types import Point

STOP = "STOP"
"""Text of a STRING that stops the insertion, in any case of letters."""
TARGET, ENTRY = "target", "entry"
"""Beginnings of the names of points, in any case of letters: 3D Slicer names points after their list, as Target-1."""


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


def _find(points: Sequence[NamedPoint], begin: str) -> Point | None:
    """Return the first point whose name begins so."""
    return next((one.position for one in points if one.name.casefold().startswith(begin)), None)
