"""Limit switches that become active, or are active before an insertion."""

import math
from dataclasses import replace

import pytest

from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import Bench, rig_file


@pytest.mark.parametrize(
    ("low", "high", "names"),
    [(0.0, math.inf, "reverse"), (-math.inf, 0.0, "forward"), (0.0, 0.0, "reverse and forward")],
)
def test_a_limit_switch_that_becomes_active_while_its_motor_rests_is_a_fault(bench, low, high, names):
    bench.step()
    bench.tick(3)
    motor = bench.stage.motors["C"]
    motor.low, motor.high = low, high
    bench.tick()
    assert bench.why == f"guide_y: at rest, {names} limit switch active"
    assert bench.until(1).state is SupervisorState.FAULT
    assert bench.position("insertion") < 1.0
    bench.assert_rests()


def test_a_limit_switch_that_becomes_active_as_its_motion_ends_is_a_fault(bench):
    """The controller still counts the axis as moving, but has nothing to stop; later it rests."""
    bench.step()
    read, motor = bench.stage.read, bench.stage.motors["A"]
    late = []

    def read_at_the_end():
        found = read()
        if motor.position < 999.0:
            return found
        late.append(not late)
        return found | {"A": replace(found["A"], moving=late[-1], forward_limit=True)}

    bench.stage.read = read_at_the_end
    bench.until(1)
    bench.tick()
    assert bench.why == "insertion: at rest, forward limit switch active"


def test_a_limit_switch_that_becomes_active_during_a_hold_is_a_fault(bench):
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.stage.motors["A"].lag = 0.02
    bench.step(expected=protocol.Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0))
    bench.tick(2)
    bench.camera.tip = lambda _: (9.0, 9.0, 9.0)
    bench.tick()
    assert bench.state is SupervisorState.HOLDING
    assert not bench.reports[-1].at_rest
    bench.stage.motors["C"].low = 0.0
    bench.tick()
    assert bench.why == "guide_y: at rest, reverse limit switch active"


@pytest.mark.parametrize("side", ["low", "high"])
def test_an_operator_may_move_an_axis_whose_limit_switch_is_active(side):
    bench = Bench(tracked=False)
    setattr(bench.stage.motors["C"], side, 0.0)
    bench.tick()
    bench.armed().tick(20)
    assert bench.state is SupervisorState.ARMED


def test_a_known_limit_switch_that_becomes_active_once_more_is_a_fault():
    bench = Bench(tracked=False)
    motor = bench.stage.motors["C"]
    motor.low = 0.0
    bench.tick()
    bench.armed().tick()
    motor.low = -math.inf
    bench.tick()
    assert bench.state is SupervisorState.ARMED
    motor.low = 0.0
    bench.tick()
    assert bench.state is SupervisorState.FAULT
    assert bench.why == "guide_y: at rest, reverse limit switch active"


AWAY = ", but the home is at 15.000 mm"
FREE = math.inf


@pytest.mark.parametrize(
    ("home", "at", "low", "high", "problem"),
    [
        ("here", 0.0, -FREE, 0.0, "the forward limit switch is active at 0.000 mm"),
        ("absolute", 0.0, 0.0, FREE, "the reverse limit switch is active at 0.000 mm"),
        ("reverse-limit", 0.0, 0.0, FREE, f"the reverse limit switch is active at 0.000 mm{AWAY}"),
        ("reverse-limit", -15.0, -FREE, 7500.0, "the forward limit switch is active at -15.000 mm"),
        ("reverse-limit", 14.69, 0.0, FREE, f"the reverse limit switch is active at 14.690 mm{AWAY}"),
        ("reverse-limit", 14.71, 0.0, FREE, ""),
        ("reverse-limit", 15.0, 0.0, FREE, ""),
        ("reverse-limit", 15.0, 0.0, -8000.0, "both limit switches are active"),
    ],
)
def test_an_insertion_begins_at_no_limit_switch_but_at_its_home(home, at, low, high, problem):
    keys = {"home": home} | ({"home_mm": 15.0} if home == "reverse-limit" else {})
    bench = Bench(rig_file(guide_y=keys))
    motor = bench.place("C", -500.0 * at)
    motor.low, motor.high = low, high
    bench.tick()
    bench.armed()
    assert bench.state is (SupervisorState.IDLE if problem else SupervisorState.ARMED)
    if problem:
        assert bench.refusal.startswith(f"arm: refused: guide_y: {problem}")
        assert ("C", True) not in bench.calls("power")
