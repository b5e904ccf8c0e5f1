"""What stops the motors: motors, tracker, client and operator; and that nothing starts by itself."""

import math
from dataclasses import replace

import pytest

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import Bench, rig_file

FAR = protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)


def step(number=1, roll=0.0, expected=None, **travel):
    return protocol.StepCommand(number, roll, travel or {"insertion": 1.0}, 0.2, expected)


@pytest.fixture
def bench():
    made = Bench().armed()
    made.tick(3)
    return made


def assert_rests(bench):
    """Motors are stopped, and stay where they are."""
    bench.tick(20)
    at = {channel: motor.position for channel, motor in bench.stage.motors.items()}
    bench.tick(40)
    assert at == {channel: motor.position for channel, motor in bench.stage.motors.items()}
    assert bench.core.at_rest


def fail_on_the_way(bench, change):
    """Begin a step, change a motor on the way, and return how the step ended and how far the axis went on."""
    bench.core.request(step())
    bench.tick(3)
    at = bench.position("insertion")
    assert 0.1 < at < 0.9
    change(bench.stage)
    done = bench.until(1)
    assert done.state is bench.core.state is SupervisorState.FAULT
    bench.tick(20)
    bench.stage.lost = False
    assert_rests(bench)
    assert abs(bench.position("insertion") - at) <= 0.5
    return done.why


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            lambda stage: setattr(stage.motors["A"], "fault", "stall"),
            "insertion: the motor does not follow: 0.",
        ),
        (
            lambda stage: setattr(stage.motors["A"], "fault", "reversed"),
            "insertion: the motor does not follow: 0.",
        ),
        (lambda stage: setattr(stage.motors["A"], "on", False), "insertion: the motor is off"),
        (
            lambda stage: setattr(stage.motors["A"], "high", 400.0),
            "insertion: stopped by the motor controller: ",
        ),
        (lambda stage: stage.define("A", 0.0), "insertion: the position went back by 0."),
        (lambda stage: setattr(stage, "refuses", True), "PAA=5: ? 22 Begin not possible due to limit switch"),
        (lambda stage: setattr(stage, "lost", True), "no reply within 100 ms"),
        (
            lambda stage: setattr(stage.motors["C"], "position", 200.0),
            "guide_y: the motor does not follow: 0.400 mm",
        ),
    ],
)
def test_a_fault_of_a_motor_stops_all_of_them(bench, change, why):
    assert fail_on_the_way(bench, change).startswith(why)


def test_an_overshoot_is_found_at_the_end_of_the_step(bench):
    bench.stage.motors["A"].fault = "overshoot"
    bench.core.request(step(insertion=0.5))
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert done.why == "the motors have not arrived: insertion 0.100 mm from the goal"


def test_a_lost_controller_is_stopped_as_soon_as_it_can_be_reached_again(bench):
    bench.core.request(step())
    bench.tick(2)
    bench.stage.lost = True
    bench.tick(20)
    assert bench.core.state is SupervisorState.FAULT
    before = bench.stage.calls.count(("stop",))
    bench.stage.lost = False
    bench.tick(12)
    assert bench.stage.calls.count(("stop",)) > before
    assert ("reconnect",) in bench.stage.calls
    assert_rests(bench)


def test_a_motor_that_goes_on_after_a_stop_is_stopped_again(bench):
    bench.core.request(step())
    bench.tick(2)
    kept, bench.stage.stop = bench.stage.stop, lambda: bench.stage.calls.append(("ignored",))
    bench.core.request(protocol.StopCommand("the test"))
    bench.stage.motors["A"].target = 90_000.0
    bench.tick(5)
    assert bench.stage.calls.count(("ignored",)) == 1
    bench.stage.stop = kept
    bench.tick(15)
    assert ("stop",) in bench.stage.calls
    assert_rests(bench)


def test_an_axis_that_moves_without_a_command_is_a_fault(bench):
    def drift(counts):
        motor = bench.stage.motors["C"]
        motor.position = motor.commanded = motor.target = counts
        bench.tick()

    drift(19.0)
    assert bench.core.state is SupervisorState.ARMED  # 0.038 mm, twice the tolerance of a goal is 0.04 mm
    drift(25.0)
    assert bench.core.state is SupervisorState.FAULT
    assert bench.core.why == "guide_y: moved by 0.050 mm without a command"


@pytest.mark.parametrize(
    ("low", "high", "names"),
    [(0.0, math.inf, "reverse"), (-math.inf, 0.0, "forward"), (0.0, 0.0, "reverse and forward")],
)
def test_a_limit_switch_that_becomes_active_while_its_motor_rests_is_a_fault(bench, low, high, names):
    bench.core.request(step())
    bench.tick(3)
    motor = bench.stage.motors["C"]
    motor.low, motor.high = low, high
    bench.tick()
    assert bench.core.why == f"guide_y: at rest, {names} limit switch active"
    assert bench.until(1).state is SupervisorState.FAULT
    assert bench.position("insertion") < 1.0
    assert_rests(bench)


def test_a_limit_switch_that_becomes_active_as_its_motion_ends_is_a_fault(bench):
    """The controller still counts the axis as in motion, but has nothing to stop; later it rests."""
    bench.core.request(step())
    read, motor = bench.stage.read, bench.stage.motors["A"]
    late = []

    def at_the_end():
        found = read()
        if motor.position < 999.0:
            return found
        late.append(not late)
        return found | {"A": replace(found["A"], moving=late[-1], forward_limit=True)}

    bench.stage.read = at_the_end
    bench.until(1)
    bench.tick()
    assert bench.core.why == "insertion: at rest, forward limit switch active"


def test_a_limit_switch_that_becomes_active_during_a_hold_is_a_fault(bench):
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.stage.motors["A"].lag = 0.02
    bench.core.request(step(expected=FAR))
    bench.tick(2)
    bench.camera.tip = lambda _: (9.0, 9.0, 9.0)
    bench.tick()
    assert bench.core.state is SupervisorState.HOLDING
    assert not bench.reports[-1].at_rest
    bench.stage.motors["C"].low = 0.0
    bench.tick()
    assert bench.core.why == "guide_y: at rest, reverse limit switch active"


def test_a_channel_of_no_axis_that_a_driver_begins_to_report_changes_nothing(bench):
    read = bench.stage.read
    bench.stage.read = lambda: read() | {"X": replace(read()["A"], forward_limit=True)}
    bench.core.request(step())
    assert bench.until(1).travelled["insertion"] == pytest.approx(1.0, abs=0.02)
    assert bench.core.state is SupervisorState.INSERTING


@pytest.mark.parametrize("side", ["low", "high"])
def test_an_operator_may_move_an_axis_whose_limit_switch_is_active(side):
    bench = Bench(tracked=False)
    setattr(bench.stage.motors["C"], side, 0.0)
    bench.tick()
    bench.armed().tick(20)
    assert bench.core.state is SupervisorState.ARMED


AWAY = ", but the home is at 15.000 mm"


@pytest.mark.parametrize(
    ("home", "at", "low", "high", "problem"),
    [
        ("here", 0.0, -math.inf, 0.0, "the forward limit switch is active at 0.000 mm"),
        ("absolute", 0.0, 0.0, math.inf, "the reverse limit switch is active at 0.000 mm"),
        ("reverse-limit", 0.0, 0.0, math.inf, f"the reverse limit switch is active at 0.000 mm{AWAY}"),
        ("reverse-limit", -15.0, -math.inf, 7500.0, "the forward limit switch is active at -15.000 mm"),
        ("reverse-limit", 14.69, 0.0, math.inf, f"the reverse limit switch is active at 14.690 mm{AWAY}"),
        ("reverse-limit", 14.71, 0.0, math.inf, ""),
        ("reverse-limit", 15.0, 0.0, math.inf, ""),
        (
            "reverse-limit",
            15.0,
            0.0,
            -8000.0,
            "both limit switches are active: check their wiring and polarity",
        ),
    ],
)
def test_no_insertion_begins_at_a_limit_switch_but_that_of_the_home_and_there(home, at, low, high, problem):
    keys = {"home": home} | ({"home_mm": 15.0} if home == "reverse-limit" else {})
    bench = Bench(rig_file(guide_y=keys))
    motor = bench.stage.motors["C"]
    motor.position = motor.commanded = motor.target = -500.0 * at
    motor.low, motor.high = low, high
    bench.tick()
    bench.armed()
    assert bench.core.state is (SupervisorState.IDLE if problem else SupervisorState.ARMED)
    if problem:
        assert bench.sent[-1].why == f"arm: refused: guide_y: {problem}"
        assert ("power", "C", True) not in bench.stage.calls


@pytest.mark.parametrize("state", ["armed", "inserting"])
def test_after_a_stop_nothing_moves_until_the_rig_is_reset_and_armed(bench, state):
    if state == "inserting":
        bench.core.request(step())
        bench.tick(3)
    bench.core.request(protocol.StopCommand("the keyboard"))
    if state == "inserting":
        done = bench.until(1)
        assert (done.state, done.why) == (SupervisorState.STOPPED, "the keyboard")
        assert 0.0 < done.travelled["insertion"] < 1.0
    assert_rests(bench)
    bench.core.request(step(2))
    bench.core.request(protocol.ArmCommand(10.0))
    assert [type(one) for one in bench.sent[-2:]] == [protocol.RequestRefused, protocol.RequestRefused]
    assert bench.sent[-1].why == "arm: refused while stopped: the keyboard; accepted: stop, fault, reset, off"
    bench.core.request(protocol.ResetCommand())
    assert bench.core.state is SupervisorState.IDLE
    bench.core.request(protocol.ArmCommand(10.0))
    assert bench.core.state is SupervisorState.ARMED


def test_without_a_heartbeat_a_motion_is_stopped(bench):
    bench.core.request(protocol.MoveCommand(1, "insertion", 20.0, 2.0))
    bench.tick(30, beat=False)
    assert bench.core.state is SupervisorState.STOPPED
    assert bench.core.why.startswith("no heartbeat of the controller for 0.5")
    assert bench.position("insertion") < 1.3
    assert_rests(bench)


def test_without_a_command_the_insertion_is_stopped(bench):
    bench.core.request(step())
    bench.until(1)
    bench.tick(79, beat=False)
    assert bench.core.state is SupervisorState.INSERTING
    bench.tick(5, beat=False)
    assert bench.core.state is SupervisorState.STOPPED
    assert bench.core.why.startswith("no command of the controller for 2.0")


@pytest.mark.parametrize(
    ("tip", "seconds", "why"),
    [
        (lambda _: None, 0.35, "missing: no reading for 0.3"),
        (lambda _: "missing", 0.35, "missing: tip not measured (missing)"),
        (lambda _: (math.nan, 0.0, 0.0), 0.05, "not a number: x nan"),
        (lambda _: (0.5, 5.0, 0.0), 0.05, "innovation: 5."),
    ],
)
def test_a_bad_reading_holds_the_needle(bench, tip, seconds, why):
    expected = protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)
    bench.camera.tip = lambda time: (min(1.0, 0.5 * time), 0.0, 0.01 * time)
    bench.core.request(protocol.StepCommand(1, 0.0, {"insertion": 1.0}, 2.0, expected))
    bench.tick(8)
    bench.camera.tip = tip
    begun = bench.clock.now()
    done = bench.until(1)
    assert bench.clock.now() - begun <= seconds + 0.3
    assert done.state is SupervisorState.HOLDING
    assert done.why.startswith(why)
    assert 0.0 < done.travelled["insertion"] < 1.0
    assert_rests(bench)


def test_a_short_dropout_does_not_hold_the_needle(bench):
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.core.request(step(expected=protocol.Expectation((0.1, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)))
    bench.tick(2)
    seen, bench.camera.tip = bench.camera.tip, lambda _: None
    bench.tick(3)
    bench.camera.tip = seen
    assert bench.until(1).why == ""


def test_a_held_needle_moves_on_only_by_a_new_step_and_only_with_good_readings(bench):
    bench.core.request(step(expected=FAR))
    bench.camera.tip = lambda _: (0.5, 5.0, 0.0)
    bench.until(1)
    assert_rests(bench)
    bench.core.request(step(2, expected=FAR))
    done = bench.until(2)
    assert (done.why[:10], done.travelled["insertion"]) == ("innovation", 0.0)
    bench.camera.tip = lambda time: (0.5, 0.0, 1e-3 * time)
    bench.tick(200)
    assert bench.core.state is SupervisorState.HOLDING
    assert_rests(bench)
    bench.core.request(step(3, expected=FAR))
    assert bench.until(3).why == ""
    assert bench.core.state is SupervisorState.INSERTING


def test_a_reading_is_judged_again_by_what_the_next_step_expects(bench):
    """The tip has drifted away from what was expected, as far as it could have moved."""
    bench.core.request(step(expected=FAR))
    bench.camera.tip = lambda time: (0.5, min(5.0, 10.0 * time), 1e-3 * time)
    assert bench.until(1).why.startswith("innovation: 2.")
    bench.tick(60)
    there = protocol.Expectation((0.5, 5.0, 0.0), (1.5, 5.0, 0.0), 2.0)
    bench.core.request(step(2, expected=there))
    assert bench.until(2).why == ""


def test_a_roll_is_completed_when_the_needle_is_held(bench):
    bench.camera.tip = lambda time: (0.0, 0.0, 1e-3 * time)
    bench.core.request(step(roll=math.pi, expected=FAR))
    bench.tick(3)
    bench.camera.tip = lambda _: (math.nan, 0.0, 0.0)
    done = bench.until(1)
    assert done.why == "not a number: x nan, y nan, z nan"
    assert done.travelled["rotation"] == pytest.approx(math.pi, abs=0.02)
    assert done.travelled["insertion"] == 0.0
    assert_rests(bench)


def test_jogging_homing_and_retracting(bench):
    bench.core.request(protocol.MoveCommand(1, "guide_y", 3.0, 5.0))
    assert bench.core.state is SupervisorState.JOGGING
    assert bench.until(1).state is SupervisorState.ARMED
    assert bench.position("guide_y") == pytest.approx(3.0, abs=2e-3)
    bench.core.request(protocol.MoveCommand(2, "insertion", 1.0, 5.0, retract=True))
    assert "must withdraw the base, which is at 0.000 mm" in bench.sent[-1].why
    bench.core.request(protocol.MoveCommand(3, "insertion", -2.0, 5.0, retract=True))
    assert bench.core.state is SupervisorState.RETRACTING
    bench.until(3)
    assert bench.position("insertion") == pytest.approx(-2.0)
    for bad in (
        protocol.MoveCommand(4, "insertion", 120.0, 5.0),
        protocol.MoveCommand(5, "insertion", 1.0, 50.0),
        protocol.MoveCommand(6, "x", 1.0, 5.0),
    ):
        bench.core.request(bad)
        assert isinstance(bench.sent[-1], protocol.RequestRefused)


def test_a_state_that_is_repeated_does_not_show_that_a_motor_rests(bench):
    """As of joints that report at half the rate of the ticks, and go on after the motion of their set points."""
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.stage.motors["A"].lag = 0.03
    bench.core.request(step(expected=FAR))
    read, kept = bench.stage.read, []

    def at_half_the_rate():
        found = read()
        kept.append(
            found if len(kept) % 2 == 0 else {k: replace(one, repeated=True) for k, one in kept[-1].items()}
        )
        return kept[-1]

    bench.stage.read = at_half_the_rate
    bench.tick(4)
    bench.camera.tip = lambda _: (9.0, 9.0, 9.0)
    done = bench.until(1)
    assert done.state is SupervisorState.HOLDING
    assert done.travelled["insertion"] == pytest.approx(1e-3 * bench.stage.motors["A"].position, abs=2e-3)
    bench.tick(40)
    assert bench.core.state is SupervisorState.HOLDING
    assert bench.reports[-1].at_rest
