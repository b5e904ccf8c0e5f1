"""The driver `ros`: joints on topics."""

import json
import math
import time
from threading import Event, current_thread
from unittest.mock import MagicMock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulated import until
from flexneedle.errors import DriverError, RigError, RunError
from flexneedle.lab.ros import motors as module
from flexneedle.lab.ros.motors import (
    CONNECTING,
    JointLink,
    RosMotors,
    SetPoint,
    close_once_open,
    connect_in_thread,
    make_motors,
)
from flexneedle.lab.ros.profile import load_part, load_profile
from flexneedle.lab.ros.records import JointReading
from ros_peers import Joints

PROFILE = load_part("neutral", publish=("joint_targets",), subscribe=("joint_states",))
CHANNELS = ("insertion", "roll")
START = {"insertion": 0.010, "roll": 0.0, "other": 5.0}
STALE_S = 2.0  # the thread of the joints may wait for as long on a busy machine


@pytest.fixture(scope="module")
def connected():
    """Joints, and one link to them for all tests."""
    with Joints(load_profile("neutral"), **START) as joints:
        link = JointLink(PROFILE, CHANNELS, STALE_S)
        yield joints, link
        link.close()


@pytest.fixture
def joints(connected):
    joints, link = connected
    joints.silent.clear()
    joints.free.set()
    joints.positions = dict(START)
    until(lambda: link.read().positions == START)
    joints.targets.clear()
    joints.free.clear()
    return joints


@pytest.fixture
def motors(connected, joints):  # noqa: ARG001  at their start
    return RosMotors(CHANNELS, lambda: connected[1])


def borrowed(part):
    """A part that several objects share and none closes."""
    return MagicMock(wraps=part, close=lambda: None)


def follow_until(motors, condition):
    """Read as a supervisor does until the condition holds on the states; return all states."""
    states = []

    def holds():
        states.append(motors.read())
        return condition(states[-1])

    until(holds)
    return states


def advance(motors, goal=0.050, speed=0.005):
    """Begin a motion of the insertion, and return while it moves."""
    motors.set_speed("insertion", speed, 1.0)
    motors.follow({"insertion": goal})
    return follow_until(motors, lambda s: s["insertion"].position > 0.0102)


def reconnect(motors):
    """Reconnect as a supervisor does: repeatedly while it connects."""

    def done():
        try:
            motors.reconnect()
        except DriverError as error:
            if str(error) != CONNECTING:
                raise
            return False
        return True

    until(done)


def test_the_states_are_the_positions_of_the_joints_and_repeated_without_newer_ones(motors, joints):
    states = motors.read()
    assert set(states) == {"insertion", "roll"}
    assert states["insertion"].position == states["insertion"].commanded == 0.010
    assert not states["insertion"].moving
    until(lambda: not motors.read()["roll"].repeated)
    joints.silent.set()
    until(lambda: all(state.repeated for state in motors.read().values()))
    assert motors.read()["roll"].position == joints.positions["roll"]


def test_nothing_is_sent_before_the_first_motion(motors, joints):
    for _ in range(5):
        motors.read()
    motors.stop()
    motors.set_speed("insertion", 0.005, 1.0)
    motors.define("roll", 1.0)
    motors.power("roll", True)
    sent = len(joints.targets)
    motors.follow({"insertion": 0.010})
    until(lambda: len(joints.targets) > sent)
    assert sent == 0


def test_a_motion_is_a_stream_of_set_points_at_the_limited_speed(motors, joints):
    begun = time.monotonic()
    states = advance(motors, goal=0.012, speed=0.020)
    states += follow_until(
        motors, lambda s: not s["insertion"].moving and abs(s["insertion"].position - 0.012) < 1e-9
    )
    assert states[0]["insertion"].moving
    commanded = [s["insertion"].commanded for s in states]
    assert commanded == sorted(commanded)
    places = [sent["insertion"] for _, sent in joints.targets]
    assert places == sorted(places)
    assert places[-1] == 0.012
    assert "roll" not in joints.targets[-1][1]
    for at, sent in joints.targets:  # they may arrive late, never early
        assert sent["insertion"] <= 0.010 + 0.020 * (at - begun) + 1e-9


def test_the_last_set_point_is_sent_again_since_one_may_be_dropped(monkeypatch, motors, joints):
    monkeypatch.setattr(module, "_REPEAT_S", 60.0)
    advance(motors, goal=0.012, speed=0.020)
    follow_until(motors, lambda s: not s["insertion"].moving and s["insertion"].position == 0.012)
    joints.positions["insertion"] = 0.011  # as if the last had not arrived
    follow_until(motors, lambda _: joints.positions["insertion"] == 0.012)


def test_without_calls_the_joints_stop(motors, joints):
    """The process of the rig is killed or hangs: the remaining motion is less than one set point."""
    advance(motors)
    before = motors.read()["insertion"].commanded
    until(lambda: joints.targets and joints.targets[-1][1]["insertion"] == before)
    count, ends = len(joints.targets), time.monotonic() + 0.2
    until(lambda: time.monotonic() > ends)
    assert len(joints.targets) == count
    assert joints.positions["insertion"] == before


def test_a_new_goal_replaces_the_old_one_and_a_new_connection_takes_up_none(connected, joints):
    motors = RosMotors(CHANNELS, lambda: borrowed(connected[1]))
    there = advance(motors, speed=0.010)[-1]["insertion"].commanded
    motors.follow({"insertion": 0.010})
    states = follow_until(motors, lambda s: not s["insertion"].moving)
    assert max(s["insertion"].commanded for s in states) < 0.050
    assert states[-1]["insertion"].commanded == 0.010 < there
    motors.follow({"insertion": 0.050})
    reconnect(motors)
    until(lambda: motors.read()["insertion"].commanded == joints.positions["insertion"])
    assert not motors.read()["insertion"].moving


def test_a_stop_holds_at_the_set_point_and_sends_no_earlier_one(motors, joints):
    advance(motors)
    joints.free.set()  # measured positions lag behind the set points, by 0.5 mm
    late = follow_until(motors, lambda s: s["insertion"].commanded > s["insertion"].position + 5e-4)[-1]
    motors.stop()
    state = motors.read()["insertion"]
    assert not state.moving
    assert state.commanded == late["insertion"].commanded
    until(lambda: joints.targets[-1][1]["insertion"] == state.commanded)
    places = [sent["insertion"] for _, sent in joints.targets]
    assert places == sorted(places)
    joints.free.clear()
    motors.stop()
    until(lambda: joints.positions["insertion"] == state.commanded)
    joints.free.set()  # a joint that sags is not followed by a second stop
    joints.positions["insertion"] -= 0.002
    until(lambda: motors.read()["insertion"].position < state.commanded - 0.001)
    motors.stop()
    assert motors.read()["insertion"].commanded == state.commanded


def test_positions_may_be_defined_at_rest(motors):
    motors.define("insertion", 0.0)
    assert motors.read()["insertion"].position == pytest.approx(0.0)
    motors.set_speed("insertion", 0.050, 1.0)
    motors.follow({"insertion": 0.002})
    states = follow_until(motors, lambda s: not s["insertion"].moving)
    assert states[-1]["insertion"].commanded == pytest.approx(0.002)
    motors.follow({"insertion": 100.0})
    with pytest.raises(DriverError, match="insertion moves"):
        motors.define("insertion", 0.0)


def test_old_states_are_an_error_and_a_stop_is_still_sent(connected, motors, joints, monkeypatch):
    advance(motors)
    joints.silent.set()
    monkeypatch.setattr(connected[1], "_stale", 0.1)
    with pytest.raises(DriverError, match=r"^/flexneedle/rig/joint_states: .* \d+\.\d+ s old"):
        follow_until(motors, lambda _: False)
    with pytest.raises(DriverError, match="s old"):
        motors.follow({"insertion": 0.050})
    sent = len(joints.targets)
    for _ in range(3):
        motors.stop()

    def hold():  # set points of the motion may arrive after `sent` was counted
        return (
            len(joints.targets) >= sent + 3
            and len({goal["insertion"] for _, goal in joints.targets[-3:]}) == 1
        )

    until(hold)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e9])
def test_an_impossible_position_of_a_joint_of_the_rig_is_refused_and_of_another_is_not(
    joints, motors, monkeypatch, connected, value
):
    joints.positions = {**START, "gripper": value}
    motors.read()
    until(lambda: not motors.read()["roll"].repeated)
    joints.positions["roll"] = value
    monkeypatch.setattr(connected[1], "_stale", 0.1)

    def refused():  # joint states may be older before the impossible position arrives
        try:
            motors.read()
        except DriverError as error:
            return f"s old: joint roll: {value:g} is not a position" in str(error)
        return False

    until(refused)


# Reconnecting


def test_reconnecting_keeps_no_tick_waiting(connected):
    """A tick calls it repeatedly; only the thread waits for the end of the old node and for the new one."""
    open_now, calls = Event(), []

    def connect():
        calls.append(1)
        assert len(calls) == 1 or open_now.wait(20.0)
        return borrowed(connected[1])

    motors = RosMotors(CHANNELS, connect)
    for _ in range(3):
        with pytest.raises(DriverError, match=f"^{CONNECTING}$"):
            motors.reconnect()
    with pytest.raises(DriverError, match=r"not connected$"):
        motors.read()
    open_now.set()
    reconnect(motors)
    assert set(motors.read()) == {"insertion", "roll"}
    assert len(calls) == 2


def test_a_failed_reconnection_is_reported_and_the_next_call_tries_again():
    found = iter([MagicMock(), RunError("no node"), DriverError("no states"), MagicMock()])

    def connect():
        link = next(found)
        if isinstance(link, Exception):
            raise link
        return link

    motors = RosMotors(CHANNELS, connect)
    for reason in ("no node", "no states"):
        with pytest.raises(DriverError, match=f"^{reason}$"):
            reconnect(motors)
    reconnect(motors)


def test_the_end_does_not_wait_for_a_connection_and_leaves_none(monkeypatch):
    """The node starts with the priority of its thread, which would otherwise be the supervisor's."""
    link, connected, order = MagicMock(), Event(), []
    monkeypatch.setattr(module, "set_normal_priority", lambda: order.append(current_thread().name))
    found = connect_in_thread(lambda: connected.wait(60.0) and link)
    close_once_open(found)
    assert not link.close.called
    connected.set()
    until(lambda: link.close.called)
    assert order == ["connecting"]


# Refusals


def test_invalid_calls_are_refused(motors, joints):
    refused = [
        (lambda: motors.follow({"elbow": 1.0}), "^joint 'elbow': must be one of insertion, roll$"),
        (lambda: motors.follow({"roll": math.nan}), "^joint roll: nan"),
        (lambda: motors.follow({"roll": 1.0}), "^joint roll: set its speed first"),
        (lambda: motors.set_speed("roll", 0.0, 1.0), "^joint roll: speed 0: must be above 0"),
        (lambda: motors.power("roll", False), "^joint roll: .*off"),
    ]
    for call, line in refused:
        with pytest.raises(DriverError, match=line):
            call()
    assert joints.targets == []


def test_joints_that_are_not_reported_are_named(monkeypatch, connected, joints):
    monkeypatch.setattr(module, "NodeClient", lambda *_, **__: borrowed(connected[1]._node))
    with pytest.raises(DriverError, match="no joint elbow; joints: insertion, roll, other"):
        make_motors({}, ("insertion", "elbow"))
    monkeypatch.setattr(module, "_CONNECT_S", 0.3)
    joints.silent.set()
    until(lambda: not any(isinstance(one, JointReading) for one in connected[1]._node.poll()))
    with pytest.raises(DriverError, match=r"^/flexneedle/rig/joint_states: no joint states"):
        make_motors({}, ("insertion",))
    for settings in ({"profile": "smartneedle"}, {"stale_ms": 0.0}):
        ((key, value),) = settings.items()
        with pytest.raises(RigError) as caught:
            make_motors(settings, ("insertion",))
        (line,) = caught.value.problems
        assert line.startswith(f"{key} = {json.dumps(value)}: must")


POSITIONS = st.floats(-1e3, 1e3)


@given(POSITIONS, POSITIONS, st.floats(1e-3, 1e3), st.lists(st.floats(0.0, 1.0), max_size=20))
def test_a_set_point_never_exceeds_its_speed_nor_its_goal(begin, goal, speed, steps):
    point, now = SetPoint(begin, goal, speed, 0.0), 0.0
    for step in steps:
        now += step
        after = point.advance(now)
        assert abs(after.position - point.position) <= speed * step * (1 + 1e-9) + 1e-9
        assert min(begin, goal) <= after.position <= max(begin, goal)
        point = after
    if abs(goal - begin) < speed * now * (1 - 1e-6):
        assert point.position == goal
