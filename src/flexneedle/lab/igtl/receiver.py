"""Measurements that an OpenIGTLink peer sends as messages of one device: settings, checks and the connection."""

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from math import hypot
from threading import Thread
from time import monotonic
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.errors import InputError, RunError
from flexneedle.lab.igtl.endpoint import PORT, Endpoint, describe_failure, make_endpoint
from flexneedle.lab.igtl.messages import Message
from flexneedle.lab.images.frames import check_rotation
from flexneedle.lab.link.stamps import StampClock
from flexneedle.ports import Clock
from flexneedle.scenario.sections.fields import Section, one_line
from flexneedle.types import FARTHEST_MM, VISIBLE, Floats, Frame, Reading

_MOST_ITEMS = 1000  # that wait to be read: seconds of the fastest tracker
_STATUS, _GOOD = "Status", "OK"

HostName = Annotated[str, Field(min_length=1, max_length=255), AfterValidator(one_line)]
DeviceName = Annotated[str, Field(min_length=1, max_length=20), AfterValidator(one_line)]
Item = TypeVar("Item", Frame, Reading)


class ReceiverSettings(Section):
    """Settings of the device of a peer, and of the connection."""

    device: DeviceName
    """Device name of the messages."""
    host: HostName = "127.0.0.1"
    """Address of the server to connect to, or with `listen` to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = PORT
    """Port of the server."""
    listen: bool = False
    """Be the server, to which the program that measures connects."""
    stamps: bool = True
    """Take times from the stamps of messages. False: from their arrival; old data is then not recognised."""


class MessageReader(ABC, Generic[Item]):
    """Items of the messages of one device, from one peer at a time.

    A message is refused, with the reason in `refused`, if its stamp is old or missing, or if another peer sends the
    device.
    """

    kinds: ClassVar[tuple[type[Message], ...]]
    """Types of messages that are read."""

    def __init__(self, settings: ReceiverSettings) -> None:
        self._device, self._uses_stamps = settings.device, settings.stamps
        self._stamps, self._source = StampClock(), ""
        self.refused, self.number = "", 0

    def read(self, message: Message, peer: str, arrival: float, connected: bool) -> Item | None:
        """Return the item of a message, with its time on the clock of `arrival` (s); None if it is not accepted.

        connected: whether the peer of the last item still is.
        """
        if not (isinstance(message, self.kinds) and message.name == self._device):
            return None
        self.number += 1
        try:
            self._check_peer(peer, connected)
            time = self._stamps.to_time(message.time, arrival) if self._uses_stamps else arrival
        except InputError as error:
            self.refused = str(error)
            return None
        return self._make(message, time)

    @property
    def source(self) -> str:
        """The peer whose messages are read, "" before the first."""
        return self._source

    def _check_peer(self, peer: str, connected: bool) -> None:
        if peer == self._source:
            return
        if connected:
            raise InputError(f"{self._source} and {peer} send {self._device}: must be one")
        self._source, self._stamps = peer, StampClock()

    @abstractmethod
    def _make(self, message: Any, time: float) -> Item:
        """Return the item of a message of `kinds`; one without a measurement has the reason as its status."""


def check_status(metadata: Mapping[str, str]) -> None:
    """Raise InputError if the metadata of a message state that it is not a measurement."""
    for key, value in metadata.items():
        if key.endswith(_STATUS) and value != _GOOD:
            raise InputError(f"{key} {value}")


def check_transform(matrix: Floats, metadata: Mapping[str, str]) -> None:
    """Raise InputError for a transform that is not a measurement."""
    check_status(metadata)
    if np.array_equal(matrix, np.eye(4)):
        raise InputError("missing (the transform is the identity)")
    check_rotation("transform", matrix[:3, :3])
    if hypot(*matrix[:3, 3]) > FARTHEST_MM:
        raise InputError("its position is beyond 10 m")


class DeviceReceiver(Generic[Item]):
    """Items of one device of a peer, with times on `clock`. Raises RunError if the port is taken.

    A thread keeps the connection, and connects again. A message is never returned twice, nor after a newer one.

    late_s: time without an item after which the status is not ok.
    """

    noun = "item"

    def __init__(
        self, settings: ReceiverSettings, reader: MessageReader[Item], clock: Clock, late_s: float
    ) -> None:
        self._late = late_s
        self._offset = clock.now() - monotonic()
        self._reader: MessageReader[Item] = reader
        self._items: deque[Item] = deque(maxlen=_MOST_ITEMS)
        self._last, self._line = monotonic(), "not connected"
        self._endpoint: Endpoint = make_endpoint(
            self._receive, self._log, settings.host, settings.port, connects=not settings.listen
        )
        self._loop, self._closing = asyncio.new_event_loop(), asyncio.Event()
        opened: Future[None] = Future()
        self._thread = Thread(target=self._run, args=(opened,), name="OpenIGTLink", daemon=True)
        self._thread.start()
        opened.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join()

    def read(self) -> tuple[Item, ...]:
        """Return the items since the last call, oldest first; may be empty."""
        found = []
        while self._items:
            found.append(self._items.popleft())
        return tuple(found)

    @property
    def status(self) -> str:
        """VISIBLE while items arrive, otherwise the reason in a few words."""
        silent = monotonic() - self._last
        if silent < self._late:
            return VISIBLE
        return self._reader.refused or f"no {self.noun} for {silent:.1f} s ({self._line})"

    @property
    def port(self) -> int:
        """The server's port."""
        return self._endpoint.port

    # The thread

    def _run(self, opened: Future[None]) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._keep_open(opened))

    async def _keep_open(self, opened: Future[None]) -> None:
        """Keep the connection until the end; opened: its result is set when peers can connect, or cannot."""
        try:
            async with self._endpoint:
                opened.set_result(None)
                await self._closing.wait()
        except OSError as error:
            opened.set_exception(RunError(describe_failure(self._endpoint.host, self.port, error)))

    def _receive(self, message: Message, peer: str) -> None:
        connected = self._reader.source in {one.peer for one in self._endpoint.peers}
        item = self._reader.read(message, peer, monotonic(), connected)
        if item is not None:
            self._items.append(replace(item, time=item.time + self._offset))
            self._last, self._reader.refused = monotonic(), ""

    def _log(self, line: str) -> None:
        self._line = line
