"""The sensor `igtl`: points along the needle, or one point, that an OpenIGTLink peer sends.

POINT has one or more points along the needle; TRANSFORM and POSITION have one. Points are placed as targets are
(`placement`): by the registration of the scenario's image, or without one in the needle's frame. The points of a
`view` have column and row of a pixel as x and y.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flexneedle.errors import InputError, RigError
from flexneedle.lab.igtl.messages import Message, PointMessage, PositionMessage, TransformMessage
from flexneedle.lab.igtl.placement import describe_registration, to_needle
from flexneedle.lab.igtl.receiver import (
    DeviceName,
    DeviceReceiver,
    MessageReader,
    ReceiverSettings,
    check_status,
    check_transform,
)
from flexneedle.lab.igtl.settings import REGISTRATION
from flexneedle.lab.images.frames import ImageRegistration, registration_of
from flexneedle.lab.link.sensing import LateMs, find_late_s, read_points
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.sensors.view import View
from flexneedle.types import Point, Reading


class IgtlSensorSettings(ReceiverSettings):
    """Keys beside `name` and `kind = "igtl"` in a table `[[sensor]]` of a rig file."""

    registration: DeviceName = REGISTRATION
    """Device name of a TRANSFORM from the image to the needle's frame; another one than the scenario's is refused."""
    late_ms: LateMs | None = None
    """Time without a reading after which the status is not ok. Not set: three periods of `rate_hz`, at least 250."""


class PointsReader(MessageReader[Reading]):
    """Readings of POINT, TRANSFORM and POSITION messages. registration: of the scenario's image, None without one."""

    kinds = (PointMessage, TransformMessage, PositionMessage)

    def __init__(
        self, settings: IgtlSensorSettings, sensor: Sensor, registration: ImageRegistration | None
    ) -> None:
        super().__init__(settings)
        self._is_slice, self._in_pixels = isinstance(sensor, Slice), isinstance(sensor, View)
        self._delay = sensor.delay_s  # of the message with the least delay, if stamps are used
        self._image, self._own, self._wrong = settings.registration, registration, ""

    def read(self, message: Message, peer: str, arrival: float, connected: bool) -> Reading | None:
        """Return the reading of a message, as `MessageReader`; None after a registration that is not the scenario's."""
        if isinstance(message, TransformMessage) and message.name == self._image and not self._in_pixels:
            self._wrong = self._find_difference(message)
            return None
        reading = super().read(message, peer, arrival, connected)
        if reading is None or not self._wrong:
            return reading
        self.refused = self._wrong
        return None

    def _find_difference(self, message: TransformMessage) -> str:
        """Return why points of a peer with this registration cannot be placed, "" if they can."""
        if self._own is None:
            return "registration of the image: the scenario has no [image]"
        try:
            describe_registration(self._own, ImageRegistration.of_matrix(message.matrix))
        except InputError as error:
            return str(error)
        return ""

    def _make(self, message: PointMessage | TransformMessage | PositionMessage, time: float) -> Reading:
        try:
            points = _find_points(message)
            if self._is_slice and len(points) != 1:
                raise InputError(f"{len(points)} points: a slice has one")
            if self._in_pixels and not isinstance(message, PointMessage):
                raise InputError("no POINT: a view has the pixels of points")
        except InputError as error:
            return Reading(time - self._delay, (), str(error))
        if self._in_pixels:
            return Reading(
                time - self._delay, tuple((x, y) for x, y, _ in points), *[] if points else ["no points"]
            )
        return Reading(time - self._delay, *read_points(points, lambda point: to_needle(self._own, point)))


def _find_points(message: PointMessage | TransformMessage | PositionMessage) -> list[Point]:
    """Return the points of a message (mm). Raises InputError if it is not a measurement."""
    match message:
        case PointMessage(points=points):
            check_status(message.metadata)
            return [one.position for one in points]
        case PositionMessage(position=position):
            check_status(message.metadata)
            return [position]
    matrix = np.array(message.matrix)
    check_transform(matrix, message.metadata)
    x, y, z = matrix[:3, 3].tolist()
    return [(x, y, z)]


class IgtlSensor(DeviceReceiver[Reading]):
    """The port `NeedleSensor` of a device of a peer. Raises RunError if the port is taken."""

    noun = "reading"


def make_sensor(
    settings: Mapping[str, Any], clock: Clock, sensor: Sensor, scenario: Scenario | None = None
) -> IgtlSensor:
    """Return the sensor of the settings of a rig file, for a sensor of the scenario, with times on `clock`.

    Raises RigError for invalid settings or a kind without points, RunError if the port is taken.
    """
    if not isinstance(sensor, Points | Slice | View):
        raise RigError(
            f'{sensor.title} of the scenario has kind = "{sensor.kind}": must be points, slice or view'
        )
    given = check_settings(IgtlSensorSettings, settings)
    reader = PointsReader(given, sensor, None if scenario is None else registration_of(scenario))
    return IgtlSensor(given, reader, clock, find_late_s(given.late_ms, sensor.rate_hz))
