r"""Commands, replies and checksums of NDI's serial protocol (Combined API); without state or device.

A command is ASCII, `NAME:argumentsCRC\r`, or `NAME arguments\r` without a checksum. A reply is text, checksum and
`\r`, or binary with a header (`BX`). The layouts are from ndicapi's sources.
"""

import re
import struct
from dataclasses import dataclass
from math import copysign, inf, isfinite, isnan

from flexneedle.lab.emulators.motion import EmulatedPose

_BINARY_START = 0xA5C4
_POLYNOMIAL = 0xA001  # x^16 + x^15 + x^2 + 1, lowest bit first
_CRC_DIGITS = 4
_LARGEST = 3.4e38  # single precision


def _divide(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ (_POLYNOMIAL if byte & 1 else 0)
    return byte


_TABLE = tuple(map(_divide, range(256)))  # per byte: a reply has about 200


@dataclass(frozen=True)
class AuroraCommand:
    """A received command; intact is False if its checksum is wrong."""

    name: str
    arguments: str
    intact: bool = True


def crc16(data: bytes) -> int:
    """Return the checksum of the protocol (CRC-16/ARC: starts at 0)."""
    crc = 0
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def parse_command(line: bytes) -> AuroraCommand:
    r"""Return the command in a line without its `\r`; bytes outside ASCII are replaced."""
    name = re.split(rb"[: ]", line, maxsplit=1)[0].decode("ascii", "replace")
    rest = line[len(name) :]
    if not rest.startswith(b":"):
        return AuroraCommand(name, rest[1:].decode("ascii", "replace"))
    body, checksum = line[:-_CRC_DIGITS], line[-_CRC_DIGITS:]
    intact = len(rest) > _CRC_DIGITS and checksum.upper() == b"%04X" % crc16(body)
    return AuroraCommand(name, body[len(name) + 1 :].decode("ascii", "replace"), intact)


def encode_text(reply: str) -> bytes:
    """Return a text reply with checksum and end."""
    body = reply.encode("ascii")
    return body + b"%04X\r" % crc16(body)


def encode_binary(body: bytes) -> bytes:
    """Return a binary reply: start, length and their checksum, then body and its checksum, little endian."""
    header = struct.pack("<HH", _BINARY_START, len(body))
    return header + struct.pack("<H", crc16(header)) + body + struct.pack("<H", crc16(body))


def encode_pose_text(pose: EmulatedPose) -> str:
    """Return a pose in the format of `TX`: quaternion and indicator to 1e-4, position to 0.01 mm.

    A value that is not a number, or for which the format has too few digits, is `nan`.
    """
    orientation = "".join(_format_digits(part, 10_000, 6) for part in pose.orientation)
    position = "".join(_format_digits(part, 100, 7) for part in pose.position)
    return f"{orientation}{position}{_format_digits(pose.indicator, 10_000, 6)}"


def _format_digits(value: float, parts: int, width: int) -> str:
    fits = isfinite(value) and abs(round(value * parts)) < 10 ** (width - 1)
    return f"{round(value * parts):+0{width}d}" if fits else f"{'nan':>{width}}"


def encode_pose_binary(pose: EmulatedPose) -> bytes:
    """Return a pose in the format of `BX`: eight single-precision numbers; a value too large for one is infinite."""
    values = (*pose.orientation, *pose.position, pose.indicator)
    return struct.pack(
        "<8f", *(value if isnan(value) or abs(value) < _LARGEST else copysign(inf, value) for value in values)
    )
