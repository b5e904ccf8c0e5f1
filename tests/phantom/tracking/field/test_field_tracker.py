"""The simulated electromagnetic tracker: rate, delay, missing readings, frame, and plate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.geometry.rigid import Rigid
from flexneedle.phantom.tracking.field.field_tracker import MISSING, FieldTracker
from flexneedle.phantom.tracking.field.poses import SensorPose, reference_poses, tip_sensor_pose
from flexneedle.phantom.tracking.field.room import REFERENCES, Room
from flexneedle.types import VISIBLE
from rooms import ManualClock, environment, shipped

PERIOD = 0.025
TO_TRACKER = Rigid(Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix(), np.array([30.0, -200.0, 7.0]))


def moving(time):
    """Return a needle along x that moves at 1 mm/s from the start on."""
    return {"tip": tip_sensor_pose((10.0 + max(time, 0.0), 2.0, 0.5), (1.0, 0.0, 0.0))}


def tracker(clock, room=None, poses=moving, seed=0, **options):
    room = room or Room(environment(), 1)
    return FieldTracker(room, poses, clock, PERIOD, np.random.default_rng(seed), **options)


def frames(count, room=None, poses=moving, seed=0, **options):
    """Return the first frames after the start."""
    clock = ManualClock()
    device = tracker(clock, room, poses, seed, **options)
    clock.wait(PERIOD * count + options.get("delay", 0.0))
    return [frame for frame in device.read() if frame.time > 0.0]


def with_references(tracker):
    fixed = reference_poses(tracker, (20.0, 0.0, 0.0))
    return lambda time: {**moving(time), **fixed}


def test_without_errors_a_reading_is_the_true_pose():
    found = frames(5)
    assert len(found) == 5
    for frame in found:
        reading = frame.readings["tip"]
        assert reading.position == pytest.approx((10.0 + frame.time, 2.0, 0.5))
        assert reading.orientation == pytest.approx((np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
        assert (reading.indicator, reading.status) == (None, VISIBLE)


@given(waits=st.lists(st.floats(0.0, 0.3), min_size=1, max_size=15), delay=st.floats(0.0, 0.3))
@hypothesis_settings(max_examples=25)
def test_each_frame_is_returned_once_and_in_order(waits, delay):
    clock = ManualClock()
    device = tracker(clock, delay=delay)
    received = []
    for seconds in waits:
        clock.wait(seconds)
        received.extend(device.read())
    first = 1 - int(np.ceil(delay / PERIOD - 1e-6))
    times = [frame.time for frame in received]
    np.testing.assert_allclose(times, PERIOD * np.arange(first, first + len(received)), atol=1e-12)
    assert [frame.number for frame in received] == list(range(len(received)))
    due = (clock.now() - delay) / PERIOD
    assert due - 1.0 - 1e-5 <= first + len(received) - 1 <= due + 1e-5


def test_frames_before_the_start_have_the_start_pose():
    clock = ManualClock()
    device = tracker(clock, delay=0.1)
    clock.wait(0.1)
    first_frames = device.read()
    assert [frame.time for frame in first_frames] == pytest.approx([-0.075, -0.05, -0.025, 0.0])
    assert {frame.readings["tip"].position[0] for frame in first_frames} == {10.0}


def test_only_the_seed_changes_the_noise_not_delay_missing_readings_or_other_sensors():
    room = Room(shipped("ideal"), 4)

    def tips(poses=moving, **options):
        return [frame.readings["tip"] for frame in frames(400, room, poses, **options)]

    plain = tips()
    assert tips() == plain
    assert tips(seed=3) != plain
    assert tips(delay=0.31) == plain
    assert tips(with_references(room.environment)) == plain
    some = tips(missing=0.3)
    measured = [(one, two) for one, two in zip(plain, some, strict=True) if two.status == VISIBLE]
    assert 240 < len(measured) < 320
    assert all(one == two for one, two in measured)


def test_missing_readings_are_binomial_and_independent_between_sensors():
    room = Room(environment(), 1)
    count = 2000
    poses = reference_poses(room.environment, (0.0, 0.0, 0.0))
    blind = np.array(
        [
            [frame.readings[name].status == MISSING for name in REFERENCES]
            for frame in frames(count, room, lambda _: poses, missing=0.2)
        ]
    )
    assert np.abs(blind.mean(axis=0) - 0.2).max() < 4.0 * np.sqrt(0.16 / count)
    both = (blind[:, 0] & blind[:, 1]).mean()
    assert both == pytest.approx(0.04, abs=4.0 * np.sqrt(0.04 / count))
    tips = [frame.readings["tip"] for frame in frames(50, missing=0.9)]
    lost = {(r.position, r.orientation, r.indicator) for r in tips if r.status == MISSING}
    assert lost == {(None, None, None)}
    assert all(frame.readings["tip"].status == VISIBLE for frame in frames(500))


# ---- frames of reference


def test_the_map_to_the_trackers_frame_turns_positions_and_axes():
    room = Room(shipped("noisy"), 2)
    poses = with_references(room.environment)
    for here, there in zip(
        frames(5, room, poses), frames(5, room, poses, to_tracker=TO_TRACKER), strict=True
    ):
        for name, reading in here.readings.items():
            mapped = there.readings[name]
            np.testing.assert_allclose(mapped.position, TO_TRACKER.apply(np.array(reading.position)))
            axes = Rotation.from_quat(
                [reading.orientation, mapped.orientation], scalar_first=True
            ).as_matrix()
            np.testing.assert_allclose(axes[1, :, 2], TO_TRACKER.rotation @ axes[0, :, 2], atol=1e-12)
            assert mapped.indicator == reading.indicator
            if name != "tip":
                np.testing.assert_allclose(axes[1], TO_TRACKER.rotation @ axes[0], atol=1e-12)


def test_the_roll_of_the_tip_is_not_measured():
    """Two poses that differ only in the roll have the same reading."""
    half = np.sqrt(0.5)
    rolled = (0.5, 0.5, 0.5, 0.5)  # rolled by a quarter turn
    plain, turned = (
        frames(3, poses=lambda _, q=q: {"tip": SensorPose((0.0, 0.0, 0.0), q)})[0].readings["tip"].orientation
        for q in ((half, 0.0, half, 0.0), rolled)
    )
    assert plain == pytest.approx(turned)


def test_room_and_references_are_around_the_center():
    room = Room(environment(tip={"bias_mm": 1.0}), 2)
    here = {"tip": SensorPose((23.0, 4.0, 5.0))}
    (reading,) = (f.readings["tip"] for f in frames(1, room, lambda _: here, center=(20.0, 1.0, 0.0)))
    poses = reference_poses(environment(reference={"ref1_mm": [1, 2, 3]}), (20.0, 10.0, 0.0))
    assert tuple(poses) == REFERENCES
    assert poses["ref1"].position == (21.0, 12.0, 3.0)
    expected = np.array([23.0, 4.0, 5.0]) + room.error("tip", np.array([[3.0, 3.0, 5.0]]))[0]
    assert reading.position == pytest.approx(tuple(expected))


# ---- the plate


def test_an_approaching_plate_raises_the_indicators():
    room = Room(shipped("noisy"), 2)
    poses = reference_poses(room.environment, (0.0, 0.0, 0.0))
    found = frames(200, room, lambda _: poses, plate_distance_at=lambda time: 250.0 - 30.0 * time)
    values = np.array([[frame.readings[name].indicator for name in REFERENCES] for frame in found])
    assert (values[-20:].mean(axis=0) > 3.0 * values[:20].mean(axis=0)).all()


def test_the_stored_reading_of_a_sensor_at_rest_is_correct():
    """It belongs to the sensor's present pose."""
    room = Room(environment(tip={"bias_mm": 1.0}), 2)
    positions = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    found = frames(4, room, lambda time: {"tip": SensorPose(positions[round(time / PERIOD) - 1])})
    measured = [frame.readings["tip"].position for frame in found]
    assert measured[0] == measured[1] == measured[3] != measured[2]
