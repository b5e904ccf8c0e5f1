"""Finding the home of an axis: at a switch, on either side, in either direction of the motor; or where it is."""

import math

import pytest

from flexneedle.errors import DriverError
from flexneedle.rig.moves import homings
from flexneedle.rig.supervisor import messages as say
from flexneedle.rig.supervisor.machine import State
from stages import TICK_S, Bench, Stage, rig_file


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("home", ["reverse-limit", "forward-limit"])
def test_an_axis_finds_its_switch_calls_it_its_home_and_moves_into_its_range(home, direction):
    to_home = direction * (1 if home == "forward-limit" else -1)
    keys = {"home": home, "home_mm": 15.5 * to_home, "direction": direction}
    bench = Bench(rig_file(guide_y=keys)).armed()
    motor = bench.stage.motors["C"]
    motor.low, motor.high = -9000.0, 7000.0  # counts, 500 a mm
    bench.core.request(say.Home(1, "guide_y"))
    assert bench.core.state is State.HOMING
    done = bench.until(1, most=20_000)
    assert (done.why, done.state) == ("", State.IDLE)
    assert ("define", "C", direction * 500.0 * 15.5 * to_home) in bench.stage.calls
    switch = motor.low if home == "reverse-limit" else motor.high
    assert switch == direction * 500.0 * 15.5 * to_home
    assert bench.position("guide_y") == pytest.approx((15.0 - 0.6) * to_home, abs=2e-3)
    bench.armed()
    bench.core.request(say.Go(2, "guide_y", 0.0, 5.0))
    assert bench.until(2).why == ""


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("seconds", [0.005, 0.03, 0.1])
def test_an_axis_that_slows_down_at_its_switch_is_called_home_where_it_rests(seconds, phase):
    """The motor controller reports the stop some ticks before the axis rests, and refuses targets meanwhile."""
    speed = 1.0
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.high = seconds, 500.0 * (2.0 + speed * TICK_S * phase)
    bench.core.request(say.Home(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert (done.why, done.state) == ("", State.IDLE)
    (defined,) = [call for call in bench.stage.calls if call[0] == "define"]
    assert defined == ("define", "C", 500.0 * 15.5)
    assert 500.0 * 15.5 - motor.high == pytest.approx(500.0 * speed * seconds / 2.0, abs=2.0)


def test_an_axis_that_never_rests_at_its_switch_is_a_fault():
    bench = Bench(rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})).armed()
    motor = bench.stage.motors["C"]
    motor.coasts, motor.high = 1e3, 1000.0
    bench.core.request(say.Home(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.state is State.FAULT
    assert motor.position < 1000.0 + 500.0 * 33.0


def test_a_search_moves_as_it_is_announced():
    rig = rig_file(guide_y={"home": "forward-limit", "home_mm": -15.5})
    (announced,) = homings(rig, ["guide_y"])
    assert str(announced) == (
        "guide_y: in its negative direction to the forward limit switch, by at most 33 mm at 1 mm/s; the position "
        "there is called -15.5 mm; then in its positive direction by 1.1 mm at 1 mm/s, off the switch to -14.4 mm"
    )
    bench = Bench(rig).armed()
    bench.stage.motors["C"].high = 7000.0  # counts, 500 a mm
    bench.core.request(say.Home(1, "guide_y"))
    assert bench.until(1, most=20_000).why == ""
    assert [call[2] for call in bench.stage.calls if call[0] == "set_speed"] == pytest.approx([500.0, 500.0])
    at = [report.axes["guide_y"].position for report in bench.reports]
    assert min(at) == pytest.approx(-15.5, abs=0.1)
    assert at[-1] == pytest.approx(-14.4, abs=2e-3)


def test_an_axis_is_at_home_where_it_is():
    bench = Bench(rig_file(rotation={"home_deg": 90.0})).armed()
    bench.core.request(say.Home(1, "rotation"))
    assert bench.until(1).why == ""
    assert bench.position("rotation") == pytest.approx(math.pi / 2)


def test_without_a_switch_the_axis_has_no_home():
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": 15.0})).armed()
    bench.core.request(say.Home(1, "guide_y"))
    done = bench.until(1, most=20_000)
    assert done.why == "guide_y: no limit switch within its range"
    assert not [call for call in bench.stage.calls if call[0] == "define"]


def test_an_absolute_encoder_is_not_homed():
    bench = Bench(rig_file(guide_y={"home": "absolute"})).armed()
    bench.core.request(say.Home(1, "guide_y"))
    assert bench.sent[0].why == "guide_y: has an absolute encoder, and no home to search"


def test_a_stall_while_homing_is_a_fault():
    bench = Bench(rig_file(guide_y={"home": "reverse-limit", "home_mm": 15.0})).armed()
    bench.core.request(say.Home(1, "guide_y"))
    bench.tick(5)
    bench.stage.motors["C"].fault = "stall"
    begun = bench.clock.now()
    done = bench.until(1)
    assert done.state is State.FAULT
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
        if call[0] == refused and (leg == 0 or ("define", "C", -7500.0) in bench.stage.calls):
            raise DriverError("SPC=100: ? 6 Number out of range")

    monkeypatch.setattr(bench.stage, "_called", called)
    bench.core.request(say.Home(1, "guide_y"))
    done = bench.until(1)
    assert (done.state, done.why) == (State.FAULT, "SPC=100: ? 6 Number out of range")
    assert ("stop",) in bench.stage.calls
