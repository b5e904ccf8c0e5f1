"""Map from a tracker's frames to the tip of the needle in the plane of the insertion."""

import numpy as np

from flexneedle.rig.ports import Tracker
from flexneedle.rig.tracking.quaternion import z_axis
from flexneedle.rig.tracking.registration import Rigid
from flexneedle.rig.tracking.table import TIP
from flexneedle.types import VISIBLE, Frame, Measurement


def tip_in_plane(frame: Frame, to_stage: Rigid, tip_offset: float = 0.0) -> Measurement:
    """Return the tip in the stage's frame: the sensor's position plus `tip_offset` mm along the measured z axis.

    No coordinates if the tip sensor is not measured, or has no orientation and the offset is not 0.
    """
    reading = frame.readings.get(TIP)
    if reading is None or reading.status != VISIBLE or reading.position is None:
        return Measurement(frame.time, None, None, None, frame)
    position = np.array(reading.position)
    if tip_offset != 0.0:
        if reading.orientation is None:
            return Measurement(frame.time, None, None, None, frame)
        position = position + tip_offset * z_axis(np.array(reading.orientation))
    x, y, z = to_stage.apply(position).tolist()
    return Measurement(frame.time, x, y, z, frame)


class InPlane:
    """A `TipTracker` that reads the frames of a tracker; to_stage: map from the tracker's frame to the stage's."""

    def __init__(self, tracker: Tracker, to_stage: Rigid, tip_offset: float = 0.0) -> None:
        self._tracker, self._to_stage, self._tip_offset = tracker, to_stage, tip_offset

    def read(self) -> tuple[Measurement, ...]:
        """Return the tip in each frame since the last call, oldest first."""
        frames = self._tracker.read()
        return tuple(tip_in_plane(frame, self._to_stage, self._tip_offset) for frame in frames)

    @property
    def status(self) -> str:
        """The tracker's status."""
        return self._tracker.status
