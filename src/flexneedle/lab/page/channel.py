"""What the server and a worker write to each other's pipes: a length (u32, little-endian) and as many bytes.

A message is a text (a JSON object, so that it opens with a brace) or a frame (`page/frames.py`, which opens with its
kind, a small number).
"""

import asyncio
import struct
from typing import BinaryIO

from flexneedle.errors import RunError

Message = str | bytes
LONGEST = 64_000_000
"""Bytes of the longest message: a recorded insertion, all at once."""
_LENGTH = struct.Struct("<I")
_BRACE = b"{"


def packed(message: Message) -> bytes:
    """The bytes of a message in a pipe."""
    data = message.encode() if isinstance(message, str) else message
    return _LENGTH.pack(len(data)) + data


def read(pipe: BinaryIO) -> Message | None:
    """The next message of a pipe, None at its end. Raises RunError for bytes that are no message."""
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    length = _length(head)
    data = pipe.read(length)
    return _unpacked(data) if len(data) == length else None


async def received(pipe: asyncio.StreamReader) -> Message | None:
    """The next message of a pipe, as `read`."""
    try:
        length = _length(await pipe.readexactly(_LENGTH.size))
        return _unpacked(await pipe.readexactly(length))
    except asyncio.IncompleteReadError:
        return None


def _length(head: bytes) -> int:
    length: int = _LENGTH.unpack(head)[0]
    if not 0 < length <= LONGEST:
        raise RunError(f"a message of {length} bytes: must have 1 to {LONGEST}")
    return length


def _unpacked(data: bytes) -> Message:
    try:
        return data.decode() if data.startswith(_BRACE) else data
    except UnicodeDecodeError as error:
        raise RunError(f"a message that is not UTF-8: {error.reason}") from None
