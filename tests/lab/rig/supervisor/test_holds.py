"""Holds of the needle: bad readings of the tracker, and the conditions under which the needle moves again."""

import math
from dataclasses import replace

import pytest

from flexneedle.errors import DriverError
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import Expectation
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, SensorReading
from stages import TICK_S, Bench

AHEAD = Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)
LOST = (math.nan, 0.0, 0.0)


@pytest.mark.parametrize(
    ("tip", "seconds", "why"),
    [
        (lambda _: None, 0.35, "missing: no reading for 0.3"),
        (lambda _: "missing", 0.35, "missing: tip not measured (missing)"),
        (lambda _: LOST, 0.05, "not a number: x nan"),
        (lambda _: (0.5, 5.0, 0.0), 0.05, "innovation: 5."),
    ],
)
def test_a_bad_reading_holds_the_needle(bench, tip, seconds, why):
    bench.camera.tip = lambda time: (min(1.0, 0.5 * time), 0.0, 0.01 * time)
    bench.step(duration=2.0, expected=AHEAD)
    bench.tick(8)
    bench.camera.tip = tip
    begun = bench.clock.now()
    done = bench.until(1)
    assert bench.clock.now() - begun <= seconds + 0.3
    assert done.state is SupervisorState.HOLDING
    assert done.why.startswith(why)
    assert done.begun < done.ended <= bench.clock.now()
    speed = done.travelled["insertion"] / (done.ended - done.begun)
    assert speed == pytest.approx(0.5, rel=0.1)
    bench.assert_rests()


@pytest.mark.parametrize(("bad", "why"), [("late", "stale: 0.4"), ("indicator", "field distorted: ref1 0.")])
def test_late_readings_and_a_distorted_field_hold_the_needle(bad, why):
    bench = Bench(monitor=MonitorSettings(references=1)).armed()
    state = {"late": 0.0, "indicator": 0.02}

    def read():
        now = bench.clock.now()
        bench.camera.number += 1
        tip = SensorReading((0.5 * now, 0.0, 0.01 * now))
        reference = SensorReading((0.0, 0.0, 0.0), None, state["indicator"])
        return (Frame(now - state["late"], bench.camera.number, {"tip": tip, "ref1": reference}),)

    bench.camera.read = read
    bench.tick(60)
    begin = 0.5 * bench.clock.now()
    ahead = Expectation((begin, 0.0, 0.0), (begin + 2.0, 0.0, 0.0), 2.0)
    bench.step(expected=ahead, duration=4.0, insertion=2.0)
    bench.tick(10)
    assert bench.state is SupervisorState.INSERTING
    state[bad] = {"late": 0.4, "indicator": 0.2}[bad]
    done = bench.until(1)
    assert done.why.startswith(why)
    assert done.ended <= bench.clock.now() < 60 * TICK_S + 0.25 + 0.9


def test_a_tracker_that_fails_is_a_fault(bench):
    def fail():
        raise DriverError("no connection")

    bench.step(duration=2.0)
    bench.tick(8)
    bench.camera.read = fail
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.FAULT, "no connection")
    assert 0.0 < done.travelled["insertion"] < 1.0
    bench.assert_rests()


def test_a_short_dropout_does_not_hold_the_needle(bench):
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.step(expected=AHEAD)
    bench.tick(2)
    seen, bench.camera.tip = bench.camera.tip, lambda _: None
    bench.tick(3)
    bench.camera.tip = seen
    assert bench.until(1).why == ""


def test_a_held_needle_moves_only_after_a_new_step_with_good_readings(bench):
    bench.step(expected=AHEAD)
    bench.camera.tip = lambda _: (0.5, 5.0, 0.0)
    bench.until(1)
    bench.assert_rests()
    bench.step(2, expected=AHEAD)
    done = bench.until(2)
    assert (done.why[:10], done.travelled["insertion"]) == ("innovation", 0.0)
    bench.camera.tip = lambda time: (0.5, 0.0, 1e-3 * time)
    bench.tick(200)
    assert bench.state is SupervisorState.HOLDING
    bench.assert_rests()
    bench.step(3, expected=AHEAD)
    assert bench.until(3).why == ""
    assert bench.state is SupervisorState.INSERTING


def test_a_reading_is_judged_again_by_the_expectation_of_the_next_step(bench):
    """The tip has drifted from the first expectation, as far as it could have moved."""
    bench.step(expected=AHEAD)
    bench.camera.tip = lambda time: (0.5, min(5.0, 10.0 * time), 1e-3 * time)
    assert bench.until(1).why.startswith("innovation: 2.")
    bench.tick(60)
    bench.step(2, expected=Expectation((0.5, 5.0, 0.0), (1.5, 5.0, 0.0), 2.0))
    assert bench.until(2).why == ""


def test_a_tip_that_is_as_late_as_its_motor_does_not_hold_the_needle(bench):
    motor = bench.stage.motors["A"]
    bench.camera.tip = lambda time: (motor.position / 1000.0, 0.0, 1e-3 * time)
    bench.step(expected=Expectation((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), 1.0), duration=0.8, insertion=4.0)
    motor.speed = 2500.0  # half of the speed of the step
    assert bench.until(1).why == ""
    assert bench.position("insertion") == pytest.approx(4.0, abs=2e-3)


def test_no_step_begins_with_a_tracker_that_has_not_replied(bench):
    bench.camera.tip = lambda _: None
    bench.tick(20)
    bench.step(expected=AHEAD)
    assert bench.sent[-1].why.startswith("missing: no reading for 0.5")
    bench.tick(20)
    assert bench.position("insertion") == 0.0


def test_a_roll_is_completed_when_the_needle_is_held(bench):
    bench.camera.tip = lambda time: (0.0, 0.0, 1e-3 * time)
    bench.step(roll=math.pi, expected=AHEAD)
    bench.tick(3)
    bench.camera.tip = lambda _: LOST
    done = bench.until(1)
    assert done.why.startswith("not a number: x nan")
    assert done.travelled["rotation"] == pytest.approx(math.pi, abs=0.02)
    assert done.travelled["insertion"] == 0.0
    bench.assert_rests()


def test_during_a_roll_the_tip_is_expected_at_rest(bench):
    """A tip whose position is repeated to the last digit is not frozen before the needle travels."""
    bench.camera.tip = lambda _: (0.0, 0.0, 0.0)
    bench.step(roll=math.pi, expected=AHEAD)
    while bench.stage.motors["A"].position == 0.0 and not bench.sent:
        bench.tick()
    assert not bench.sent


@pytest.mark.parametrize("repeats", [False, True])
def test_a_hold_with_a_lagging_servo_ends_once_the_servo_rests(bench, repeats):
    """A repeated state, of joints that report at half the rate of the ticks, does not show that a motor rests."""
    bench.camera.tip = lambda time: (time, 0.0, 0.01 * time)
    bench.stage.motors["A"].lag = 0.03
    bench.step(expected=AHEAD)
    read, kept = bench.stage.read, []

    def read_every_second():
        found = read()
        if len(kept) % 2:
            found = {channel: replace(state, repeated=True) for channel, state in kept[-1].items()}
        kept.append(found)
        return found

    if repeats:
        bench.stage.read = read_every_second
    bench.tick(4)
    bench.camera.tip = lambda _: LOST
    done = bench.until(1)
    assert done.state is SupervisorState.HOLDING
    assert done.travelled["insertion"] == pytest.approx(1e-3 * bench.stage.motors["A"].position, abs=2e-3)
    bench.tick(40)
    assert bench.state is SupervisorState.HOLDING
    assert bench.reports[-1].at_rest
