"""What is made of received messages, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import InputError
from flexneedle.lab.ros.parsing import LARGEST_BYTES, MOST_POSES, Subscription
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import Arm, JointReading, Refused, ShapeReading, Stop, Target, TipReading
from flexneedle.lab.ros.stamps import Stamps
from flexneedle.types import VISIBLE
from ros_peers import Bool, cdr, joints, shape, target, tip

NEUTRAL, SMARTNEEDLE, FIBRE = map(load_profile, ("neutral", "smartneedle", "smartneedle-fbg"))
TURNED = (0.5, 0.5, 0.5, 0.5)  # x, y, z, w: the needle's z along the stage's x


def read(key, message, profile=NEUTRAL, arrival=100.0, **how):
    data = message if isinstance(message, bytes) else cdr(message)
    return Subscription(profile, key).read(data, arrival, **how)


def test_a_tip_in_metres():
    found = read("tip", tip(5.0, (0.040, -0.003, 0.002)))
    assert (found.time, found.number, found.status) == (100.0, 1, VISIBLE)
    np.testing.assert_allclose(found.position, (40.0, -3.0, 2.0))
    np.testing.assert_allclose(
        found.orientation, (0.5, 0.5, 0.5, 0.5)
    )  # z to x: straight along the insertion


def test_a_tip_of_smartneedle():
    """40 mm deep is y of its stage; its z is along the needle, here along y, too."""
    found = read("tip", tip(5.0, (-2.0, 40.0, 3.0), (-(0.5**0.5), 0.0, 0.0, 0.5**0.5), "stage"), SMARTNEEDLE)
    np.testing.assert_allclose(found.position, (40.0, 3.0, -2.0))
    w, x, y, z = found.orientation
    axis = (2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z)
    np.testing.assert_allclose(axis, (1.0, 0.0, 0.0), atol=1e-12)


@pytest.mark.parametrize("spacing", [0.5, 1.0, 5.0, 0.37])
def test_a_shape_may_have_any_spacing(spacing):
    depths = np.arange(0.0, 40.0, spacing)
    found = read("shape", shape(5.0, [(-1.0, 2.0, z) for z in depths], frame="needle"), FIBRE)
    assert isinstance(found, ShapeReading)
    np.testing.assert_allclose(found.points, [(z, 2.0, 1.0) for z in depths], atol=1e-12)
    np.testing.assert_allclose(found.tip.position, (depths[-1], 2.0, 1.0), atol=1e-12)


def test_a_target():
    found = read("target", target(5.0, (0.035, 0.005, 0.0)))
    assert isinstance(found, Target)
    np.testing.assert_allclose(found.point, (35.0, 5.0, 0.0))


def test_true_stops_and_false_asks_for_nothing():
    assert read("stop", Bool(True)) == Stop(100.0, "/flexneedle/stop")
    assert read("stop", Bool(False)) is None


def test_true_arms_and_false_stops():
    assert read("arm", Bool(True)) == Arm(100.0, "/flexneedle/arm")
    assert isinstance(read("arm", Bool(False)), Stop)


def test_joint_states():
    found = read("joint_states", joints(5.0, {"a": 0.01, "b": -3.0}, (0.0, 1.0)))
    assert found == JointReading(100.0, {"a": 0.01, "b": -3.0}, {"a": 0.0, "b": 1.0})
    assert read("joint_states", joints(5.0, {"a": 0.01})).velocities == {}


@pytest.mark.parametrize("data", [b"", b"\x00", b"\x00\x01\x00\x00", b"\x07\x01\x00\x00\x01", b"\xff" * 40])
def test_what_cannot_be_read_on_the_topic_of_stops_is_a_stop(data):
    found = read("stop", data)
    assert isinstance(found, Stop)
    assert found.reason.startswith("not a std_msgs/msg/Bool: ")


@pytest.mark.parametrize(
    ("key", "message", "reason"),
    [
        ("tip", tip(5.0, frame="map"), "frame_id 'map': must be 'skin'"),
        ("tip", tip(5.0, frame=""), "frame_id '': must be 'skin'"),
        ("tip", tip(0.0), "no time stamp"),
        ("target", target(5.0, (math.nan, 0.0, 0.0)), "position (nan, 0, 0): not a number"),
        ("target", target(5.0, (40.0, 0.0, 0.0)), "position (40, 0, 0): farther than 10 m"),
        ("target", target(5.0, (0.0, 0.0, math.inf)), "not a number"),
        ("shape", shape(5.0, []), "0 poses: must be 1 to 10000"),
        ("shape", shape(5.0, [(0.0, 0.0, 0.0)] * (MOST_POSES + 1)), "10001 poses"),
        ("shape", shape(5.0, [(0.0, 0.0, 0.0), (0.0, math.nan, 0.0)]), "not a number"),
        ("joint_states", joints(5.0, {}), "0 joints"),
        ("joint_states", joints(5.0, {"a": math.nan}), "joint 'a': nan is not a position"),
        ("joint_states", joints(5.0, {"a": 1.0}, (math.inf,)), "joint 'a': inf is not a position"),
        ("joint_states", joints(5.0, {"a": 1.0, "b": 2.0}, (1.0,)), "2 names, 2 positions, 1 velocities"),
        ("tip", b"\x00" * (LARGEST_BYTES + 1), "longer than 1000000"),
        ("tip", cdr(tip(5.0))[:-1], "not a geometry_msgs/msg/PoseStamped: "),
        ("tip", cdr(tip(5.0)) + bytes(8), "not a geometry_msgs/msg/PoseStamped: "),
    ],
)
def test_what_is_refused(key, message, reason):
    found = read(key, message)
    assert isinstance(found, Refused), found
    assert reason in found.reason


def test_joints_named_twice_are_refused():
    message = joints(5.0, {"a": 1.0, "b": 2.0})
    message.name[1] = "a"
    assert "each once" in read("joint_states", message).reason


def test_measurements_of_two_publishers_are_refused():
    assert "2 publishers" in read("tip", tip(5.0), publishers=2).reason
    assert isinstance(read("stop", Bool(True), publishers=2), Stop)


def test_a_tip_that_is_nowhere_is_a_missing_one():
    found = read("tip", tip(5.0, (math.nan, 0.0, 0.0)))
    assert (found.position, found.orientation) == (None, None)
    assert found.status == "position (nan, 0, 0): not a number"


def test_a_tip_without_an_orientation_keeps_its_position():
    found = read("tip", tip(5.0, (0.01, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    assert found.position == pytest.approx((10.0, 0.0, 0.0))
    assert (found.orientation, found.status) == (None, VISIBLE)


def test_a_message_is_taken_once():
    subscription, data = Subscription(NEUTRAL, "tip"), cdr(tip(5.0))
    assert isinstance(subscription.read(data, 100.0), TipReading)
    again = subscription.read(data, 100.1)
    assert "old data: its stamp is 0.000 s before" in again.reason
    assert (subscription.number, again.count) == (2, 1)


# Times of measurement


def test_a_message_that_was_held_up_has_its_own_time():
    stamps = Stamps()
    assert stamps.measured(1000.0, 10.010) == pytest.approx(
        10.010
    )  # the shortest delay so far is taken for none
    assert stamps.measured(1000.1, 10.105) == pytest.approx(10.105)
    assert stamps.measured(1000.2, 10.700) == pytest.approx(10.205)


@given(
    st.floats(-1e6, 1e6),
    st.lists(st.floats(0.0, 0.5), min_size=2, max_size=50),
)
def test_times_are_never_after_the_arrival_and_off_by_the_least_delay(offset, delays):
    stamps, least = Stamps(), min(delays)
    for number, delay in enumerate(delays):
        true = 100.0 + 0.025 * number
        time = stamps.measured(true + offset, true + delay)
        assert time <= true + delay + 1e-9
        assert true + least - 1e-6 <= time
    assert time == pytest.approx(true + least, abs=1e-6)


@pytest.mark.parametrize("rate", [1.0001, 0.9999])
def test_the_clock_of_the_sender_may_drift(rate):
    stamps = Stamps()
    for number in range(4000):
        true = 0.025 * number
        time = stamps.measured(5000.0 + true * rate, true)
    assert time == pytest.approx(true, abs=1.1e-3)  # 10 s at 100 ppm


def test_a_sender_whose_clock_is_set_back_has_no_earlier_times_afterwards():
    stamps, refused = Stamps(), 0
    for number in range(100):
        true = 10.0 + 0.025 * number
        try:
            time = stamps.measured(true + (1000.0 if number < 50 else 999.8), true + 0.003)
        except InputError:
            refused += 1
        else:
            assert time == pytest.approx(true + 0.003)
    assert refused == 21  # from the first one on; the second shows it, and then for half a second


@pytest.mark.parametrize("seconds", [1.0, 2.2, 2.9])
def test_a_clock_that_is_set_back_twice_has_no_earlier_times_afterwards(seconds):
    """Again before it is seen to be as late as before, while it is observed, and after that."""
    stamps, accepted = Stamps(), 0
    for number in range(400):
        true = 10.0 + 0.025 * number
        back = (2.0 if number >= 40 else 0.0) + (0.1 if true >= 11.0 + seconds else 0.0)
        try:
            time = stamps.measured(true + 1000.0 - back, true + 0.003)
        except InputError:
            continue
        accepted += number >= 40
        assert time == pytest.approx(true + 0.003)
    assert accepted > 230


@pytest.mark.parametrize("every", [3, 10, 40])
def test_a_topic_whose_messages_change_places_recovers_after_a_set_back(every):
    stamps, accepted = Stamps(), 0
    for number in range(400):
        swapped = {1: number - 1, 0: number + 1}.get(number % every, number)  # two in each `every`
        arrival = 10.0 + 0.025 * number
        try:
            stamps.measured(10.0 + 0.025 * swapped - (0.1 if number > 100 else 0.0), arrival)
        except InputError:
            continue
        accepted += number > 130
    assert accepted > 150


def test_messages_after_held_up_ones_that_came_in_order_are_not_taken_for_new():
    """Nothing but a message without delay shows what the clock of the sender is."""
    stamps = Stamps()
    stamps.measured(5.0, 10.0)
    for stamp, arrival in ((3.0, 10.1), (3.1, 10.1)):
        with pytest.raises(InputError, match="old data"):
            stamps.measured(stamp, arrival)
    with pytest.raises(
        InputError, match=r"its clock was set back: refused until that was observed for 0\.5 s"
    ):
        stamps.measured(5.1, 10.5)  # 0.4 s after it was measured
    with pytest.raises(InputError, match="set back"):
        stamps.measured(5.5, 10.5)
    assert stamps.measured(5.6, 10.7) == pytest.approx(10.6)
    assert stamps.measured(5.7, 10.8) == pytest.approx(10.7)


def test_a_single_old_message_changes_no_times():
    stamps = Stamps()
    stamps.measured(5.0, 10.0)
    stamps.measured(5.1, 10.1)
    with pytest.raises(InputError, match="old data"):
        stamps.measured(5.05, 10.15)
    assert stamps.measured(5.2, 10.3) == pytest.approx(10.2)


@pytest.mark.parametrize("stamp", [5.0, 4.9, -1.0])
def test_a_stamp_that_is_not_newer_is_old_data(stamp):
    stamps = Stamps()
    stamps.measured(5.0, 10.0)
    with pytest.raises(InputError, match="old data"):
        stamps.measured(stamp, 10.1)
