"""Map from a tracker's frame to the tip in the plane, with an offset along the measured axis."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.geometry.rigid import Rigid, identity
from flexneedle.phantom.tracking.field.field_tracker import FieldTracker
from flexneedle.phantom.tracking.field.poses import tip_sensor_pose
from flexneedle.phantom.tracking.field.room import Room
from flexneedle.phantom.tracking.stage import OnStage, tip_on_stage
from flexneedle.types import Frame, Pose, SensorReading
from rooms import ManualClock, environment

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)
POSITIONS = st.lists(st.floats(-300.0, 300.0), min_size=3, max_size=3)


def frame(**readings):
    return Frame(1.5, 7, readings)


@given(angles=ANGLES, shift=POSITIONS, tip=POSITIONS, angle=st.floats(-1.0, 1.0), offset=st.floats(0.0, 20.0))
@hypothesis_settings(max_examples=30)
def test_the_maps_to_the_tracker_and_back_cancel(angles, shift, tip, angle, offset):
    to_tracker = Rigid(Rotation.from_euler("xyz", angles).as_matrix(), np.array(shift))
    clock = ManualClock()
    direction = (np.cos(angle), np.sin(angle), 0.0)
    tracker = FieldTracker(
        Room(environment(), 0),
        lambda _: {"tip": tip_sensor_pose(tip, direction, offset)},
        clock,
        0.025,
        np.random.default_rng(0),
        to_tracker=to_tracker,
    )
    clock.wait(0.05)
    samples = OnStage(tracker, to_tracker.inverse(), offset).read()
    assert len(samples) == 2
    for sample in samples:
        assert (sample.x, sample.y, sample.z) == pytest.approx(tuple(tip), abs=1e-9)
        assert sample.time == sample.frame.time


def test_the_tip_is_ahead_of_its_sensor():
    """A needle along y: a quarter turn of z about −x."""
    half = np.sqrt(0.5)
    reading = SensorReading((1.0, 2.0, 3.0), (half, -half, 0.0, 0.0))
    sample = tip_on_stage(frame(tip=reading), identity(), 5.0)
    assert (sample.x, sample.y, sample.z) == pytest.approx((1.0, 7.0, 3.0))


@pytest.mark.parametrize(
    "readings",
    [
        {},
        {"ref1": SensorReading((0.0, 0.0, 0.0))},
        {"tip": SensorReading(None, status="missing")},
        {"tip": SensorReading(None)},
        {"tip": SensorReading((1.0, 2.0, 3.0), status="out of volume")},
    ],
)
def test_a_missing_tip_has_no_coordinates_but_its_frame(readings):
    sample = tip_on_stage(frame(**readings), identity())
    assert (sample.time, sample.x, sample.y, sample.z) == (1.5, None, None, None)
    assert sample.frame == frame(**readings)


def test_without_an_orientation_the_tip_is_measured_only_with_offset_0():
    reading = frame(tip=SensorReading((1.0, 2.0, 3.0)))
    assert tip_on_stage(reading, identity(), 5.0).x is None
    assert tip_on_stage(reading, identity()).x == pytest.approx(1.0)


@given(angles=ANGLES, theta=st.floats(-1.0, 1.0), psi=st.floats(-1.0, 1.0))
@hypothesis_settings(max_examples=30)
def test_the_direction_of_the_sensor_is_the_needles(angles, theta, psi):
    """As slopes in the stage's frame, for any frame of the tracker."""
    to_stage = Rigid(Rotation.from_euler("xyz", angles).as_matrix(), np.zeros(3))
    pose = Pose(1.0, 2.0, 3.0, theta, psi)
    sensor = tip_sensor_pose((1.0, 2.0, 3.0), pose.axis)
    there = Rotation.from_matrix(to_stage.rotation).inv() * Rotation.from_quat(
        sensor.orientation, scalar_first=True
    )
    reading = SensorReading((0.0, 0.0, 0.0), tuple(there.as_quat(scalar_first=True).tolist()))
    sample = tip_on_stage(frame(tip=reading), to_stage)
    assert sample.direction == pytest.approx((theta, psi), abs=1e-9)
    assert tip_on_stage(frame(tip=SensorReading((0.0, 0.0, 0.0))), to_stage).direction is None
