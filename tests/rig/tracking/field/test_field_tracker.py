"""The simulated electromagnetic tracker: rate, delay, what it misses, its frame, and its plate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.rig.tracking.field.poses import SensorPose, reference_poses, tip_sensor_pose
from flexneedle.rig.tracking.field.room import REFERENCES, Room
from flexneedle.rig.tracking.field.tracker import MISSING, FieldTracker
from flexneedle.rig.tracking.registration import Rigid
from flexneedle.types import VISIBLE
from rooms import Watch, environment, shipped

PERIOD = 0.025
TURNED = Rigid(Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix(), np.array([30.0, -200.0, 7.0]))


def moving(time):
    """A needle that points along x and goes on at 1 mm/s; it stood still before the start."""
    return {"tip": tip_sensor_pose((10.0 + max(time, 0.0), 2.0, 0.5), (1.0, 0.0, 0.0))}


def tracker(watch, room=None, poses=moving, seed=0, **options):
    room = room or Room(environment(), 1)
    return FieldTracker(room, poses, watch, PERIOD, np.random.default_rng(seed), **options)


def frames(count, room=None, poses=moving, seed=0, **options):
    """The first frames after the start."""
    watch = Watch()
    eye = tracker(watch, room, poses, seed, **options)
    watch.wait(PERIOD * count + options.get("delay", 0.0))
    return [frame for frame in eye.read() if frame.time > 0.0]


def with_references(tracker):
    fixed = reference_poses(tracker, (20.0, 0.0, 0.0))
    return lambda time: {**moving(time), **fixed}


def test_without_an_error_it_tells_where_the_sensor_was():
    for frame in frames(5):
        reading = frame.readings["tip"]
        assert reading.position == pytest.approx((10.0 + frame.time, 2.0, 0.5))
        assert reading.orientation == pytest.approx((np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
        assert (reading.indicator, reading.status) == (None, VISIBLE)


@given(waits=st.lists(st.floats(0.0, 0.3), min_size=1, max_size=15), delay=st.floats(0.0, 0.3))
@hypothesis_settings(deadline=None, derandomize=True, max_examples=40)
def test_each_frame_is_told_once_in_order_at_its_time_whenever_one_asks(waits, delay):
    watch = Watch()
    eye = tracker(watch, delay=delay)
    told = []
    for seconds in waits:
        watch.wait(seconds)
        told.extend(eye.read())
    first = 1 - int(np.ceil(delay / PERIOD - 1e-6))
    times = [frame.time for frame in told]
    np.testing.assert_allclose(times, PERIOD * np.arange(first, first + len(told)), atol=1e-12)
    assert [frame.number for frame in told] == list(range(len(told)))
    due = (watch.now() - delay) / PERIOD
    assert due - 1.0 - 1e-5 <= first + len(told) - 1 <= due + 1e-5


def test_frames_from_before_the_start_tell_the_start():
    watch = Watch()
    eye = tracker(watch, delay=0.1)
    watch.wait(0.1)
    early = eye.read()
    assert [frame.time for frame in early] == pytest.approx([-0.075, -0.05, -0.025, 0.0])
    assert {frame.readings["tip"].position[0] for frame in early} == {10.0}


def test_same_seed_same_frames_and_another_seed_others():
    room = Room(shipped("noisy"), 4)
    poses = with_references(room.environment)
    assert frames(20, room, poses, seed=3) == frames(20, room, poses, seed=3)
    assert frames(20, room, poses, seed=3) != frames(20, room, poses, seed=4)


def test_neither_a_delay_nor_a_miss_nor_another_sensor_changes_the_noise_of_a_reading():
    room = Room(shipped("ideal"), 4)

    def tips(poses=moving, **options):
        return [frame.readings["tip"] for frame in frames(400, room, poses, **options)]

    plain = tips()
    assert tips(delay=0.31) == plain
    assert tips(with_references(room.environment)) == plain
    some = tips(missing=0.3)
    seen = [(one, two) for one, two in zip(plain, some, strict=True) if two.status == VISIBLE]
    assert 240 < len(seen) < 320
    assert all(one == two for one, two in seen)


def test_the_share_of_missing_readings_is_binomial_each_sensor_on_its_own():
    room = Room(environment(), 1)
    count = 4000
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


def test_a_missing_reading_has_neither_place_nor_anything_else():
    lost = [frame.readings["tip"] for frame in frames(50, missing=0.9)]
    lost = [reading for reading in lost if reading.status != VISIBLE]
    assert len(lost) > 30
    assert {(r.position, r.orientation, r.indicator) for r in lost} == {(None, None, None)}


def test_no_share_none_missing():
    assert all(frame.readings["tip"].status == VISIBLE for frame in frames(2000))


# ---- frames of reference


def test_the_map_to_the_trackers_frame_turns_places_and_axes():
    room = Room(shipped("noisy"), 2)
    poses = with_references(room.environment)
    for here, there in zip(frames(5, room, poses), frames(5, room, poses, to_tracker=TURNED), strict=True):
        for name, reading in here.readings.items():
            told = there.readings[name]
            np.testing.assert_allclose(told.position, TURNED.apply(np.array(reading.position)))
            axes = Rotation.from_quat([reading.orientation, told.orientation], scalar_first=True).as_matrix()
            np.testing.assert_allclose(axes[1, :, 2], TURNED.rotation @ axes[0, :, 2], atol=1e-12)
            assert told.indicator == reading.indicator
            if name != "tip":
                np.testing.assert_allclose(axes[1], TURNED.rotation @ axes[0], atol=1e-12)


def test_the_roll_of_the_tip_is_not_known():
    """Two poses that differ in nothing else read the same."""
    half = np.sqrt(0.5)
    rolled = (0.5, 0.5, 0.5, 0.5)  # a quarter turn about its own axis more
    plain, turned = (
        frames(3, poses=lambda _, q=q: {"tip": SensorPose((0.0, 0.0, 0.0), q)})[0].readings["tip"].orientation
        for q in ((half, 0.0, half, 0.0), rolled)
    )
    assert plain == pytest.approx(turned)


def test_the_middle_of_the_room_lies_where_it_is_put():
    room = Room(environment(tip={"bias_mm": 1.0}), 2)
    here = {"tip": SensorPose((23.0, 4.0, 5.0))}
    (reading,) = (f.readings["tip"] for f in frames(1, room, lambda _: here, center=(20.0, 1.0, 0.0)))
    expected = np.array([23.0, 4.0, 5.0]) + room.error("tip", np.array([[3.0, 3.0, 5.0]]))[0]
    assert reading.position == pytest.approx(tuple(expected))


def test_references_stand_around_the_middle():
    poses = reference_poses(environment(reference={"ref1_mm": [1, 2, 3]}), (20.0, 10.0, 0.0))
    assert tuple(poses) == REFERENCES
    assert poses["ref1"].position == (21.0, 12.0, 3.0)


def test_the_sensor_lies_behind_the_tip():
    pose = tip_sensor_pose((10.0, 0.0, 0.0), (3.0, 4.0, 0.0), 5.0)
    assert pose.position == pytest.approx((7.0, -4.0, 0.0))


# ---- the plate


def test_a_plate_that_comes_nearer_shows_in_every_frame():
    room = Room(shipped("noisy"), 2)
    poses = reference_poses(room.environment, (0.0, 0.0, 0.0))
    seen = frames(200, room, lambda _: poses, plate_distance_at=lambda time: 250.0 - 30.0 * time)
    values = np.array([[frame.readings[name].indicator for name in REFERENCES] for frame in seen])
    assert (values[-20:].mean(axis=0) > 3.0 * values[:20].mean(axis=0)).all()


def test_a_sensor_that_stands_still_is_read_off_as_if_it_had_just_come():
    """What is kept of the last frame is its own."""
    room = Room(environment(tip={"bias_mm": 1.0}), 2)
    places = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    seen = frames(4, room, lambda time: {"tip": SensorPose(places[round(time / PERIOD) - 1])})
    told = [frame.readings["tip"].position for frame in seen]
    assert told[0] == told[1] == told[3] != told[2]
