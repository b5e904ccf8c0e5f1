"""Finding the home of an axis: at a switch, on either side, in either direction of the motor; or where it is."""

import math
from dataclasses import replace

import pytest

from flexneedle.errors import DriverError
from flexneedle.lab.rig.preflight.moves import plan_homings
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from stages import TICK_S, Bench, Stage, rig_file


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("home", ["reverse-limit", "forward-limit"])
def test_an_axis_finds_its_switch_calls_it_its_home_and_moves_into_its_range(home, direction):
    to_home = direction * (1 if home == "forward-limit" else -1)
    keys = {"home": home, "home_mm": 15.5 * to_home, "direction": direction}
    bench = Bench(rig_file(guide_y=keys)).armed()
    motor = bench.stage.motors["C"]
    motor.low, motor.high = -9000.0, 7000.0  # counts, 500 a mm
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.core.state is SupervisorState.HOMING
    done = bench.until(1, most=20_000)
    assert (done.why, done.state) == ("", SupervisorState.IDLE)
    switch = motor.low if home == "reverse-limit" else motor.high
    assert switch == pytest.approx(direction * 500.0 * 15.5 * to_home, abs=1e-6)
    assert bench.position("guide_y") == pytest.approx((15.0 - 0.6) * to_home, abs=2e-3)
    bench.armed()
    bench.core.request(protocol.MoveCommand(2, "guide_y", 0.0, 5.0))
    assert bench.until(2).why == ""


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("seconds", [0.005, 0.03, 0.1])
def test_an_axis_that_slows_down_at_its_switch_is_called_home_where_it_rests(seconds, phase):
    """The motor controller reports the stop some ticks before the axis rests, and refuses targets meanwhile."""
    speed = 1.0
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.high = seconds, 500.0 * (2.0 + speed * TICK_S * phase)
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert (done.why, done.state) == ("", SupervisorState.IDLE)
    (defined,) = [call for call in bench.stage.calls if call[0] == "define"]
    assert defined == ("define", "C", pytest.approx(500.0 * 14.4, abs=1.0))
    assert 500.0 * 15.5 - motor.high == pytest.approx(500.0 * speed * seconds / 2.0, abs=2.0)


@pytest.mark.parametrize("lag", [0.01, 0.02, 0.03])
def test_a_home_is_where_the_servo_rests_not_where_its_profile_has_ended(lag):
    """The motor controller counts the axis as at rest while its servo still follows."""
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5, "speed_mm_s": 40.0})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.lag, motor.high = 0.01, lag, 1000.0
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert (done.why, done.state) == ("", SupervisorState.IDLE)
    bench.tick(20)
    assert bench.position("guide_y") == pytest.approx(-14.4, abs=0.02)


@pytest.mark.parametrize("late", [0.8, 0.99])
def test_ticks_one_right_after_the_other_do_not_show_that_a_servo_rests(late):
    """Every other tick is late, by this share of its time, so that a servo has hardly moved at the next."""
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5, "speed_mm_s": 40.0})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.lag, motor.high = 0.01, 0.02, 1000.0
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    for _ in range(10_000):
        if bench.core.state is not SupervisorState.HOMING:
            break
        bench.clock.wait(late * TICK_S)
        bench.tick()
        bench.clock.wait(-late * TICK_S)
        bench.tick()
    assert bench.sent[-1].why == ""
    bench.tick(20)
    assert bench.position("guide_y") == pytest.approx(-14.4, abs=0.02)


def test_a_home_is_set_once_the_servo_rests_off_the_switch(monkeypatch):
    """It follows on between the reading from which the position is shifted and the shift, which may take a while."""
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5, "speed_mm_s": 40.0})).armed()
    motor, define = bench.stage.motors["C"], bench.stage.define
    motor.lag, motor.high = 0.02, 1000.0

    def late(*arguments):
        bench.clock.wait(0.1)
        bench.stage.read()
        define(*arguments)

    monkeypatch.setattr(bench.stage, "define", late)
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.until(1, most=20_000).why == ""
    bench.tick(20)
    assert bench.position("guide_y") == pytest.approx(-14.4, abs=2e-3)


def test_an_axis_that_never_rests_at_its_switch_is_a_fault():
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.high = 1e3, 1000.0
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.state is SupervisorState.FAULT
    assert motor.position < 1000.0 + 500.0 * 33.0


def test_a_search_moves_as_it_is_announced():
    rig = rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})
    (announced,) = plan_homings(rig, ["guide_y"])
    assert str(announced) == (
        "guide_y: in its negative direction to the forward limit switch, by at most 33.5 mm at 1 mm/s; the position "
        "there is called -15.5 mm; then in its positive direction by 1.1 mm at 1 mm/s, off the switch to -14.4 mm. "
        "If the switch is active now, first in its positive direction by 1.1 mm at 1 mm/s"
    )
    bench = Bench(rig).armed()
    bench.stage.motors["C"].high = 7000.0  # counts, 500 a mm
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.until(1, most=20_000).why == ""
    assert [call[2] for call in bench.stage.calls if call[0] == "set_speed"] == pytest.approx([500.0, 500.0])
    at = [report.axes["guide_y"].position for report in bench.reports]
    assert min(at[:-1]) == pytest.approx(-14.0, abs=0.1)
    assert at[-2:] == pytest.approx([-14.0 + 1.1, -14.4], abs=5e-3)


def test_an_axis_is_at_home_where_it_is():
    bench = Bench(rig_file(rotation={"home_deg": 90.0})).armed()
    bench.core.request(protocol.HomeCommand(1, "rotation"))
    assert bench.until(1).why == ""
    assert bench.position("rotation") == pytest.approx(math.pi / 2)


def called_home_while_following(lag):
    """A bench that was asked to take a guide's position as 3 mm while its servo still follows on by 0.03 mm."""
    bench = Bench(rig_file(guide_y={"home_mm": 3.0})).armed()
    motor = bench.stage.motors["C"]
    motor.lag, motor.commanded, motor.target = lag, 15.0, 15.0  # counts, 500 a mm
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    return bench


def assert_home_is_where_it_rests(bench):
    assert bench.until(1).why == ""
    bench.tick(40)
    assert bench.position("guide_y") == pytest.approx(3.0, abs=2.5e-3)


@pytest.mark.parametrize("lag", [0.02, 0.05])
def test_a_home_that_is_here_is_where_the_servo_rests(lag):
    assert_home_is_where_it_rests(called_home_while_following(lag))


def test_the_first_readings_are_too_close_together_to_show_that_a_servo_rests():
    bench = called_home_while_following(0.05)
    bench.clock.wait(0.002)
    bench.core.tick()
    assert not [call for call in bench.stage.calls if call[0] == "define"]
    assert_home_is_where_it_rests(bench)


def test_an_axis_that_never_rests_is_not_at_home_where_it_is():
    bench = Bench(rig_file(guide_y={"home_mm": 3.0})).armed()
    motor = bench.stage.motors["C"]
    motor.lag = 1e6
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    for tick in range(40):  # 4 counts to and fro, 0.008 mm
        motor.position = 4.0 * ((tick + 1) % 2)
        bench.tick()
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.FAULT, "guide_y: does not rest")
    assert not [call for call in bench.stage.calls if call[0] == "define"]


def test_without_a_switch_the_axis_has_no_home():
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": 15.0})).armed()
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.why == "guide_y: no limit switch within its range"
    assert not [call for call in bench.stage.calls if call[0] == "define"]


SWITCH_MM, HOME_MM, BACK_OFF_MM = 8.0, 15.0, 0.6
"""Where the guide counts its switch, what that is called, and how far it moves away from it."""


def guide(at=SWITCH_MM, **ends):
    """A bench whose guide rests somewhere (mm), and its motor; ends: where its limit switches are (counts)."""
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": HOME_MM}), tracked=False)
    motor = bench.stage.motors["C"]
    motor.position = motor.commanded = motor.target = -500.0 * at
    motor.low = -500.0 * SWITCH_MM
    vars(motor).update(ends)
    bench.tick()
    return bench.armed(), motor


@pytest.mark.parametrize("creeps", [False, True])
def test_from_its_switch_an_axis_moves_away_before_it_searches_it(creeps):
    """Also one whose servo does not quite rest there as the search begins."""
    bench, motor = guide()
    if creeps:
        motor.position -= 5.0
        bench.tick()
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.until(1).why == ""
    assert bench.position("guide_y") == pytest.approx(HOME_MM - BACK_OFF_MM, abs=2e-3)
    assert motor.low == pytest.approx(-500.0 * HOME_MM, abs=1e-6)
    at = [report.axes["guide_y"].position for report in bench.reports]
    left = next(k for k, place in enumerate(at) if place < SWITCH_MM - BACK_OFF_MM + 0.015)
    assert min(at) == pytest.approx(SWITCH_MM - BACK_OFF_MM, abs=0.015)
    assert max(at[left:-1]) == pytest.approx(SWITCH_MM, abs=2e-3)
    assert at[left] < at[left + 20]  # towards the switch again
    assert [call[0] for call in bench.stage.calls].count("define") == 1


@pytest.mark.parametrize("at", [SWITCH_MM, 0.0])
def test_a_switch_that_stays_active_is_no_home(at):
    """At the start of the search, or once it was found: the axis counts as before."""
    bench, motor = guide(at)
    read = bench.stage.read

    def stuck():
        found = read()
        if motor.low == -math.inf or found["C"].reverse_limit:
            motor.low = -math.inf
            return found | {"C": replace(found["C"], reverse_limit=True)}
        return found

    bench.stage.read = stuck
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.why == (
        "guide_y: the reverse-limit switch is still active 0.600 mm away from it: it is stuck, or needs more room: "
        "a home further beyond the range"
    )
    assert done.state is SupervisorState.IDLE
    assert "define" not in [call[0] for call in bench.stage.calls]
    assert bench.position("guide_y") == pytest.approx(SWITCH_MM - BACK_OFF_MM, abs=0.01)


@pytest.mark.parametrize(("ticks", "leg"), [(5, 1), (40, 2), (62, 3)])
def test_a_search_that_is_stopped_sets_no_home_and_the_next_one_does(ticks, leg):
    """In each of its legs: off the switch, towards it, and off it again."""
    bench, motor = guide()
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    bench.tick(ticks)
    assert [call[0] for call in bench.stage.calls].count("set_speed") == leg
    bench.core.request(protocol.StopCommand("the keyboard"))
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.STOPPED, "the keyboard")
    assert "define" not in [call[0] for call in bench.stage.calls]
    bench.core.request(protocol.ResetCommand())
    bench.armed().core.request(protocol.HomeCommand(2, "guide_y"))
    assert bench.until(2, most=20_000).why == ""
    assert motor.low == pytest.approx(-500.0 * HOME_MM, abs=1e-6)


def test_a_position_that_is_no_number_at_the_switch_is_no_home():
    bench, _ = guide(at=0.0)
    read = bench.stage.read

    def reported():
        found = read()
        at_switch = found["C"].reverse_limit
        return found | {"C": replace(found["C"], position=math.nan)} if at_switch else found

    bench.stage.read = reported
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.state is SupervisorState.FAULT
    assert done.why.startswith("guide_y: the motor controller reports position nan")
    assert "define" not in [call[0] for call in bench.stage.calls]


@pytest.mark.parametrize(("home", "start"), [(3.0, -1.9), (7.0, -1.9), (7.0, 7.0), (7.0, 2.0)])
def test_a_switch_far_beyond_a_short_range_is_found_from_anywhere(home, start):
    keys = {"home": "reverse-limit", "home_mm": home, "range_mm": [-2.0, 2.0]}
    bench = Bench(rig_file(guide_y=keys), tracked=False)
    motor = bench.stage.motors["C"]
    motor.position = motor.commanded = motor.target = -500.0 * start
    motor.low = -500.0 * home
    bench.tick()
    bench.armed().core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.until(1, most=20_000).why == ""
    assert bench.position("guide_y") == pytest.approx(2.0 - 0.08, abs=2e-3)
    assert motor.low == pytest.approx(-500.0 * home, abs=1e-6)


def test_with_both_switches_active_nothing_is_searched():
    bench, _ = guide(high=-500.0 * SWITCH_MM)
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.sent[-1].why == "guide_y: both limit switches are active: check their wiring and polarity"
    assert bench.core.state is SupervisorState.ARMED


def test_an_absolute_encoder_is_not_homed():
    bench = Bench(rig_file(guide_y={"home": "absolute"})).armed()
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    assert bench.sent[0].why == "guide_y: has an absolute encoder, and no home to search"


def test_a_stall_while_homing_is_a_fault():
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": 15.0})).armed()
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    bench.tick(5)
    bench.stage.motors["C"].fault = "stall"
    begun = bench.clock.now()
    done = bench.until(1)
    assert done.state is SupervisorState.FAULT
    assert done.why.startswith("the motors have not arrived: guide_y 32.8")
    assert bench.clock.now() - begun < 0.4


@pytest.mark.parametrize("refused", ["set_speed", "follow"])
@pytest.mark.parametrize("leg", [0, 1])
def test_what_is_refused_in_a_search_is_a_fault(monkeypatch, refused, leg):
    """At its beginning, before a target was sent, and when it backs off from the switch."""
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": 15.0})).armed()
    motor = bench.stage.motors["C"]
    motor.low = -1000.0

    def called(*call):
        Stage._called(bench.stage, *call)
        if call[0] == refused and (leg == 0 or motor.stopped == "limit switch"):
            raise DriverError("SPC=100: ? 6 Number out of range")

    monkeypatch.setattr(bench.stage, "_called", called)
    bench.core.request(protocol.HomeCommand(1, "guide_y"))
    done = bench.until(1)
    assert (done.state, done.why) == (SupervisorState.FAULT, "SPC=100: ? 6 Number out of range")
    assert "define" not in [call[0] for call in bench.stage.calls]
    assert ("stop",) in bench.stage.calls
