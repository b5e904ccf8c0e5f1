"""One connection to a peer: newest frame of each type and device name first, received messages to a callback."""

import asyncio
import socket
from collections.abc import Callable
from typing import cast

from flexneedle.errors import make_printable
from flexneedle.lab.igtl.codec import Decoder, Query, Skipped, pack, pack_refusal
from flexneedle.lab.igtl.messages import Message

Receive = Callable[[Message, str], None]
"""Called with a message and the address of its peer, in the event loop."""
Log = Callable[[str], None]
"""Called with a line about a connection, in the event loop."""

_CHUNK = 8192  # bytes that are decoded at once: a flooding peer delays the others by little
_KERNEL_BYTES = 1 << 14  # buffer of a socket: what is in it is sent, however old
_MOST_NOTES = 20


class Frame:
    """A message, packed once per header version."""

    def __init__(self, message: Message) -> None:
        self.key = message.type, message.name
        # Metadata may not fit: InputError is raised here, not while a peer is served.
        versions = (1, 2) if message.metadata else (1,)
        self._message, self._packets = message, {version: pack(message, version) for version in versions}

    def packet(self, version: int) -> bytes:
        """Return the packet for a peer that uses this header version."""
        if version not in self._packets:
            self._packets[version] = pack(self._message, version)
        return self._packets[version]


class PeerConnection(asyncio.BufferedProtocol):
    """A connection; a frame that cannot be sent at once waits until a newer one of its key replaces it."""

    def __init__(self, receive: Receive, log: Log, opened: Callable[["PeerConnection"], None]) -> None:
        self.closed = asyncio.get_running_loop().create_future()
        self.dropped = 0  # frames that newer ones replaced
        self._receive, self._log, self._opened = receive, log, opened
        self._decoder, self._chunk = Decoder(), bytearray(_CHUNK)
        self._waiting: dict[tuple[str, str], Frame | bytes] = {}
        self._blocked = False
        self._noted: set[str] = set()

    def offer(self, frame: Frame) -> None:
        """Send a frame now, or as soon as the peer reads."""
        self._offer(frame.key, frame)

    @property
    def behind(self) -> int:
        """Frames that wait, because the peer does not read fast enough."""
        return len(self._waiting)

    def close(self) -> None:
        """Close, without waiting for a peer that does not read."""
        self._transport.abort() if self._blocked else self._transport.close()

    # asyncio

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Announce the connection."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(0)
        self._transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BYTES
        )
        host, port = self._transport.get_extra_info("peername")[:2]
        self.peer = f"{host}:{port}"
        self._opened(self)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """Drop the frames that wait."""
        self._waiting.clear()
        self.closed.set_result(None)

    def pause_writing(self) -> None:
        """Keep frames from now on."""
        self._blocked = True

    def resume_writing(self) -> None:
        """Send the frames that wait, the oldest key first."""
        self._blocked = False
        while self._waiting and not self._blocked:
            self._write(self._waiting.pop(next(iter(self._waiting))))

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002
        """Return the buffer for received bytes."""
        return self._chunk

    def buffer_updated(self, nbytes: int) -> None:
        """Pass the messages on; close the connection if the peer does not speak OpenIGTLink."""
        for one in self._decoder.feed(self._chunk[:nbytes]):
            match one:
                case Skipped(kind, name, reason):
                    self._note(f"{kind} {name!r} skipped: {reason}")
                case Query():
                    self._refuse(one)
                case message:
                    self._receive(message, self.peer)
        if self._decoder.refused and not self._transport.is_closing():
            self._log(f"{self.peer}: closed: {self._decoder.refused}")
            self._transport.abort()

    # Details

    def _offer(self, key: tuple[str, str], frame: Frame | bytes) -> None:
        if self._blocked:
            self.dropped += key in self._waiting
            self._waiting[key] = frame
        else:
            self._write(frame)

    def _write(self, frame: Frame | bytes) -> None:
        self._transport.write(frame if isinstance(frame, bytes) else frame.packet(self._decoder.version))

    def _refuse(self, query: Query) -> None:
        self._note(f"{query.type} refused: queries are not supported")
        if not query.type.startswith("GET_"):
            self._offer(("RTS", ""), pack_refusal(query))

    def _note(self, text: str) -> None:
        """Log a text once; a peer may repeat its message without end."""
        if text not in self._noted and len(self._noted) < _MOST_NOTES:
            self._noted.add(text)
            self._log(make_printable(f"{self.peer}: {text}"))
