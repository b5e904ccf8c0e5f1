"""Server and client with one interface. Methods must be called in the event loop's thread."""

import asyncio
import os
from abc import abstractmethod
from contextlib import suppress
from typing import Self

from flexneedle.lab.igtl.connection import Frame, Log, PeerConnection, Receive
from flexneedle.lab.igtl.messages import Message

PORT = 18944
"""Registered port of OpenIGTLink."""
LATCHED = frozenset({"STATUS", "TRAJ", "POLYDATA", "POINT"})
"""Types whose last message of each device name is sent to a peer that connects."""

_RETRY_S = 1.0
_MOST_PEERS = 32


class Endpoint:
    """Connections to peers. Use it as an asynchronous context manager.

    Args:
        receive: Called with each message and the address of its peer.
        log: Called with a line for each connection, its end, refused bytes and skipped messages.
        host: Address to listen on, or to connect to.
        port: TCP port (default: 18944).
    """

    def __init__(self, receive: Receive, log: Log, host: str = "127.0.0.1", port: int = PORT) -> None:
        self.host, self.port = host, port
        self.peers: set[PeerConnection] = set()
        self._receive, self._log = receive, log
        self._latched: dict[tuple[str, str], Frame] = {}

    def send(self, message: Message) -> None:
        """Send a message to all peers. Returns at once; a slow peer gets the newest of each type and device name.

        Raises InputError if a value does not fit its field.
        """
        frame = Frame(message)
        if message.type in LATCHED:
            self._latched[frame.key] = frame
        for peer in self.peers:
            peer.offer(frame)

    @abstractmethod
    async def __aenter__(self) -> Self:
        """Open."""

    async def __aexit__(self, *_exception: object) -> None:
        peers = list(self.peers)
        for peer in peers:
            peer.close()
        await asyncio.gather(*(peer.closed for peer in peers))

    def _connect(self) -> PeerConnection:
        """Return the protocol of a new connection."""
        return PeerConnection(self._receive, self._log, self._opened)

    def _opened(self, peer: PeerConnection) -> None:
        if len(self.peers) >= _MOST_PEERS:
            self._log(f"{peer.peer}: refused: {_MOST_PEERS} peers are connected")
            peer.close()
            return
        self.peers.add(peer)
        peer.closed.add_done_callback(lambda _: self._lost(peer))
        self._log(f"{peer.peer}: connected")
        for frame in self._latched.values():
            peer.offer(frame)

    def _lost(self, peer: PeerConnection) -> None:
        self.peers.discard(peer)
        dropped = f"; {peer.dropped} frames were replaced by newer ones" if peer.dropped else ""
        self._log(f"{peer.peer}: disconnected{dropped}")


class IgtlServer(Endpoint):
    """Listens for peers. `port=0` chooses a free port; `port` is then the chosen one. Raises OSError if it is taken."""

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._connect, self.host, self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_exception: object) -> None:
        self._server.close()
        await super().__aexit__()
        await self._server.wait_closed()


class IgtlClient(Endpoint):
    """Connects to a server, as 3D Slicer or Plus, and again each second while there is no connection."""

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._keep_connected())
        return self

    async def __aexit__(self, *_exception: object) -> None:
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task
        await super().__aexit__()

    async def _keep_connected(self) -> None:
        last = ""
        while True:
            try:
                _, peer = await asyncio.get_running_loop().create_connection(
                    self._connect, self.host, self.port
                )
                last = ""
                await asyncio.shield(peer.closed)
            except OSError as error:
                why = _explain(error)
                if why != last:
                    self._log(f"{self.host}:{self.port}: no connection, trying again: {why}")
                last = why
            await asyncio.sleep(_RETRY_S)


def make_endpoint(receive: Receive, log: Log, host: str, port: int, *, connects: bool) -> Endpoint:
    """Return a client of the server at an address, or the server itself."""
    kind: type[Endpoint] = IgtlClient if connects else IgtlServer
    return kind(receive, log, host, port)


def describe_failure(host: str, port: int, error: OSError) -> str:
    """Return why a server cannot be opened."""
    return f"cannot listen on {host}, port {port}: {_explain(error)}"


def _explain(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
