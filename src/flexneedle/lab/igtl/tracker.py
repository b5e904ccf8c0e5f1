"""The tracker `igtl`: a sensor whose TRANSFORM an OpenIGTLink peer sends, such as a Plus server."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import along, from_matrix, product
from flexneedle.lab.igtl.messages import TransformMessage
from flexneedle.lab.igtl.receiver import DeviceReceiver, MessageReader, ReceiverSettings, check_transform
from flexneedle.lab.link.fields import AxisName, DeviceAge, make_unit
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock
from flexneedle.types import TIP, Frame, SensorReading


class IgtlTrackerSettings(ReceiverSettings):
    """Settings beside `kind = "igtl"` in the section `tracker`."""

    axis: AxisName | None = None
    """Axis of the sensor along the needle, towards the tip. Not set: no direction is measured."""
    late_ms: DeviceAge = 250.0
    """Time without a frame after which the tracker's status is not ok."""


class TransformReader(MessageReader[Frame]):
    """Frames of TRANSFORM messages. One without a valid transform gives a frame without a position."""

    kinds = (TransformMessage,)

    def __init__(self, settings: IgtlTrackerSettings) -> None:
        super().__init__(settings)
        self._turn = None if settings.axis is None else along(np.array(make_unit(settings.axis)))

    def _make(self, message: TransformMessage, time: float) -> Frame:
        return Frame(time, self.number, {TIP: self._make_reading(message)})

    def _make_reading(self, message: TransformMessage) -> SensorReading:
        matrix = np.array(message.matrix)
        try:
            check_transform(matrix, message.metadata)
        except InputError as error:
            return SensorReading(None, status=str(error))
        x, y, z = matrix[:3, 3].tolist()
        if self._turn is None:
            return SensorReading((x, y, z))
        a, b, c, d = product(from_matrix(matrix[:3, :3]), self._turn).tolist()
        return SensorReading((x, y, z), (a, b, c, d))


class IgtlTracker(DeviceReceiver[Frame]):
    """A tracker with one sensor, the tip, in the frame of the peer. Raises RunError if the port is taken."""

    noun = "frame"


def make_tracker(settings: Mapping[str, Any], clock: Clock) -> IgtlTracker:
    """Return the tracker of the settings of a rig file, with times on `clock`.

    Raises RigError for invalid settings, RunError if the port is taken.
    """
    given = check_settings(IgtlTrackerSettings, settings)
    return IgtlTracker(given, TransformReader(given), clock, 1e-3 * given.late_ms)
