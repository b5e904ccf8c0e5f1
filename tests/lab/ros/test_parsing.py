"""Records of received messages, and refused messages."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import z_axis
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, LinkTarget
from flexneedle.lab.link.sensing import MOST_POINTS
from flexneedle.lab.link.stamps import StampClock
from flexneedle.lab.ros.parsing import LARGEST_BYTES, Subscription
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import JointReading, TipReading
from flexneedle.types import VISIBLE
from ros_peers import Bool, cdr, joints, shape, target, tip

NEUTRAL, SMARTNEEDLE, FIBRE = map(load_profile, ("neutral", "smartneedle", "smartneedle-fbg"))


def read(key, message, profile=NEUTRAL, arrival=100.0, **how):
    data = message if isinstance(message, bytes) else cdr(message)
    return Subscription(profile, key).read(data, arrival, **how)


ALONG_Y = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)


@pytest.mark.parametrize(
    ("profile", "message", "position"),
    [
        (NEUTRAL, tip(5.0, (0.040, -0.003, 0.002)), (40.0, -3.0, 2.0)),  # in metres
        (SMARTNEEDLE, tip(5.0, (-2.0, 40.0, 3.0), ALONG_Y, "stage"), (40.0, 3.0, -2.0)),  # deep along y
    ],
)
def test_a_tip_of_a_needle_straight_along_the_insertion(profile, message, position):
    found = read("tip", message, profile)
    assert (found.time, found.number, found.status) == (100.0, 1, VISIBLE)
    np.testing.assert_allclose(found.position, position)
    np.testing.assert_allclose(z_axis(np.array(found.orientation)), (1.0, 0.0, 0.0), atol=1e-12)


@pytest.mark.parametrize("spacing", [0.37, 5.0])
def test_a_shape_may_have_any_spacing(spacing):
    depths = np.arange(0.0, 40.0, spacing)
    found = read("shape", shape(5.0, [(-1.0, 2.0, z) for z in depths], frame="needle"), FIBRE)
    assert isinstance(found, TipReading)
    np.testing.assert_allclose(found.position, (depths[-1], 2.0, 1.0), atol=1e-12)


def test_targets_stops_arms_and_joints():
    found = read("target", target(5.0, (0.035, 0.005, 0.0)))
    assert isinstance(found, LinkTarget)
    np.testing.assert_allclose(found.point, (35.0, 5.0, 0.0))
    for publishers in (1, 2):
        assert read("stop", Bool(True), publishers=publishers) == LinkStop(100.0, "/flexneedle/stop")
    assert read("stop", Bool(False)) is None
    assert read("arm", Bool(True)) == LinkArm(100.0, "/flexneedle/arm")
    assert isinstance(read("arm", Bool(False)), LinkStop)


NAN = (math.nan, math.nan)


@pytest.mark.parametrize(
    ("velocities", "efforts"),
    [
        ((), ()),
        ((0.0, 1.0), ()),
        (NAN, NAN),
        ((0.0, math.nan), ()),
        ((math.inf,), NAN),
        ((), (1.0, 2.0, 3.0)),
    ],
)
@pytest.mark.parametrize("other", [-3.0, math.nan, math.inf, 1e300])
def test_of_joint_states_only_positions_of_used_joints_count(velocities, efforts, other):
    """As ros2_control sends them where an interface is missing, and of joints that are not the rig's."""
    message = joints(5.0, {"a": 0.01, "b": other}, velocities)
    message.effort = np.array(efforts, dtype=float)
    found = read("joint_states", message)
    assert isinstance(found, JointReading)
    assert (found.time, list(found.positions)) == (100.0, ["a", "b"])
    np.testing.assert_equal(list(found.positions.values()), [0.01, other])


@pytest.mark.parametrize("data", [b"", b"\x00", b"\x00\x01\x00\x00", b"\x07\x01\x00\x00\x01", b"\xff" * 40])
def test_an_unreadable_message_on_the_topic_of_stops_is_a_stop(data):
    found = read("stop", data)
    assert isinstance(found, LinkStop)
    assert found.reason.startswith("not a std_msgs/msg/Bool: ")


def with_twice_the_name():
    message = joints(5.0, {"a": 1.0, "b": 2.0})
    message.name[1] = "a"
    return message


def without_a_position():
    message = joints(5.0, {"a": 1.0, "b": 2.0})
    message.position = message.position[:1]
    return message


@pytest.mark.parametrize(
    ("key", "message", "subject"),
    [
        ("tip", tip(5.0, frame="map"), "frame_id 'map'"),
        ("tip", tip(5.0, frame=""), "frame_id ''"),
        ("tip", tip(0.0), "no time stamp"),
        ("target", target(5.0, (math.nan, 0.0, 0.0)), "position (nan, 0, 0)"),
        ("target", target(5.0, (40.0, 0.0, 0.0)), "position (40, 0, 0)"),
        ("target", target(5.0, (0.0, 0.0, math.inf)), "position (0, 0, inf)"),
        ("shape", shape(5.0, []), "0 poses: must be 1 to 10000"),
        ("shape", shape(5.0, [(0.0, 0.0, 0.0)] * (MOST_POINTS + 1)), "10001 poses"),
        ("joint_states", joints(5.0, {}), "0 joints"),
        ("joint_states", with_twice_the_name(), "2 joints: must be 1 to 1000, each once"),
        ("joint_states", without_a_position(), "2 names, 1 positions: must be as many"),
        ("tip", b"\x00" * (LARGEST_BYTES + 1), "1000001 bytes"),
        ("tip", cdr(tip(5.0))[:-1], "not a geometry_msgs/msg/PoseStamped: "),
        ("tip", cdr(tip(5.0)) + bytes(8), "not a geometry_msgs/msg/PoseStamped: "),
    ],
)
def test_invalid_messages_are_refused(key, message, subject):
    found = read(key, message)
    assert isinstance(found, LinkRefusal), found
    assert found.reason.startswith(subject)


def test_measurements_of_two_publishers_and_repeated_messages_are_refused():
    assert "2 publishers" in read("tip", tip(5.0), publishers=2).reason
    subscription, data = Subscription(NEUTRAL, "tip"), cdr(tip(5.0))
    assert isinstance(subscription.read(data, 100.0), TipReading)
    again = subscription.read(data, 100.1)
    assert again.reason.startswith("old data")
    assert (subscription.number, again.count) == (2, 1)


@pytest.mark.parametrize(("which", "status"), [(0, VISIBLE), (1, "position (0, nan, 0)")])
def test_of_a_shape_only_the_last_pose_counts(which, status):
    places = [(0.0, 0.0, 0.0), (0.01, 0.0, 0.0)]
    places[which] = (0.0, math.nan, 0.0)
    found = read("shape", shape(5.0, places))
    assert found.status.startswith(status)
    assert (found.position is None) == (which == 1)


def test_a_tip_without_a_position_is_missing_and_one_without_an_orientation_keeps_its_position():
    found = read("tip", tip(5.0, (math.nan, 0.0, 0.0)))
    assert (found.position, found.orientation) == (None, None)
    assert found.status.startswith("position (nan, 0, 0)")
    found = read("tip", tip(5.0, (0.01, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    assert found.position == pytest.approx((10.0, 0.0, 0.0))
    assert (found.orientation, found.status) == (None, VISIBLE)
    unfilled = read("tip", tip(5.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    assert (unfilled.position, unfilled.status) == (None, "missing (position and orientation are 0)")


# Times of measurement


@pytest.fixture
def clock():
    return StampClock()


def accepted(clock, stamps_and_arrivals):
    """Yield the number and the time of each message that is not refused."""
    for number, (stamp, arrival) in enumerate(stamps_and_arrivals):
        try:
            time = clock.to_time(stamp, arrival)
        except InputError:
            continue
        yield number, time


def test_a_delayed_message_has_its_own_time(clock):
    """The least delay until now is taken for none."""
    found = [clock.to_time(*one) for one in ((1000.0, 10.010), (1000.1, 10.105), (1000.2, 10.700))]
    assert found == pytest.approx([10.010, 10.105, 10.205])


@given(st.floats(-1e6, 1e6), st.lists(st.floats(0.0, 0.5), min_size=2, max_size=50))
def test_times_are_never_after_the_arrival_and_off_by_the_least_delay(offset, delays):
    clock, least = StampClock(), min(delays)
    for number, delay in enumerate(delays):
        true = 100.0 + 0.025 * number
        time = clock.to_time(true + offset, true + delay)
        assert time <= true + delay + 1e-9
        assert true + least - 1e-6 <= time
    assert time == pytest.approx(true + least, abs=1e-6)


@pytest.mark.parametrize("rate", [1.0001, 0.9999])
def test_the_clock_of_the_sender_may_drift(clock, rate):
    for number in range(4000):
        true = 0.025 * number
        time = clock.to_time(5000.0 + true * rate, true)
    assert time == pytest.approx(true, abs=1.1e-3)  # 10 s at 100 ppm


@pytest.mark.parametrize(("back", "again", "refused"), [(0.2, 0.0, 21), (2.0, 0.1, None)])
def test_a_sender_whose_clock_is_set_back_has_no_earlier_times_afterwards(clock, back, again, refused):
    """Once at message 50, and again at 100, before it has caught up."""
    number = np.arange(400)
    true = 10.0 + 0.025 * number
    stamps = true + 1000.0 - back * (number >= 50) - again * (number >= 100)
    found = dict(accepted(clock, zip(stamps.tolist(), (true + 0.003).tolist(), strict=True)))
    np.testing.assert_allclose([*found.values()], true[[*found]] + 0.003)
    if refused:  # from the first one on; the second shows it, and then half a second
        assert len(found) == 400 - refused
    assert sum(number >= 100 for number in found) > 230


@pytest.mark.parametrize("every", [3, 40])
def test_a_topic_whose_messages_change_places_recovers_after_a_set_back(clock, every):
    def messages():
        for number in range(400):
            swapped = {1: number - 1, 0: number + 1}.get(number % every, number)  # two in each `every`
            yield 10.0 + 0.025 * swapped - (0.1 if number > 100 else 0.0), 10.0 + 0.025 * number

    assert sum(number > 130 for number, _ in accepted(clock, messages())) > 150


def test_messages_after_delayed_ones_in_order_are_not_taken_for_new(clock):
    """Only a message without delay shows the clock of the sender."""
    messages = ((5.0, 10.0), (3.0, 10.1), (3.1, 10.1), (5.1, 10.5), (5.5, 10.5), (5.6, 10.7), (5.7, 10.8))
    found = dict(accepted(clock, messages))
    assert found == {0: 10.0, 5: pytest.approx(10.6), 6: pytest.approx(10.7)}  # 5.1 came 0.4 s late
    with pytest.raises(InputError, match="old data"):
        clock.to_time(5.7, 10.9)


def test_a_single_old_message_is_refused_and_changes_no_times(clock):
    found = dict(accepted(clock, ((5.0, 10.0), (5.1, 10.1), (5.05, 10.15), (5.2, 10.3))))
    assert found == {0: 10.0, 1: pytest.approx(10.1), 3: pytest.approx(10.2)}
