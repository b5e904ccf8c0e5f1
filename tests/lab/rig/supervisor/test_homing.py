"""Homing: at a switch on either side, in either direction of the motor, or at the present position."""

import math
from dataclasses import replace

import pytest

from flexneedle.errors import DriverError
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import TICK_S, Bench, Stage, rig_file

SWITCH_MM, HOME_MM, BACK_OFF_MM = 8.0, 15.0, 0.6
"""Position of the guide's switch before homing, its position in the rig file, and the distance that it backs off."""


def bench_of(**keys):
    """Return an armed bench whose guide has these keys, and the guide's motor."""
    bench = Bench(rig_file(guide_y=keys)).armed()
    return bench, bench.stage.motors["C"]


def forward(**keys):
    """Return a bench whose guide has its home at the forward switch, and the guide's motor."""
    return bench_of(home="forward-limit", home_mm=-15.5, **keys)


def guide(at=SWITCH_MM, **ends):
    """Return a bench whose guide rests at a position (mm), and its motor; ends: of its limit switches (counts)."""
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": HOME_MM}), tracked=False)
    motor = bench.place("C", -500.0 * at)
    motor.low = -500.0 * SWITCH_MM
    vars(motor).update(ends)
    bench.tick()
    return bench.armed(), motor


def assert_found(bench, position, tolerance):
    """Assert that the search ends without a problem, at this position (mm) of the guide."""
    done = bench.until(1)
    assert (done.why, done.state) == ("", SupervisorState.IDLE)
    bench.tick(20)
    assert bench.position("guide_y") == pytest.approx(position, abs=tolerance)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("home", ["reverse-limit", "forward-limit"])
def test_an_axis_finds_its_switch_and_moves_into_its_range(home, direction):
    to_home = direction * (1 if home == "forward-limit" else -1)
    bench, motor = bench_of(home=home, home_mm=15.5 * to_home, direction=direction)
    motor.low, motor.high = -2000.0, 1500.0  # counts, 500 a mm
    bench.home("guide_y")
    assert bench.state is SupervisorState.HOMING
    assert_found(bench, (15.0 - 0.6) * to_home, 2e-3)
    switch = motor.low if home == "reverse-limit" else motor.high
    assert switch == pytest.approx(direction * 500.0 * 15.5 * to_home, abs=1e-6)
    bench.step(2)
    assert bench.refusal.startswith("step: refused while idle")
    bench.armed()
    bench.move("guide_y", 14.0 * to_home, number=3)
    assert bench.until(3).why == ""


@pytest.mark.parametrize("phase", [0.0, 0.7])
@pytest.mark.parametrize("seconds", [0.005, 0.03, 0.1])
def test_the_home_of_an_axis_that_slows_down_at_its_switch_is_where_it_rests(seconds, phase):
    """The motor controller reports the stop some ticks before the axis rests, and refuses targets meanwhile."""
    bench, motor = forward()
    motor.coasts, motor.high = seconds, 500.0 * (1.0 + 1.0 * TICK_S * phase)
    bench.home("guide_y")
    assert_found(bench, -14.4, 2e-3)
    assert bench.calls("define") == [("C", pytest.approx(500.0 * 14.4, abs=1.0))]
    assert 500.0 * 15.5 - motor.high == pytest.approx(500.0 * 1.0 * seconds / 2.0, abs=2.0)


@pytest.mark.parametrize("late", [0.0, 0.8, 0.99])
def test_ticks_in_quick_succession_do_not_show_that_a_servo_rests(late):
    """Every other tick is late, by this share of its time. The controller counts the axis as at rest meanwhile."""
    bench, motor = forward(speed_mm_s=40.0)
    motor.coasts, motor.lag, motor.high = 0.01, 0.02, 1000.0
    bench.home("guide_y")
    for _ in range(10_000):
        if bench.state is not SupervisorState.HOMING:
            break
        bench.clock.wait(late * TICK_S)
        bench.tick()
        bench.clock.wait(-late * TICK_S)
        bench.tick()
    assert_found(bench, -14.4, 0.02)


def test_a_home_is_set_after_the_servo_rests_off_the_switch(monkeypatch):
    """A servo continues between the reading from which the position is shifted and the shift, which may be slow."""
    bench, motor = forward(speed_mm_s=40.0)
    motor.lag, motor.high, define = 0.02, 1000.0, bench.stage.define

    def define_late(*arguments):
        bench.clock.wait(0.1)
        bench.stage.read()
        define(*arguments)

    monkeypatch.setattr(bench.stage, "define", define_late)
    bench.home("guide_y")
    assert_found(bench, -14.4, 2e-3)


def test_a_search_is_slow_and_backs_off_from_the_switch():
    bench, motor = forward()
    motor.high = 1000.0  # counts, 500 a mm
    bench.home("guide_y")
    assert bench.until(1).why == ""
    assert [speed for _, speed, _ in bench.calls("set_speed")] == pytest.approx([500.0, 500.0])
    at = [report.axes["guide_y"].position for report in bench.reports]
    assert min(at[:-1]) == pytest.approx(-2.0, abs=0.1)
    assert at[-2:] == pytest.approx([-2.0 + 1.1, -14.4], abs=5e-3)


# Homes that are the present position


@pytest.mark.parametrize(("lag", "early"), [(0.02, False), (0.05, False), (0.05, True)])
def test_a_home_at_the_present_position_is_where_the_servo_rests(lag, early):
    """Readings that are too close together do not show that it rests."""
    bench, motor = bench_of(home_mm=3.0)
    motor.lag, motor.commanded, motor.target = lag, 15.0, 15.0  # counts: the servo follows by 0.03 mm
    bench.home("guide_y")
    if early:
        bench.clock.wait(0.002)
        bench.core.tick()
        assert bench.calls("define") == []
    assert_found(bench, 3.0, 2.5e-3)


def test_an_axis_that_never_rests_has_no_home_at_its_position():
    bench, motor = bench_of(home_mm=3.0)
    motor.lag = 1e6
    bench.home("guide_y")
    for tick in range(40):  # 4 counts forwards and backwards, 0.008 mm
        motor.position = 4.0 * ((tick + 1) % 2)
        bench.tick()
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.FAULT, "guide_y: has not come to rest")
    assert bench.calls("define") == []


# Searches from the switch and from far away


@pytest.mark.parametrize("creeps", [False, True])
def test_from_its_switch_an_axis_moves_away_before_it_searches_it(creeps):
    """Also an axis whose servo does not quite rest there at the start."""
    bench, motor = guide()
    if creeps:
        motor.position -= 5.0
        bench.tick()
    bench.home("guide_y")
    assert_found(bench, HOME_MM - BACK_OFF_MM, 2e-3)
    assert motor.low == pytest.approx(-500.0 * HOME_MM, abs=1e-6)
    at = [report.axes["guide_y"].position for report in bench.reports[:-20]]
    left = next(k for k, place in enumerate(at) if place < SWITCH_MM - BACK_OFF_MM + 0.015)
    assert min(at) == pytest.approx(SWITCH_MM - BACK_OFF_MM, abs=0.015)
    assert max(at[left:-1]) == pytest.approx(SWITCH_MM, abs=2e-3)
    assert at[left] < at[left + 20]  # towards the switch again
    assert len(bench.calls("define")) == 1


@pytest.mark.parametrize(("home", "start"), [(3.0, -1.9), (7.0, 7.0)])
def test_a_switch_far_beyond_a_short_range_is_found_from_anywhere(home, start):
    keys = {"home": "reverse-limit", "home_mm": home, "range_mm": [-2.0, 2.0]}
    bench = Bench(rig_file(guide_y=keys), tracked=False)
    motor = bench.place("C", -500.0 * start)
    motor.low = -500.0 * home
    bench.tick()
    bench.armed().home("guide_y")
    assert_found(bench, 2.0 - 0.08, 2e-3)
    assert motor.low == pytest.approx(-500.0 * home, abs=1e-6)


@pytest.mark.parametrize(("ticks", "leg"), [(5, 1), (40, 2), (62, 3)])
def test_a_search_that_is_stopped_sets_no_home_and_the_next_one_does(ticks, leg):
    """In each of its legs: off the switch, towards it, and off it again."""
    bench, motor = guide()
    bench.home("guide_y")
    bench.tick(ticks)
    assert len(bench.calls("set_speed")) == leg
    bench.stop("the keyboard")
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.STOPPED, "the keyboard")
    assert bench.calls("define") == []
    bench.reset()
    bench.armed().home("guide_y", 2)
    assert bench.until(2).why == ""
    assert motor.low == pytest.approx(-500.0 * HOME_MM, abs=1e-6)


# Searches that find no home


def stay_active(bench, motor):
    """Let the switch of the guide stay active once it is reached."""
    read = bench.stage.read

    def stuck():
        found = read()
        if motor.low == -math.inf or found["C"].reverse_limit:
            motor.low = -math.inf
            return found | {"C": replace(found["C"], reverse_limit=True)}
        return found

    bench.stage.read = stuck


def lose_position(bench, _motor):
    """Let the position at the switch be no number."""
    read = bench.stage.read

    def reported():
        found = read()
        return found | {"C": replace(found["C"], position=math.nan)} if found["C"].reverse_limit else found

    bench.stage.read = reported


def change_motor(**values):
    return lambda _, motor: vars(motor).update(values)


@pytest.mark.parametrize(
    ("at", "change", "state", "why"),
    [
        (SWITCH_MM, stay_active, SupervisorState.IDLE, "guide_y: the reverse-limit switch is still active"),
        (7.0, stay_active, SupervisorState.IDLE, "guide_y: the reverse-limit switch is still active 0.600"),
        (7.0, lose_position, SupervisorState.FAULT, "guide_y: the motor controller reports position nan"),
        (7.0, change_motor(coasts=1e3), SupervisorState.FAULT, "guide_y: "),
        (7.0, change_motor(fault="stall"), SupervisorState.FAULT, "the motors have not"),
    ],
)
def test_a_search_that_fails_sets_no_home(at, change, state, why):
    bench, motor = guide(at)
    change(bench, motor)
    bench.home("guide_y")
    done = bench.until(1)
    assert done.state is state
    assert done.why.startswith(why)
    assert bench.calls("define") == []
    if state is SupervisorState.IDLE:
        assert bench.position("guide_y") == pytest.approx(SWITCH_MM - BACK_OFF_MM, abs=0.01)


def test_without_a_switch_the_axis_has_no_home():
    bench, _ = bench_of(home="reverse-limit", home_mm=2.0, range_mm=[-2.0, 2.0])
    bench.home("guide_y")
    assert bench.until(1).why == "guide_y: no limit switch within its range"
    assert bench.calls("define") == []


def test_a_home_that_cannot_be_defined_is_a_fault():
    bench = Bench().armed()
    bench.stage.define = lambda *_: bench.stage._called("define") or setattr(bench.stage, "lost", True)
    bench.home("rotation")
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert done.why.startswith("no stop could be sent: nothing had a target ahead")
    assert done.why.endswith("cause: no reply within 100 ms")


@pytest.mark.parametrize(
    ("keys", "high", "why"),
    [
        ({"home": "reverse-limit", "home_mm": 15.0}, 0.0, "guide_y: both limit switches are active"),
        ({"home": "absolute"}, math.inf, "guide_y: its absolute encoder needs no homing"),
    ],
)
def test_a_search_with_both_switches_active_or_an_absolute_encoder_is_refused(keys, high, why):
    bench = Bench(rig_file(guide_y=keys), tracked=False)
    bench.stage.motors["C"].low, bench.stage.motors["C"].high = 0.0, high
    bench.tick()
    bench.armed().home("guide_y")
    assert bench.refusal.startswith(why)
    assert bench.state is SupervisorState.ARMED


@pytest.mark.parametrize("refused", ["set_speed", "follow"])
@pytest.mark.parametrize("leg", [0, 1])
def test_a_refused_command_in_a_search_is_a_fault(monkeypatch, refused, leg):
    """At the start, before a target was sent, and when the axis backs off from the switch."""
    bench, motor = bench_of(home="reverse-limit", home_mm=15.0)
    motor.low = -500.0

    def called(*call):
        Stage._called(bench.stage, *call)
        if call[0] == refused and (leg == 0 or motor.stopped == "limit switch"):
            raise DriverError("SPC=100: ? 6 Number out of range")

    monkeypatch.setattr(bench.stage, "_called", called)
    bench.home("guide_y")
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.FAULT, "SPC=100: ? 6 Number out of range")
    assert bench.calls("define") == []
    assert bench.calls("stop")
