"""Motors driven in real time on the emulated controller in a separate process, with its faults."""

from itertools import pairwise
from time import monotonic

import pytest

from emulated import emulator, until
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.motors import factory
from galil_peer import settled

COUNTS_PER_MM = 10_000.0
SPEED, ACCELERATION = 5.8579 * COUNTS_PER_MM, 200.0 * COUNTS_PER_MM  # 1 mm in 0.2 s
TICK_S, AHEAD_S, PATIENT_S = 0.025, 0.075, 60.0


@pytest.fixture(scope="module")
def controller():
    """The address of the controller, and the function that sends it an order."""
    with emulator(device="galil") as started:
        yield started


@pytest.fixture
def order(controller):
    """Inject a fault; all faults end with the test."""
    yield controller[1]
    controller[1]("clear")


@pytest.fixture
def motors(controller):
    """Motors A and B at 0, switched on, whose replies may be late on a busy machine."""
    with factory({"address": controller[0], "reply_timeout_ms": 1000}, ("A", "B")) as found:
        found._timeout = PATIENT_S
        for channel in "AB":
            found.power(channel, False)
            found.define(channel, 0.0)
            found.power(channel, True)
            found.set_speed(channel, SPEED, ACCELERATION)
        yield found


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


def stream(motors, seconds):
    """Send each TICK_S the position of AHEAD_S later, and read; return the times around the first target and around
    each reading, with its state."""
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


def test_streamed_targets_are_followed_within_a_fiftieth_of_a_millimetre(motors):
    """The time of the first target is known only to within the duration of its call.

    If this process was not scheduled until the motor ran out of targets, the test tries again.
    """
    for _ in range(20):
        settled(motors)
        motors.define("A", 0.0)
        (sent, answered), readings = stream(motors, 0.3)
        ends = [after for _, _, after in readings]
        if max(later - earlier for earlier, later in pairwise(ends)) < AHEAD_S - TICK_S:
            break
    for before, state, after in readings:
        least = travelled(before - answered) - 0.02 * COUNTS_PER_MM
        most = travelled(after - sent) + 0.02 * COUNTS_PER_MM
        assert least <= state.position <= most
        assert state.commanded == pytest.approx(state.position, abs=1)
    assert readings[-1][1].position == pytest.approx(COUNTS_PER_MM, abs=1)


def lose(motors, order, fault):
    """Read with a fault of the line until the connection is lost, and connect again; return the message."""
    motors._timeout = PATIENT_S if fault == "unplug" else 0.5
    messages = []

    def fails():
        try:
            motors.read()
        except DriverError as error:
            messages.append(str(error))
        return messages

    order(f"fault {fault}")
    until(fails)
    order("clear")
    motors._timeout = PATIENT_S
    until(lambda: is_reconnected(motors))
    return messages[0]


def is_reconnected(motors):
    try:
        motors.reconnect()
    except DriverError:
        return False
    return True


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        ("unplug", "closed the connection|reset"),
        ("silence", "no reply in time"),
        ("garbled", "no reply in time|numbers|not a reply|refusal|refused|position|byte|more than"),
    ],
)
def test_a_line_that_fails_is_noticed_and_can_be_renewed(motors, order, fault, problem):
    motors.follow({"A": SPEED * AHEAD_S})
    message = lose(motors, order, fault)
    motors.stop()
    state = settled(motors)["A"]
    motors.follow({"A": 100.0})
    assert settled(motors)["A"].position == 100
    assert any(part in message for part in problem.split("|")), message
    assert state.position <= SPEED * AHEAD_S


def test_motors_whose_state_is_unknown_are_stopped_far_from_their_targets(motors, order):
    motors.follow({"A": 1e6})
    lose(motors, order, "silence")
    assert 0 < settled(motors)["A"].position < 1e6
