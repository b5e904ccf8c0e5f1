"""Motors driven in real time on the emulated controller in a process of its own, with its faults."""

from contextlib import contextmanager
from itertools import pairwise
from time import monotonic

import pytest

from emulated import DEADLINE_S, emulator, until
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.motors import factory

COUNTS_PER_MM = 10_000.0
SPEED, ACCELERATION = 5.8579 * COUNTS_PER_MM, 200.0 * COUNTS_PER_MM  # 1 mm in 0.2 s
TICK_S, AHEAD_S = 0.025, 0.075


@contextmanager
def rig(*faults, mode="tracking", timeout_ms=1000):
    """Motors A and B of an emulated controller, switched on; faults are since the first motion."""
    arguments = [text for fault in faults for text in ("--fault", fault)]
    with emulator(*arguments, device="galil") as (address, _):
        given = {"address": address, "mode": mode, "reply_timeout_ms": timeout_ms}
        with factory(given, ("A", "B")) as motors:
            for channel in "AB":
                motors.power(channel, True)
                motors.set_speed(channel, SPEED, ACCELERATION)
            yield motors


def settled(motors):
    found = {}

    def rest():
        found.update(motors.read())
        return not any(state.moving for state in found.values())

    until(rest)
    return found


def travelled(time):
    """Position (counts) of a move of 1 mm in 0.2 s, with equal ramps."""
    ramp = SPEED / ACCELERATION
    end = COUNTS_PER_MM / SPEED + ramp
    time = min(max(time, 0.0), end)
    if time < ramp:
        return 0.5 * ACCELERATION * time**2
    if time > end - ramp:
        return COUNTS_PER_MM - 0.5 * ACCELERATION * (end - time) ** 2
    return SPEED * (time - 0.5 * ramp)


def streamed(motors, seconds):
    """Send what is to be reached AHEAD_S later, each TICK_S, and read; give the times of the first target, and of each
    reading with its state."""
    first, readings = None, []
    begin = monotonic()
    while monotonic() < begin + seconds:
        sent = monotonic()
        motors.follow({"A": travelled(sent - begin + AHEAD_S)})
        first = first or (sent, monotonic())
        due = sent + TICK_S
        before = monotonic()
        readings.append((before, motors.read()["A"], monotonic()))
        until(lambda due=due: monotonic() >= due)
    return first, readings


@pytest.mark.parametrize("mode", ["tracking", "moves"])
def test_a_motor_goes_where_it_is_told_and_back(mode):
    with rig(mode=mode) as motors:
        for goal in (3000.0, -500.0):
            motors.follow({"A": goal, "B": -goal})
            assert motors.read()["A"].moving
            states = settled(motors)
            assert (states["A"].position, states["B"].position) == (goal, -goal)
            assert states["A"].stopped == ""


def test_streamed_targets_are_followed_within_a_fiftieth_of_a_millimetre():
    """Up to when the first target was carried out, which is not known better than its call took.

    Where this process was not scheduled for so long that the motor ran out of targets, it is tried again.
    """
    with rig() as motors:
        for _ in range(20):
            settled(motors)
            motors.define("A", 0.0)
            (sent, answered), readings = streamed(motors, 0.3)
            ends = [after for _, _, after in readings]
            if max(later - earlier for earlier, later in pairwise(ends)) < AHEAD_S - TICK_S:
                break
    for before, state, after in readings:
        least = travelled(before - answered) - 0.02 * COUNTS_PER_MM
        most = travelled(after - sent) + 0.02 * COUNTS_PER_MM
        assert least <= state.position <= most
        assert state.commanded == pytest.approx(state.position, abs=1)
    assert readings[-1][1].position == pytest.approx(COUNTS_PER_MM, abs=1)


def test_when_targets_end_the_motor_stops_after_the_motion_that_was_sent_ahead():
    with rig() as motors:
        for _ in range(5):
            at = motors.read()["A"].commanded
            motors.follow({"A": at + SPEED * AHEAD_S})
        end = settled(motors)["A"].position
    assert 0 < end - at <= SPEED * AHEAD_S + 1


def test_speed_changes_under_way_while_targets_are_streamed():
    with rig() as motors:
        for k in range(1, 21):
            motors.set_speed("A", SPEED * (0.5 if k % 2 else 1.0), ACCELERATION)
            motors.follow({"A": 100.0 * k, "B": -100.0 * k})
            motors.read()
        states = settled(motors)
    assert (states["A"].position, states["B"].position) == (2000, -2000)


def test_a_stop_takes_no_more_than_the_deceleration():
    with rig() as motors:
        motors.follow({"A": 1e6})
        until(lambda: motors.read()["A"].position > 2000)
        at = motors.read()["A"].position
        begin = monotonic()
        motors.stop()
        took = monotonic() - begin
        state = settled(motors)["A"]
    assert 0 < state.position - at <= SPEED**2 / (2 * ACCELERATION) + SPEED * (took + 0.01)
    assert (state.on, state.stopped) == (True, "")


def test_a_limit_switch_is_reported_and_why_the_motor_rests():
    with rig("limit=A@0.05") as motors:
        motors.follow({"A": 1e6})
        until(lambda: motors.read()["A"].stopped)
        state = settled(motors)["A"]
        assert state.stopped == "at the forward limit: its switch, or FL"
        assert (state.forward_limit, state.reverse_limit, state.on) == (True, True, True)
        with pytest.raises(DriverError, match="refused: 22 Begin not possible due to Limit Switch"):
            motors.follow({"A": 1e6})


def test_a_motor_that_is_switched_off_is_reported():
    with rig("off=A@0.05") as motors:
        motors.follow({"A": 1e6, "B": 500.0})
        until(lambda: not motors.read()["A"].on)
        state = motors.read()["A"]
        assert state.stopped == ""  # nobody has said why
        assert not state.moving
        with pytest.raises(DriverError, match="PT 1 refused: 20 Begin not valid with motor off"):
            motors.follow({"A": 0.0})


def test_a_position_that_is_reset_is_visible():
    with rig("reset=A@0.1") as motors:
        motors.follow({"A": 1e6})
        positions = []

        def fell():
            positions.append(motors.read()["A"].position)
            return len(positions) > 1 and positions[-1] < positions[-2]

        until(fell)
    *before, last = positions
    assert before == sorted(before)
    assert 0.0 <= last < before[-1]


@pytest.mark.parametrize("fault", ["stall", "lag", "overshoot", "reversed"])
def test_a_motor_that_does_not_follow_is_reported_beside_what_was_commanded(fault):
    with rig(f"{fault}=A@0") as motors:
        motors.follow({"A": 5000.0})
        states = []

        def differs():
            states.append(motors.read()["A"])
            return abs(states[-1].commanded - states[-1].position) > 0.02 * COUNTS_PER_MM

        until(differs)
    assert all((state.on, state.stopped) == (True, "") for state in states)


def test_a_refused_command_has_the_controllers_reason():
    with rig("refuse=6@0.02") as motors:
        motors.follow({"A": 1e6})

        messages = []

        def refused():
            try:
                motors.follow({"A": 1e6})
            except DriverError as error:
                messages.append(str(error))
            return messages

        until(refused)
    assert messages[0].endswith("PA 1000000 refused: 6 Number out of range")


def lost(motors):
    """Read until the connection is lost; return the message and how long the last call took."""
    deadline = monotonic() + DEADLINE_S
    while monotonic() < deadline:
        begin = monotonic()
        try:
            motors.read()
        except DriverError as error:
            return str(error), monotonic() - begin
    raise AssertionError("the connection was not lost in time")


def reconnected(motors):
    try:
        motors.reconnect()
    except DriverError:
        return False
    return True


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        ("unplug@0.02:0.3", "closed the connection|reset"),
        ("half-open@0.02:0.3", "no reply in time"),
        ("silence@0.02:0.3", "no reply in time"),
        ("delay=0.5@0.02:0.3", "no reply in time"),
        ("cut@0.02:0.3", "no reply in time|numbers"),
        ("chatter@0.02:0.3", "numbers"),
        ("garbled@0.02:0.3", "no reply in time|numbers|not a reply|refusal|refused|position|byte|more than"),
    ],
)
def test_a_line_that_fails_is_noticed_and_can_be_renewed(fault, problem):
    timeout_s = 0.1
    with rig(fault, timeout_ms=1e3 * timeout_s) as motors:
        motors.follow({"A": SPEED * AHEAD_S})
        message, took = lost(motors)
        until(lambda: reconnected(motors))
        motors.stop()
        state = settled(motors)["A"]
        motors.follow({"A": 100.0})
        assert settled(motors)["A"].position == 100
    assert any(part in message for part in problem.split("|")), message
    assert took < timeout_s + 0.2
    assert state.position <= SPEED * AHEAD_S


@pytest.mark.parametrize("fault", ["silence@0.05:0.3", "delay=0.5@0.05:0.3"])
def test_motors_whose_state_is_unknown_are_stopped(fault):
    """Although their targets are far."""
    with rig(fault, timeout_ms=100) as motors:
        motors.follow({"A": 1e6})
        lost(motors)
        until(lambda: reconnected(motors))
        state = settled(motors)["A"]
    assert 0 < state.position < SPEED * 0.3


def test_delays_within_the_timeout_are_waited_for():
    with rig("delay=0.05@0") as motors:
        motors.follow({"A": 500.0})
        assert settled(motors)["A"].position == 500
