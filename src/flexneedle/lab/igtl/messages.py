"""Messages and the byte layouts of their contents, without header and CRC.

Layouts: openigtlink.org, protocol 3 (2017), whose contents equal version 1 and 2. Lengths in mm, RAS; numbers are
32-bit floats on the wire. `encode` and `decode` raise InputError for contents that break a rule.
"""

import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import isfinite
from typing import Any, ClassVar, Self

from flexneedle.errors import InputError
from flexneedle.types import Matrix, Point, Quaternion

Color = tuple[int, int, int, int]
"""Red, green, blue, opacity, 0 to 255."""

_YELLOW: Color = (255, 255, 0, 255)
_ASCII, _UTF8 = 3, 106  # IANA MIBenum
_BOTTOM = (0.0, 0.0, 0.0, 1.0)
_STATUS = struct.Struct(">Hq20s")
_POINT = struct.Struct(">64s32s4B4f20s")
_TRAJECTORY = struct.Struct(">64s32sBx4B7f20s")
_POLYDATA = struct.Struct(">10I")
_ENTRY, _TARGET = 1, 2  # bits of the type of a trajectory


@dataclass(frozen=True, kw_only=True)
class Message(ABC):
    """A message.

    Args:
        name: Device name, at most 20 bytes; receivers show one object per type and name.
        time: Seconds since 1970, 0 if unknown.
        metadata: Texts by key; sent to peers that use header version 2.
    """

    type: ClassVar[str]
    name: str
    time: float = 0.0
    metadata: Mapping[str, str] = field(default_factory=dict)

    @abstractmethod
    def encode(self) -> bytes:
        """Return the content."""

    @classmethod
    @abstractmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the message of a content; header: name, time and metadata."""


@dataclass(frozen=True, kw_only=True)
class TransformMessage(Message):
    """A transform to RAS as a 4×4 matrix, whose last row must be 0, 0, 0, 1."""

    type = "TRANSFORM"
    matrix: Matrix

    def encode(self) -> bytes:
        """Return columns of the upper three rows."""
        rows = self.matrix
        if [len(row) for row in rows] != [4] * 4 or tuple(rows[3]) != _BOTTOM:
            raise InputError(f"matrix = {rows}: must have 4 rows of 4, the last 0, 0, 0, 1")
        return _floats(list(chain.from_iterable(zip(*rows[:3], strict=True))))

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the transform."""
        values = _read_floats(content, 12)
        return cls(matrix=(values[0::3], values[1::3], values[2::3], _BOTTOM), **header)


@dataclass(frozen=True, kw_only=True)
class PositionMessage(Message):
    """A position (mm) and an orientation (quaternion w, x, y, z)."""

    type = "POSITION"
    position: Point
    orientation: Quaternion

    def encode(self) -> bytes:
        """Return the position, and the quaternion with w last."""
        w, *xyz = self.orientation
        return _floats([*self.position, *xyz, w])

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return position and orientation."""
        x, y, z, qx, qy, qz, w = _read_floats(content, 7)
        return cls(position=(x, y, z), orientation=(w, qx, qy, qz), **header)


@dataclass(frozen=True, kw_only=True)
class NamedPoint:
    """One point of a POINT message."""

    name: str
    position: Point
    group: str = ""
    color: Color = _YELLOW
    diameter: float = 0.0
    owner: str = ""


@dataclass(frozen=True, kw_only=True)
class PointMessage(Message):
    """A list of points."""

    type = "POINT"
    points: tuple[NamedPoint, ...]

    def encode(self) -> bytes:
        """Return 136 bytes a point."""
        return b"".join(map(_encode_point, self.points))

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the points."""
        return cls(points=tuple(map(_decode_point, _iterate(_POINT, content))), **header)


def _encode_point(point: NamedPoint) -> bytes:
    name, group, owner = _text(point.name, 64), _text(point.group, 32), _text(point.owner, 20)
    return name + group + _color(point.color) + _floats([*point.position, point.diameter]) + owner


def _decode_point(values: Sequence[Any]) -> NamedPoint:
    name, group, *rest, owner = values
    x, y, z, diameter = _finite(rest[4:])
    return NamedPoint(
        name=read_text(name),
        position=(x, y, z),
        group=read_text(group),
        color=(rest[0], rest[1], rest[2], rest[3]),
        diameter=diameter,
        owner=read_text(owner),
    )


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One trajectory of a TRAJ message, with an entry, a target or both.

    The C++ library sends both points as type 2, target only, unless its caller sets the type; therefore a point that
    the type excludes is read unless it is 0, 0, 0.
    """

    name: str
    entry: Point | None
    target: Point | None
    group: str = ""
    color: Color = _YELLOW
    radius: float = 0.0
    owner: str = ""


@dataclass(frozen=True, kw_only=True)
class TrajectoryMessage(Message):
    """A list of trajectories."""

    type = "TRAJ"
    trajectories: tuple[Trajectory, ...]

    def encode(self) -> bytes:
        """Return 150 bytes a trajectory."""
        return b"".join(map(_encode_trajectory, self.trajectories))

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the trajectories."""
        return cls(trajectories=tuple(map(_decode_trajectory, _iterate(_TRAJECTORY, content))), **header)


def _encode_trajectory(one: Trajectory) -> bytes:
    kind = _ENTRY * (one.entry is not None) + _TARGET * (one.target is not None)
    _check_kind(kind)
    origin = (0.0, 0.0, 0.0)
    lengths = _floats([*(one.entry or origin), *(one.target or origin), one.radius])
    head = _text(one.name, 64) + _text(one.group, 32) + bytes([kind, 0]) + _color(one.color)
    return head + lengths + _text(one.owner, 20)


def _decode_trajectory(values: Sequence[Any]) -> Trajectory:
    name, group, kind, *rest, owner = values
    _check_kind(kind)
    *ends, radius = _finite(rest[4:])
    entry, target = (ends[0], ends[1], ends[2]), (ends[3], ends[4], ends[5])
    return Trajectory(
        name=read_text(name),
        entry=entry if kind & _ENTRY or any(entry) else None,
        target=target if kind & _TARGET or any(target) else None,
        group=read_text(group),
        color=(rest[0], rest[1], rest[2], rest[3]),
        radius=radius,
        owner=read_text(owner),
    )


def _check_kind(kind: int) -> None:
    if not 1 <= kind <= _ENTRY | _TARGET:
        raise InputError(f"trajectory of type {kind}: must have an entry (1), a target (2) or both (3)")


@dataclass(frozen=True, kw_only=True)
class PolylineMessage(Message):
    """A curve through at least two points (mm), as POLYDATA with one line and nothing else."""

    type = "POLYDATA"
    points: tuple[Point, ...]

    def encode(self) -> bytes:
        """Return the header of 40 bytes, the points, and the line."""
        count = len(self.points)
        if count < 2:
            raise InputError(f"{count} points: a line must have at least 2")
        head = _POLYDATA.pack(count, 0, 0, 1, 4 * (count + 1), 0, 0, 0, 0, 0)
        line = struct.pack(f">{count + 1}I", count, *range(count))
        return head + _floats(list(chain.from_iterable(self.points))) + line

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the points in the order of the line."""
        if len(content) < _POLYDATA.size:
            raise InputError(f"{len(content)} bytes: must be at least {_POLYDATA.size}")
        count, vertices, _, lines, size, *others = _POLYDATA.unpack_from(content)
        begin = _POLYDATA.size + 12 * count
        if vertices or lines != 1 or any(others) or size < 12 or size % 4 or len(content) != begin + size:
            raise InputError("must be one line and nothing else")
        values = _read_floats(content[_POLYDATA.size : begin], 3 * count)
        length, *line = struct.unpack_from(f">{size // 4}I", content, begin)
        if length != len(line) or max(line) >= count:
            raise InputError("the line has another length than stated, or a point that is missing")
        points = list(zip(values[0::3], values[1::3], values[2::3], strict=True))
        return cls(points=tuple(points[one] for one in line), **header)


@dataclass(frozen=True, kw_only=True)
class StatusMessage(Message):
    """A status: code (1: OK, 2 to 19: kinds of errors), own subcode, name of the error, text."""

    type = "STATUS"
    code: int
    subcode: int = 0
    error: str = ""
    text: str = ""

    def encode(self) -> bytes:
        """Return 30 bytes, and the text with a zero byte at its end."""
        if not (0 < self.code < 1 << 16 and -(1 << 63) <= self.subcode < 1 << 63):
            raise InputError(f"code = {self.code}, subcode = {self.subcode}: must fit 16 and 64 bits")
        text = self.text.encode()
        return (
            _STATUS.pack(self.code, self.subcode, _text(self.error, 20)) + _text(self.text, len(text)) + b"\0"
        )

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the status."""
        if len(content) < _STATUS.size:
            raise InputError(f"{len(content)} bytes: must be at least {_STATUS.size}")
        code, subcode, error = _STATUS.unpack_from(content)
        text = read_text(content[_STATUS.size :])
        return cls(code=code, subcode=subcode, error=read_text(error), text=text, **header)


@dataclass(frozen=True, kw_only=True)
class StringMessage(Message):
    """A text of at most 65,535 bytes, ASCII where possible, else UTF-8."""

    type = "STRING"
    text: str

    def encode(self) -> bytes:
        """Return encoding, length and text."""
        data = self.text.encode()
        if len(data) >= 1 << 16:
            raise InputError(f"text of {len(data)} bytes: must be at most 65535")
        return struct.pack(">HH", _ASCII if self.text.isascii() else _UTF8, len(data)) + data

    @classmethod
    def decode(cls, content: bytes, **header: Any) -> Self:
        """Return the text."""
        encoding, length = struct.unpack(">HH", content[:4]) if len(content) >= 4 else (0, 0)
        if encoding not in (_ASCII, _UTF8) or length != len(content) - 4:
            raise InputError("must have encoding 3 (ASCII) or 106 (UTF-8), and the length that it states")
        return cls(text=content[4:].decode(errors="replace"), **header)


MESSAGES: Mapping[str, type[Message]] = {
    kind.type: kind
    for kind in (
        TransformMessage,
        PositionMessage,
        PointMessage,
        TrajectoryMessage,
        PolylineMessage,
        StatusMessage,
        StringMessage,
    )
}
"""Messages by type."""


def _text(text: str, size: int) -> bytes:
    data = text.encode()
    if len(data) > size or b"\0" in data:
        raise InputError(f"{text!r}: must have at most {size} bytes, none of them 0")
    return data.ljust(size, b"\0")


def read_text(data: bytes) -> str:
    """Return the text of a field up to its first zero byte; bytes that are no UTF-8 are replaced."""
    return data.partition(b"\0")[0].decode(errors="replace")


def _color(color: Color) -> bytes:
    if not all(0 <= part <= 255 for part in color):
        raise InputError(f"color = {color}: must be four numbers from 0 to 255")
    return bytes(color)


def _floats(values: Sequence[float]) -> bytes:
    try:
        return struct.pack(f">{len(values)}f", *_finite(values))
    except OverflowError as error:
        raise InputError(f"{max(values, key=abs)}: must fit 32 bits") from error


def _read_floats(data: bytes, count: int) -> tuple[float, ...]:
    if len(data) != 4 * count:
        raise InputError(f"{len(data)} bytes: must be {4 * count}")
    return tuple(_finite(struct.unpack(f">{count}f", data)))


def _finite(values: Sequence[float]) -> Sequence[float]:
    if not all(map(isfinite, values)):
        raise InputError("numbers must be finite")
    return values


def _iterate(layout: struct.Struct, content: bytes) -> Iterable[Sequence[Any]]:
    if len(content) % layout.size:
        raise InputError(f"{len(content)} bytes: must be a multiple of {layout.size}")
    return layout.iter_unpack(content)
