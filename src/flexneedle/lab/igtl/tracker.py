"""The tracker `igtl`: a sensor whose TRANSFORM an OpenIGTLink peer sends, such as a Plus server."""

import asyncio
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from math import hypot
from threading import Thread
from time import monotonic
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.errors import InputError, RunError
from flexneedle.geometry.quaternion import along, from_matrix, product
from flexneedle.lab.igtl.endpoint import PORT, Endpoint, describe_failure, make_endpoint
from flexneedle.lab.igtl.messages import Message, TransformMessage
from flexneedle.lab.images.frames import check_rotation
from flexneedle.lab.link.fields import AxisName, DeviceAge, make_unit
from flexneedle.lab.link.stamps import StampClock
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock
from flexneedle.scenario.sections.fields import Section, one_line
from flexneedle.types import FARTHEST_MM, TIP, VISIBLE, Floats, Frame, SensorReading

_MOST_FRAMES = 1000  # that wait to be read: seconds of the fastest tracker
_STATUS, _GOOD = "Status", "OK"

HostName = Annotated[str, Field(min_length=1, max_length=255), AfterValidator(one_line)]
DeviceName = Annotated[str, Field(min_length=1, max_length=20), AfterValidator(one_line)]


class IgtlTrackerSettings(Section):
    """Settings beside `kind = "igtl"` in the section `tracker`."""

    device: DeviceName
    """Device name of the TRANSFORM of the needle's sensor."""
    host: HostName = "127.0.0.1"
    """Address of the server to connect to, or with `listen` to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = PORT
    """Port of the server."""
    listen: bool = False
    """Be the server, to which the tracker's program connects."""
    axis: AxisName | None = None
    """Axis of the sensor along the needle, towards the tip. Not set: no direction is measured."""
    stamps: bool = True
    """Take times from the stamps of messages. False: from their arrival; old data is then not recognised."""
    late_ms: DeviceAge = 250.0
    """Time without a frame after which the tracker's status is not ok."""


class TransformReader:
    """Frames of the TRANSFORM messages of one device, from one peer at a time.

    A message is refused, with the reason in `refused`, if its stamp is old or missing, or if another peer sends the
    device. A message without a valid transform gives a frame without a position.
    """

    def __init__(self, settings: IgtlTrackerSettings) -> None:
        self._settings = settings
        self._stamps, self._source = StampClock(), ""
        self._turn = None if settings.axis is None else along(np.array(make_unit(settings.axis)))
        self.refused, self.number = "", 0

    def read(self, message: Message, peer: str, arrival: float, connected: bool) -> Frame | None:
        """Return the frame of a message, with its time on the clock of `arrival` (s); None if it is not accepted.

        connected: whether the peer of the last frame still is.
        """
        if not (isinstance(message, TransformMessage) and message.name == self._settings.device):
            return None
        self.number += 1
        try:
            self._check_peer(peer, connected)
            time = self._stamps.to_time(message.time, arrival) if self._settings.stamps else arrival
        except InputError as error:
            self.refused = str(error)
            return None
        return Frame(time, self.number, {TIP: self._make_reading(message)})

    @property
    def source(self) -> str:
        """The peer whose messages are read, "" before the first."""
        return self._source

    def _check_peer(self, peer: str, connected: bool) -> None:
        if peer == self._source:
            return
        if connected:
            raise InputError(f"{self._source} and {peer} send {self._settings.device}: must be one")
        self._source, self._stamps = peer, StampClock()

    def _make_reading(self, message: TransformMessage) -> SensorReading:
        matrix = np.array(message.matrix)
        try:
            _check_transform(matrix, message.metadata)
        except InputError as error:
            return SensorReading(None, status=str(error))
        x, y, z = matrix[:3, 3].tolist()
        if self._turn is None:
            return SensorReading((x, y, z))
        a, b, c, d = product(from_matrix(matrix[:3, :3]), self._turn).tolist()
        return SensorReading((x, y, z), (a, b, c, d))


def _check_transform(matrix: Floats, metadata: Mapping[str, str]) -> None:
    """Raise InputError for a transform that is not a measurement."""
    for key, value in metadata.items():
        if key.endswith(_STATUS) and value != _GOOD:
            raise InputError(f"{key} {value}")
    if np.array_equal(matrix, np.eye(4)):
        raise InputError("missing (the transform is the identity)")
    check_rotation("transform", matrix[:3, :3])
    if hypot(*matrix[:3, 3]) > FARTHEST_MM:
        raise InputError("its position is beyond 10 m")


class IgtlTracker:
    """A tracker with one sensor, the tip, in the frame of the peer. Raises RunError if the port is taken.

    A thread keeps the connection, and connects again. A message is never returned twice, nor after a newer one.
    """

    def __init__(self, settings: IgtlTrackerSettings, clock: Clock) -> None:
        self._late = 1e-3 * settings.late_ms
        self._offset = clock.now() - monotonic()
        self._reader, self._frames = TransformReader(settings), deque[Frame](maxlen=_MOST_FRAMES)
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

    def read(self) -> tuple[Frame, ...]:
        """Return the frames since the last call, oldest first; may be empty."""
        found = []
        while self._frames:
            found.append(self._frames.popleft())
        return tuple(found)

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, otherwise the reason in a few words."""
        silent = monotonic() - self._last
        if silent < self._late:
            return VISIBLE
        return self._reader.refused or f"no frame for {silent:.1f} s ({self._line})"

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
        frame = self._reader.read(message, peer, monotonic(), connected)
        if frame is not None:
            self._frames.append(replace(frame, time=frame.time + self._offset))
            self._last, self._reader.refused = monotonic(), ""

    def _log(self, line: str) -> None:
        self._line = line


def make_tracker(settings: Mapping[str, Any], clock: Clock) -> IgtlTracker:
    """Return the tracker of the settings of a rig file, with times on `clock`.

    Raises RigError for invalid settings, RunError if the port is taken.
    """
    return IgtlTracker(check_settings(IgtlTrackerSettings, settings), clock)
