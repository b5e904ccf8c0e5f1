"""Packets of a stream: header, CRC, extended header and metadata.

Header versions 2 and 3 have an extended header and metadata around the content; protocol 3 writes 2. The CRC covers the
body only.
"""

import re
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

from flexneedle.errors import InputError
from flexneedle.lab.igtl.crc import crc64
from flexneedle.lab.igtl.messages import MESSAGES, Message, read_text

MOST_BYTES = 1 << 18
"""Largest body of a message that is read."""
MOST_SKIPPED = 1 << 30
"""Largest body of other types, as images; it is not stored."""

_HEADER = struct.Struct(">H12s20sQQQ")
_EXTENDED = struct.Struct(">HHII")  # own size, sizes of the metadata's index and of its texts, number
_INDEX = struct.Struct(">HHI")  # size of a key, encoding and size of a value
_UTF8 = 106
_QUERIES = ("GET_", "STT_", "STP_")
_TYPE = re.compile(rb"[!-~]+")
_SECOND = 1 << 32  # unit of time stamps


@dataclass(frozen=True)
class Query:
    """A request for a message (`GET_`), or for a series of messages (`STT_`, `STP_`)."""

    type: str
    name: str


@dataclass(frozen=True)
class Skipped:
    """A message that was not read: a type that is not supported, or contents that break a rule."""

    type: str
    name: str
    reason: str


Received = Message | Query | Skipped


def pack(message: Message, version: int = 1) -> bytes:
    """Return the packet of a message. Raises InputError if a value does not fit its field.

    version: 1, or 2 with an extended header and the metadata.
    """
    body = message.encode()
    if version > 1:
        index, texts = _encode_metadata(message)
        body = _EXTENDED.pack(_EXTENDED.size, len(index), len(texts), 0) + body + index + texts
    if len(body) > MOST_BYTES:
        raise InputError(f"{message.type} of {len(body)} bytes: must be at most {MOST_BYTES}")
    return _frame(message.type, message.name, message.time, body, version)


def pack_refusal(query: Query) -> bytes:
    """Return the answer that a query is not supported: RTS_… with status 1."""
    return _frame(f"RTS_{query.type[4:]}", query.name, 0.0, b"\1", 1)


def _frame(kind: str, name: str, time: float, body: bytes, version: int) -> bytes:
    device = name.encode()
    if len(device) > 20 or b"\0" in device:
        raise InputError(f"name = {name!r}: must have at most 20 bytes, none of them 0")
    if not 0.0 <= time < _SECOND:
        raise InputError(f"time = {time}: must be from 0 to {_SECOND} s")
    stamp = min(round(time * _SECOND), _SECOND**2 - 1)
    return _HEADER.pack(version, kind.encode(), device, stamp, len(body), crc64(body)) + body


def _encode_metadata(message: Message) -> tuple[bytes, bytes]:
    pairs = [(key.encode(), value.encode()) for key, value in message.metadata.items()]
    try:
        entries = [_INDEX.pack(len(key), _UTF8, len(value)) for key, value in pairs]
        index = struct.pack(">H", len(pairs)) + b"".join(entries)
    except struct.error as error:
        raise InputError("metadata: at most 65535 keys, each of at most 65535 bytes") from error
    if len(index) >= 1 << 16:
        raise InputError(f"metadata of {len(pairs)} keys: must be at most {(1 << 13) - 1}")
    return index, b"".join(key + value for key, value in pairs)


class _Header(NamedTuple):
    version: int
    type: str
    name: str
    time: float
    size: int
    crc: int

    @property
    def is_known(self) -> bool:
        """True for what is read: a message, or a query."""
        return self.type in MESSAGES or self.type.startswith(_QUERIES)


class _Garbage(Exception):
    """Bytes that are not OpenIGTLink."""


class Decoder:
    """Messages of a stream, which may be cut anywhere.

    Attributes:
        version: 2 after a header of version 2 or 3, else 1.
        refused: Why the stream is not OpenIGTLink, in one line, or "". No more is read, as the next header is unknown.
    """

    def __init__(self) -> None:
        self.version, self.refused = 1, ""
        self._data, self._skip = bytearray(), 0

    def feed(self, data: bytes | bytearray) -> list[Received]:
        """Return the messages that are complete with these bytes."""
        found: list[Received] = []
        if self.refused:
            return found
        self._data += data
        try:
            while (one := self._next()) is not None:
                found.append(one)
        except _Garbage as garbage:
            self.refused = str(garbage)
            self._data.clear()
        return found

    def _next(self) -> Received | None:
        skip = min(self._skip, len(self._data))
        del self._data[:skip]
        self._skip -= skip
        if self._skip or len(self._data) < _HEADER.size:
            return None
        header = self._read_header()
        if not header.is_known:
            self._skip = _HEADER.size + header.size
            return Skipped(header.type, header.name, "not supported")
        return self._read_body(header)

    def _read_header(self) -> _Header:
        version, kind, name, stamp, size, crc = _HEADER.unpack_from(self._data)
        kind = kind.rstrip(b"\0")
        if not 1 <= version <= 3:
            raise _Garbage(f"header version {version}: must be 1 to 3")
        if not _TYPE.fullmatch(kind):
            raise _Garbage(f"type {kind!r}: must be ASCII")
        header = _Header(version, kind.decode(), read_text(name), stamp / _SECOND, size, crc)
        if size > (most := MOST_BYTES if header.is_known else MOST_SKIPPED):
            raise _Garbage(f"{header.type} of {size} bytes: must be at most {most}")
        self.version = max(self.version, min(version, 2))
        return header

    def _read_body(self, header: _Header) -> Received | None:
        end = _HEADER.size + header.size
        if len(self._data) < end:
            return None
        body = bytes(self._data[_HEADER.size : end])
        if crc64(body) != header.crc:
            raise _Garbage(f"{header.type} of {header.size} bytes: the CRC does not match")
        del self._data[:end]
        if header.type not in MESSAGES:
            return Query(header.type, header.name)
        try:
            return _decode(header, body)
        except InputError as error:
            return Skipped(header.type, header.name, str(error))


def _decode(header: _Header, body: bytes) -> Message:
    metadata: dict[str, str] = {}
    if header.version > 1:
        body, metadata = _split(body)
    values: dict[str, Any] = {"name": header.name, "time": header.time, "metadata": metadata}
    return MESSAGES[header.type].decode(body, **values)


def _split(body: bytes) -> tuple[bytes, dict[str, str]]:
    """Return content and metadata of a body with an extended header."""
    if len(body) < _EXTENDED.size:
        raise InputError(f"{len(body)} bytes: an extended header has {_EXTENDED.size}")
    begin, index, texts, _ = _EXTENDED.unpack_from(body)
    end = len(body) - index - texts
    if not _EXTENDED.size <= begin <= end:
        raise InputError("extended header: sizes must be within the body")
    return body[begin:end], _decode_metadata(body[end : end + index], body[end + index :])


def _decode_metadata(index: bytes, texts: bytes) -> dict[str, str]:
    if not index and not texts:
        return {}
    if len(index) % _INDEX.size != 2 or int.from_bytes(index[:2], "big") != len(index) // _INDEX.size:
        raise InputError("metadata: the index must have the number of keys that it states")
    found, at = {}, 0
    for key, _, value in _INDEX.iter_unpack(index[2:]):
        name = texts[at : at + key].decode(errors="replace")
        found[name] = texts[at + key : at + key + value].decode(errors="replace")
        at += key + value
    if at != len(texts):
        raise InputError("metadata: keys and values must have the sizes that the index states")
    return found
