"""The driver `ros`: joints on topics."""

import math
import time
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from threading import Event, current_thread
from unittest.mock import MagicMock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulated import until
from flexneedle.errors import DriverError, RigError, RunError
from flexneedle.lab.ros.joints import JointLink, abandon, opening
from flexneedle.lab.ros.motors import SetPoint, make_motors
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.tracker import make_tracker
from ros_peers import Joints

NEUTRAL = load_profile("neutral")


@pytest.fixture
def joints():
    with Joints(NEUTRAL, insertion=0.010, roll=0.0, other=5.0) as joints:
        yield joints


@pytest.fixture
def motors(joints):  # noqa: ARG001  the joints have to be there first
    with make_motors({}, ("insertion", "roll")) as motors:
        yield motors


def follow_until(motors, condition):
    """Read as a supervisor does until the condition holds on the states; return all states."""
    states = []

    def holds():
        states.append(motors.read())
        return condition(states[-1])

    until(holds)
    return states


def reconnect(motors):
    """Reconnect as a supervisor does: again and again while it connects."""

    def done():
        try:
            motors.reconnect()
        except DriverError as error:
            if str(error) != "the ROS node is connecting":
                raise
            return False
        return True

    until(done)


def test_the_states_are_those_of_the_joints(motors):
    states = motors.read()
    assert set(states) == {"insertion", "roll"}
    assert states["insertion"].position == states["insertion"].commanded == 0.010
    assert not states["insertion"].moving


def test_states_without_newer_ones_are_repeated(motors, joints):
    until(lambda: not motors.read()["roll"].repeated)
    joints.silent.set()
    until(lambda: all(state.repeated for state in motors.read().values()))
    assert motors.read()["roll"].position == joints.positions["roll"]
    joints.silent.clear()
    until(lambda: not motors.read()["roll"].repeated)


def test_nothing_is_sent_before_a_motion_is_asked_for(motors, joints):
    for _ in range(5):
        motors.read()
    motors.stop()
    motors.set_speed("insertion", 0.005, 1.0)
    motors.define("roll", 1.0)
    motors.power("roll", True)
    seen = len(joints.targets)
    motors.follow({"insertion": 0.010})
    until(lambda: len(joints.targets) > seen)
    assert seen == 0


def test_a_motion_is_a_stream_of_set_points_at_the_limited_speed(motors, joints):
    motors.set_speed("insertion", 0.020, 1.0)
    begun = time.monotonic()
    motors.follow({"insertion": 0.012})
    states = follow_until(
        motors, lambda s: not s["insertion"].moving and abs(s["insertion"].position - 0.012) < 1e-9
    )
    assert time.monotonic() - begun > 0.1  # 2 mm at 20 mm/s
    times, places = zip(*((at, sent["insertion"]) for at, sent in joints.targets), strict=True)
    assert list(places) == sorted(places)
    assert places[0] == pytest.approx(0.010, abs=1e-3)
    assert places[-1] == 0.012
    for (t0, p0), (t1, p1) in zip(joints.targets, joints.targets[1:], strict=False):
        assert p1["insertion"] - p0["insertion"] <= 0.020 * (
            t1 - t0 + 0.05
        )  # on a busy machine they arrive together
    assert states[0]["insertion"].moving
    assert "roll" not in joints.targets[-1][1]
    assert times[0] >= begun


def test_without_calls_the_joints_stop(motors, joints):
    """The process of the rig is killed or hangs: what is left is less than one set point."""
    motors.set_speed("insertion", 0.005, 1.0)
    motors.follow({"insertion": 0.050})
    follow_until(motors, lambda s: s["insertion"].position > 0.0102)
    before = motors.read()["insertion"].commanded
    until(lambda: joints.targets and joints.targets[-1][1]["insertion"] == before)
    count = len(joints.targets)
    time_is_up = time.monotonic() + 0.2
    until(lambda: time.monotonic() > time_is_up)
    assert len(joints.targets) == count
    assert joints.positions["insertion"] == before


def test_a_stop_holds_at_the_set_point_and_sends_none_that_leads_back(motors, joints):
    motors.set_speed("insertion", 0.005, 1.0)
    motors.follow({"insertion": 0.050})
    follow_until(motors, lambda s: s["insertion"].position > 0.0102)
    joints.free.set()  # measured positions lag behind the set points, by 0.5 mm
    late = follow_until(motors, lambda s: s["insertion"].commanded > s["insertion"].position + 5e-4)[-1]
    motors.stop()
    state = motors.read()["insertion"]
    assert not state.moving
    assert state.commanded == pytest.approx(late["insertion"].commanded, abs=5e-5)
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


def test_a_new_goal_replaces_the_old_one(motors):
    motors.set_speed("insertion", 0.010, 1.0)
    motors.follow({"insertion": 0.050})
    follow_until(motors, lambda s: s["insertion"].position > 0.0105)
    motors.follow({"insertion": 0.010})
    states = follow_until(motors, lambda s: not s["insertion"].moving)
    assert max(s["insertion"].commanded for s in states) < 0.013


def test_positions_may_be_defined_at_rest(motors):
    motors.define("insertion", 0.0)
    assert motors.read()["insertion"].position == pytest.approx(0.0)
    motors.set_speed("insertion", 0.050, 1.0)
    motors.follow({"insertion": 0.002})
    states = follow_until(motors, lambda s: not s["insertion"].moving)
    assert states[-1]["insertion"].commanded == pytest.approx(0.002)
    motors.follow({"insertion": 0.050})
    with pytest.raises(DriverError, match="moves"):
        motors.define("insertion", 0.0)
    motors.stop()


def test_old_states_are_an_error_and_a_stop_is_sent_all_the_same(motors, joints):
    motors.set_speed("insertion", 0.005, 1.0)
    motors.follow({"insertion": 0.050})
    follow_until(motors, lambda s: s["insertion"].position > 0.0102)
    joints.silent.set()
    with pytest.raises(
        DriverError, match=r"/flexneedle/rig/joint_states: the last joint states are 0\.\d+ s old"
    ):
        follow_until(motors, lambda _: False)
    with pytest.raises(DriverError, match="s old"):
        motors.follow({"insertion": 0.050})
    sent = len(joints.targets)
    motors.stop()
    until(lambda: len(joints.targets) > sent)
    motors.stop()
    motors.stop()
    until(
        lambda: len(joints.targets) > sent + 2 and len({t["insertion"] for _, t in joints.targets[-3:]}) == 1
    )


def test_a_connection_anew_takes_up_no_motion(motors, joints):
    motors.set_speed("insertion", 0.005, 1.0)
    motors.follow({"insertion": 0.050})
    follow_until(motors, lambda s: s["insertion"].position > 0.0102)
    reconnect(motors)
    sent = len(joints.targets)
    assert not motors.read()["insertion"].moving
    motors.read()
    assert len(joints.targets) == sent


def test_connecting_anew_keeps_no_tick_waiting(motors, monkeypatch):
    """A tick calls it again and again; only the thread waits for the node, the end of the old one included."""
    connected, calls = Event(), []

    def slow(*given):
        calls.append(given)
        assert connected.wait(20.0)
        return JointLink(*given)

    monkeypatch.setattr(motors, "_connect", lambda: slow(NEUTRAL, ("insertion", "roll"), 0.2))
    for _ in range(3):
        with pytest.raises(DriverError, match=r"^the ROS node is connecting$"):
            motors.reconnect()
    with pytest.raises(DriverError, match=r"^the ROS node is not connected$"):
        motors.read()
    connected.set()
    reconnect(motors)
    assert set(motors.read()) == {"insertion", "roll"}
    assert len(calls) == 1


def test_why_a_connection_anew_fails_is_reported_and_the_next_call_tries_again(motors, joints, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.ros.joints._CONNECT_S", 0.3)
    joints.silent.set()
    with pytest.raises(DriverError, match=r"^/flexneedle/rig/joint_states: no joint states$"):
        reconnect(motors)
    joints.silent.clear()
    monkeypatch.undo()
    reconnect(motors)
    assert set(motors.read()) == {"insertion", "roll"}


def test_a_node_that_does_not_start_is_an_error_of_the_driver(motors, monkeypatch):
    def fail():
        raise RunError("the ROS node has not started within 30 s")

    monkeypatch.setattr(motors, "_connect", fail)
    with pytest.raises(DriverError, match=r"^the ROS node has not started within 30 s$"):
        reconnect(motors)


def test_the_end_does_not_wait_for_a_connection_and_leaves_none():
    link, connected = MagicMock(), Event()

    def slow():
        assert connected.wait(20.0)
        return link

    found = opening(slow)
    abandon(found)
    assert not link.close.called
    connected.set()
    until(lambda: link.close.called)


def test_a_connection_anew_has_no_priority_over_the_ticks(monkeypatch):
    """The node starts with the priority of its thread, which would else be that of the supervisor."""
    order = []
    monkeypatch.setattr(
        "flexneedle.lab.ros.joints.set_normal_priority", lambda: order.append(current_thread().name)
    )
    opening(lambda: order.append("connected")).result(20.0)
    assert order == ["connecting", "connected"]


def test_what_is_refused(motors, joints):
    refused = [
        (lambda: motors.follow({"elbow": 1.0}), "joint 'elbow': must be one of insertion, roll"),
        (lambda: motors.follow({"roll": math.nan}), "joint roll: nan is not a number"),
        (lambda: motors.follow({"roll": 1.0}), "joint roll: set its speed first"),
        (lambda: motors.set_speed("roll", 0.0, 1.0), "joint roll: speed 0: must be above 0"),
        (lambda: motors.power("roll", False), "joint roll: joints of topics cannot be switched off here"),
    ]
    for call, line in refused:
        with pytest.raises(DriverError, match=line):
            call()
    assert joints.targets == []


def test_without_joint_states_the_driver_does_not_start(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.ros.joints._CONNECT_S", 0.3)
    with pytest.raises(DriverError, match="/flexneedle/rig/joint_states: no joint states"):
        make_motors({}, ("insertion",))


def test_a_joint_that_is_not_reported_is_named(joints):  # noqa: ARG001
    with pytest.raises(DriverError, match="no joint elbow; joints: insertion, roll, other"):
        make_motors({}, ("insertion", "elbow"))


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"profile": "smartneedle"}, 'profile = "smartneedle": must list publish.joint_targets'),
        ({"stale_ms": 0.0}, "stale_ms = 0.0: must be above 0"),
    ],
)
def test_invalid_settings_are_one_line(settings, line):
    with pytest.raises(RigError) as caught:
        make_motors(settings, ("insertion",))
    assert caught.value.problems[0].startswith(line)


POSITIONS = st.floats(-1e3, 1e3)


@given(POSITIONS, POSITIONS, st.floats(1e-3, 1e3), st.lists(st.floats(0.0, 1.0), max_size=20))
def test_a_set_point_never_exceeds_its_speed_nor_its_goal(begin, goal, speed, steps):
    point, now = SetPoint(begin, goal, speed, 0.0), 0.0
    for step in steps:
        now += step
        after = point.at(now)
        assert abs(after.position - point.position) <= speed * step * (1 + 1e-9) + 1e-9
        assert min(begin, goal) <= after.position <= max(begin, goal)
        point = after
    expected = goal if abs(goal - begin) <= speed * now else None
    if expected is not None and abs(goal - begin) < speed * now * (1 - 1e-6):
        assert point.position == goal


def test_they_are_found_by_name():
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    found = {
        group: EntryPoint("ros", parts["ros"], group) for group, parts in project["entry-points"].items()
    }
    assert found["flexneedle.drivers"].load() is make_motors
    assert found["flexneedle.trackers"].load() is make_tracker
