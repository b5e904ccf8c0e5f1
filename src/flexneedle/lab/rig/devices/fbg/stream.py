"""Stream of FBGS ShapeCore: frames with the curvatures along a fibre, from bytes. Without socket and time.

A frame is a uint32 length and as many bytes: a uint8 number of the fibre and fields. A field is an int32 length, which
counts the id but not itself, a uint16 id and its content. Numbers are little-endian. Contents, by id: 0 error (uint16),
1 line (uint64), 2 timestamp (double), 3 curvature, 4 angle and 6 temperature (uint32 count and as many floats), 5 shape
(uint32 width and height, and floats), 7 spectra (blocks).

FBGS publishes no description. Ids, types and lengths are from public clients (SmartNeedle/FBGS-ROS2-pipeline, whose
authors compared them with a captured frame of 15,767 bytes). These clients take curvatures in 1/mm, angles in rad, and
an error other than 0 as a frame without valid values. Unit and zero of the timestamp are not known. That an unknown id
may be skipped, and that no frame exceeds `MOST_BYTES`, is assumed. Not tried on a device.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.errors import make_printable
from flexneedle.types import Floats

PORT = 50012
"""TCP port of the stream."""
MOST_BYTES = 1 << 20
"""Longest accepted payload."""
ERROR, LINE, STAMP, CURVATURE, ANGLE = range(5)
"""Ids of the fields that are read."""
SHARPEST = 1.0
"""Curvature that no needle has, 1/mm."""

_LENGTH = struct.Struct("<I")
_FIELD = struct.Struct("<iH")
_ID_BYTES, _FLOAT_BYTES = 2, 4
_MOST_BAD = 10  # in a row: then the stream is not one of frames


class FrameError(ValueError):
    """A payload is not a frame."""


@dataclass(frozen=True, eq=False)
class FibreFrame:
    """Values of a fibre at one instant.

    Attributes:
        fibre: Number of the fibre.
        error: Error of the device, 0 for none.
        line: Number of the frame; None if it has none.
        stamp: Time stamp of the device, in an unknown unit; None if it has none.
        curvature: Curvatures (n,), 1/mm.
        angle: Directions (n,) of bending, rad.
    """

    fibre: int
    error: int
    line: int | None
    stamp: float | None
    curvature: Floats
    angle: Floats

    @property
    def bends(self) -> "np.ndarray[tuple[int], np.dtype[np.complex128]]":
        """Complex curvatures κ e^(iα), (n,), 1/mm; NaN where a value is not finite, or a radius below 1 mm."""
        fine = (np.abs(self.curvature) <= SHARPEST) & np.isfinite(self.angle)
        kappa, angle = np.where(fine, self.curvature, np.nan), np.where(fine, self.angle, 0.0)
        return kappa * np.cos(angle) + 1j * (kappa * np.sin(angle))


class FrameDecoder:
    """Frames of a stream of bytes. A payload that is not a frame is skipped, as a whole.

    Attributes:
        skipped: Rule that the last payload broke, "" after a frame.
        refused: Reason for which nothing more is decoded, "" while frames are.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._bad = 0
        self.skipped = self.refused = ""

    def feed(self, data: bytes) -> list[FibreFrame]:
        """Return the frames that the bytes complete, oldest first."""
        self._data += data
        found, at = list[FibreFrame](), 0
        while not self.refused and (end := self._end(at)) <= len(self._data):
            try:
                found.append(decode_payload(bytes(self._data[at + _LENGTH.size : end])))
                self.skipped, self._bad = "", 0
            except FrameError as error:
                self._skip(str(error))
            at = end
        if self.refused:
            self._data.clear()
        del self._data[:at]
        return found

    def _end(self, at: int) -> int:
        """Return the end of the frame that begins at a byte, or the next one to wait for."""
        if len(self._data) < at + _LENGTH.size:
            return at + _LENGTH.size
        (length,) = _LENGTH.unpack_from(self._data, at)
        if not 1 <= length <= MOST_BYTES:
            self.refused = f"a frame of {length} bytes: must be 1 to {MOST_BYTES}"
            return len(self._data) + 1
        return at + _LENGTH.size + int(length)

    def _skip(self, reason: str) -> None:
        self.skipped, self._bad = make_printable(reason), self._bad + 1
        if self._bad >= _MOST_BAD:
            self.refused = f"{_MOST_BAD} frames in a row are invalid: {self.skipped}"


def decode_payload(payload: bytes) -> FibreFrame:
    """Return the frame of a payload. Raises FrameError unless all of it is one."""
    fields: dict[int, bytes] = {}
    for kind, content in _split_fields(payload):
        if kind in fields:
            raise FrameError(f"two fields {kind}")
        fields[kind] = content
    curvature, angle = _array(fields, CURVATURE), _array(fields, ANGLE)
    if len(curvature) != len(angle):
        raise FrameError(f"{len(curvature)} curvatures and {len(angle)} angles")
    error, line, stamp = (
        _number(fields, kind, form) for kind, form in zip((ERROR, LINE, STAMP), "HQd", strict=True)
    )
    return FibreFrame(payload[0], int(error or 0), line, stamp, curvature, angle)


def _split_fields(payload: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the id and the content of each field."""
    if not payload:
        raise FrameError("empty")
    at = 1
    while at < len(payload):
        if len(payload) < at + _FIELD.size:
            raise FrameError("the last field is cut")
        length, kind = _FIELD.unpack_from(payload, at)
        start, end = at + _FIELD.size, at + _FIELD.size - _ID_BYTES + length
        if length < _ID_BYTES or end > len(payload):
            raise FrameError(f"field {kind} has a length of {length} in {len(payload)} bytes")
        yield kind, payload[start:end]
        at = end


def _number(fields: dict[int, bytes], kind: int, form: str) -> Any:
    """Return the number in a field, None without the field; form: of `struct`."""
    content = fields.get(kind)
    if content is None:
        return None
    if len(content) != struct.calcsize(f"<{form}"):
        raise FrameError(f"field {kind} has {len(content)} bytes, expected {struct.calcsize(f'<{form}')}")
    return struct.unpack(f"<{form}", content)[0]


def _array(fields: dict[int, bytes], kind: int) -> Floats:
    """Return the numbers in a field, none without the field."""
    content = fields.get(kind, bytes(_LENGTH.size))
    count = len(content) // _FLOAT_BYTES - 1
    if len(content) % _FLOAT_BYTES or count < 0 or _LENGTH.unpack_from(content)[0] != count:
        raise FrameError(f"field {kind} has {len(content)} bytes, which its count contradicts")
    return np.array(struct.unpack_from(f"<{count}f", content, _LENGTH.size))  # NumPy warns of signalling NaNs
