"""The sensor `fbgs`: curvatures that FBGS ShapeCore streams over TCP (`stream.py` has what is known of it).

A reading has the time of its arrival, less the scenario's `delay_s`. Frames that arrive together, as after a pause of
this computer, count as equally spaced since the frames before, by at most a period of the scenario's `rate_hz`. The
device's own timestamp is not used for times, because its unit and its clock are not known. A frame that has line and
timestamp of the frame before is a repetition, and no reading.
"""

import select
import socket
from collections import deque
from collections.abc import Mapping, Sequence
from threading import Event, Thread
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.errors import DriverError, make_printable
from flexneedle.lab.rig.devices.fbg.mounting import GratingSettings, SiteMap, require_fbg
from flexneedle.lab.rig.devices.fbg.stream import PORT, FibreFrame, FrameDecoder
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock
from flexneedle.scenario.sections.fields import one_line
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import VISIBLE, Reading

_CONNECT_S = 2.0
_RETRY_S = 0.5
_POLL_S = 0.1
_SILENT_S = 1.0  # without a frame, after which the connection is opened again
_CHUNK = 1 << 16
_MOST_AT_ONCE = 1 << 22  # bytes: seconds of frames with spectra
_MOST_READINGS = 1000  # that wait to be read


class FbgsSettings(GratingSettings):
    """Keys beside `name` and `kind = "fbgs"` in a table `[[sensor]]` of a rig file."""

    host: Annotated[str, Field(min_length=1, max_length=255), AfterValidator(one_line)]
    """Address of the computer with ShapeCore."""
    port: Annotated[int, Field(ge=1, le=65535)] = PORT
    """Port of the stream."""
    fibre: Annotated[int, Field(ge=0, le=255)] = 0
    """Number of the fibre in the stream; frames of others are skipped."""
    first: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of the first value used, which belongs to the first position. 1: the first value of the stream."""
    late_ms: Annotated[float, Field(ge=20, le=10_000)] = 250.0
    """Time without a reading after which the status is not ok."""


class FrameReader:
    """Readings of the frames of one fibre, with times on the clock of their arrival.

    status: reason for which the last frames were no readings, "" if they were.
    """

    def __init__(self, settings: FbgsSettings, sensor: Fbg) -> None:
        self._settings, self._sensor = settings, sensor
        self._map = SiteMap(settings.positions_mm, sensor.sites_mm, settings)
        self._last: tuple[int | None, float | None] = (None, None)
        self._arrival = -np.inf
        self.status = ""

    def read(self, frames: Sequence[FibreFrame], arrival: float) -> list[Reading]:
        """Return the readings of frames that arrived together at a time (s), later than the frames before."""
        new = [frame for frame in frames if self._is_new(frame)]
        if not new:
            return []
        step = min(1.0 / self._sensor.rate_hz, (arrival - self._arrival) / len(new))
        newest, last = arrival - self._sensor.delay_s, len(new) - 1
        self._arrival, self.status = arrival, ""
        return [self._make_reading(frame, newest - step * (last - k)) for k, frame in enumerate(new)]

    def _is_new(self, frame: FibreFrame) -> bool:
        if frame.fibre != self._settings.fibre:
            self.status = f"the stream has fibre {frame.fibre}, not {self._settings.fibre}"
            return False
        before, self._last = self._last, (frame.line, frame.stamp)
        if self._last == before != (None, None):
            self.status = "line and timestamp do not change"
            return False
        return True

    def _make_reading(self, frame: FibreFrame, time: float) -> Reading:
        if frame.error:
            return Reading(time, (), f"error {frame.error}")
        start = self._settings.first - 1
        end, have = start + len(self._settings.positions_mm), len(frame.curvature)
        if have < end:
            return Reading(time, (), f"{have} values in the stream, first and positions_mm need {end}")
        rows = self._map.to_rows(frame.bends[start:end])
        return Reading(time, rows, VISIBLE if rows else "no value is valid")


class FbgsSensor:
    """The port `NeedleSensor` of a ShapeCore stream, connected. A thread receives, and connects again after a failure.

    Raises RigError if a site is not between the gratings, DriverError if the device cannot be reached.
    """

    def __init__(self, settings: FbgsSettings, clock: Clock, sensor: Fbg) -> None:
        self._settings, self._clock = settings, clock
        self._reader = FrameReader(settings, sensor)
        self._readings = deque[Reading](maxlen=_MOST_READINGS)
        self._last, self._why = clock.now(), ""
        self._closing = Event()
        self._thread = Thread(target=self._run, args=(self._connect(),), name="FBGS", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect."""
        self._closing.set()
        self._thread.join()

    def read(self) -> tuple[Reading, ...]:
        """Return the readings since the last call, oldest first; may be empty."""
        return tuple(self._readings.popleft() for _ in range(len(self._readings)))

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, otherwise the reason in a few words."""
        silent = self._clock.now() - self._last
        if silent < 1e-3 * self._settings.late_ms:
            return VISIBLE
        return f"no reading for {silent:.1f} s: {self._reader.status or self._why}"

    # The thread

    def _run(self, connection: socket.socket | None) -> None:
        while True:
            if connection is not None:
                with connection:
                    self._why = self._receive(connection)
            if self._closing.wait(_RETRY_S):
                return
            try:
                connection = self._connect()
            except DriverError as error:
                connection, self._why = None, str(error)

    def _connect(self) -> socket.socket:
        address = self._settings.host, self._settings.port
        try:
            connection = socket.create_connection(address, timeout=_CONNECT_S)
        except (OSError, UnicodeError) as error:
            reason = make_printable(getattr(error, "strerror", None) or str(error))
            remedy = "check that ShapeCore runs and streams, and its address"
            raise DriverError("{}:{}: no connection: {}; {}".format(*address, reason, remedy)) from None
        connection.settimeout(_POLL_S)
        return connection

    def _receive(self, connection: socket.socket) -> str:
        """Take frames until the connection fails, is silent or sends no frames; return the reason."""
        decoder, last = FrameDecoder(), self._clock.now()
        self._why = "connected, no frame yet"
        while not self._closing.is_set():
            try:
                data = _receive_all(connection)
            except OSError as error:
                return f"the connection is broken: {error.strerror or error}"
            now, frames = self._clock.now(), decoder.feed(data or b"")
            if data == b"" or decoder.refused:
                return decoder.refused or "the device has closed the connection"
            if frames:
                last = now
                self._take(frames, now)
            elif now - last > _SILENT_S:
                return decoder.skipped or "the device sends nothing"
        return "closed"

    def _take(self, frames: Sequence[FibreFrame], arrival: float) -> None:
        """Keep the readings of frames that arrived together."""
        if readings := self._reader.read(frames, arrival):
            self._readings.extend(readings)
            self._last = arrival


def _receive_all(connection: socket.socket) -> bytes | None:
    """Return what has arrived, b"" at the end of the connection, None if nothing has arrived in a while."""
    try:
        data = connection.recv(_CHUNK)
    except TimeoutError:
        return None
    while data and len(data) < _MOST_AT_ONCE and select.select([connection], [], [], 0.0)[0]:
        more = connection.recv(_CHUNK)
        if not more:  # the end is found by the next call
            break
        data += more
    return data


def make_sensor(settings: Mapping[str, Any], clock: Clock, sensor: Sensor) -> FbgsSensor:
    """Return the sensor of the settings of a rig file, for a sensor of the scenario, with times on `clock`.

    Raises RigError for invalid settings, DriverError if the device cannot be reached.
    """
    return FbgsSensor(check_settings(FbgsSettings, settings), clock, require_fbg("fbgs", sensor))
