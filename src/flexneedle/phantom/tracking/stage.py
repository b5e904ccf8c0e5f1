"""Map from a tracker's frames to the tip of the needle in the frame of the stage."""

import math
from collections.abc import Iterable
from statistics import median

import numpy as np

from flexneedle.geometry.quaternion import z_axis
from flexneedle.geometry.rigid import Rigid
from flexneedle.ports import Tracker
from flexneedle.types import TIP, UNKNOWN, VISIBLE, Floats, Frame, Lateral, Measurement, Pose


def tip_on_stage(frame: Frame, to_stage: Rigid, tip_offset: float = 0.0) -> Measurement:
    """Return the tip in the stage's frame: the sensor's position plus `tip_offset` mm along the measured z axis.

    With the direction of that axis, if the sensor has an orientation. No coordinates if the tip sensor is not measured,
    or has no orientation and the offset is not 0.
    """
    reading = frame.readings.get(TIP)
    if reading is None or reading.status != VISIBLE or reading.position is None:
        return Measurement(frame.time, None, None, None, frame)
    position, direction = np.array(reading.position), None
    if reading.orientation is not None:
        axis = z_axis(np.array(reading.orientation))
        position, direction = position + tip_offset * axis, tilt_of(to_stage.rotation @ axis)
    elif tip_offset != 0.0:
        return Measurement(frame.time, None, None, None, frame)
    x, y, z = to_stage.apply(position).tolist()
    return Measurement(frame.time, x, y, z, frame, direction)


def tilt_of(axis: Floats) -> Lateral:
    """Return slopes θ, ψ (rad) of a needle along a vector (3,): its tilt from x in the directions y and z."""
    x, y, z = axis.tolist()
    across = math.hypot(y, z)
    angle = math.atan2(across, x)
    if across == 0.0:
        return angle, 0.0
    return angle * y / across, angle * z / across


def has_position(measurement: Measurement) -> bool:
    """Return whether the tip is measured, along z where the tracker has it."""
    place = (measurement.x, measurement.y, 0.0 if measurement.z is None else measurement.z)
    return all(value is not None and math.isfinite(value) for value in place)


def median_pose(measurements: Iterable[Measurement]) -> Pose | None:
    """Return the medians of the measured tips, None without any; z is 0 in the plane, unknown slopes are NaN.

    The slopes of a sensor that points backwards are its angle and 0: to which side it turns is noise.
    """
    found = [one for one in measurements if has_position(one)]
    if not found:
        return None
    places = [(one.x or 0.0, one.y or 0.0, one.z or 0.0) for one in found]
    slopes = [
        one.direction for one in found if one.direction is not None and np.isfinite(one.direction).all()
    ]
    if slopes and (angle := median(math.hypot(*slope) for slope in slopes)) > 0.5 * math.pi:
        slopes = [(angle, 0.0)]
    x, y, z = (median(values) for values in zip(*places, strict=True))
    return Pose(x, y, z, *(median(values) for values in zip(*(slopes or [UNKNOWN]), strict=True)))


class OnStage:
    """A `TipTracker` that reads the frames of a tracker; to_stage: map from the tracker's frame to the stage's."""

    def __init__(self, tracker: Tracker, to_stage: Rigid, tip_offset: float = 0.0) -> None:
        self._tracker, self._to_stage, self._tip_offset = tracker, to_stage, tip_offset

    def read(self) -> tuple[Measurement, ...]:
        """Return the tip in each frame since the last call, oldest first."""
        frames = self._tracker.read()
        return tuple(tip_on_stage(frame, self._to_stage, self._tip_offset) for frame in frames)

    @property
    def status(self) -> str:
        """The tracker's status."""
        return self._tracker.status
