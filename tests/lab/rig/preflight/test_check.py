"""`rig check` compares each device with the file, and moves, powers and changes nothing."""

import math
from contextlib import closing

import pytest

import bench_rig
from bench_rig import Clock, Motors, Tracker, rig
from flexneedle.errors import RunError
from flexneedle.lab.emulators.galil.controller import reply
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.preflight.check import (
    Finding,
    IntendedInsertion,
    check_motors,
    check_rig,
    check_tracker,
)
from flexneedle.scenario.files import load_scenario
from flexneedle.types import VISIBLE, Frame, SensorReading
from galil_peer import peer

PLANE = IntendedInsertion(load_scenario("phantom").with_values({"monitor.references": 0}))
FAR_OFF = "must be at most max_error_mm (0.2): free the axis; the next motion begins where it then is"
KINDS = {"driver__kind": "bench_rig:drivers", "tracker__kind": "bench_rig:trackers"}


def problems(findings):
    return {(one.part, one.item): one.problem for one in findings if one.problem}


def of(findings, part, item):
    (found,) = [one for one in findings if (one.part, one.item) == (part, item)]
    return found


def motors_with(channel="A", **state):
    device = Motors()
    device.set(channel, **state)
    return device


def test_a_rig_as_its_file_describes_it_has_no_problem(monkeypatch):
    made = {}
    monkeypatch.setattr(
        bench_rig, "drivers", lambda _settings, channels: made.setdefault("motors", Motors(channels))
    )
    monkeypatch.setattr(
        bench_rig, "trackers", lambda _settings, clock: made.setdefault("tracker", Tracker(clock))
    )
    findings = check_rig(rig(**KINDS), Clock(), 2.0, PLANE)
    assert problems(findings) == {}
    assert made["motors"].calls == [], "nothing was moved, powered or defined"
    assert (made["motors"].closed, made["tracker"].closed) == (True, True)
    assert of(findings, "driver", "connection").found == "bench_rig:drivers"
    assert of(findings, "insertion", "queued motion").found == "0.5 mm (loop.queue_mm)"
    assert of(findings, "scenario", "fit").found == "Two-layer tissue phantom"


def test_positions_are_in_the_unit_of_the_axis_and_in_counts():
    device = motors_with("A", position=12345.0, commanded=12345.0)
    device.set("B", position=9000.0, commanded=9000.0)
    device.set("C", position=-1500.0, commanded=-1500.0)
    findings = check_motors(rig(), device, Clock())
    shown = {name: of(findings, name, "position").found for name in ("insertion", "rotation", "guide_y")}
    assert shown == {
        "insertion": "12.345 mm (12345 counts)",
        "rotation": "90 deg (9000 counts)",
        "guide_y": "3 mm (-1500 counts)",  # its motor turns the other way
    }


@pytest.mark.parametrize(
    ("backlash", "counts", "fits"), [(0.0, -25.0, False), (0.05, -25.0, True), (0.05, -50.0, False)]
)
def test_a_position_may_seem_beyond_the_limits_by_half_the_backlash(backlash, counts, fits):
    found = problems(
        check_motors(rig(axes__insertion__backlash_mm=backlash), motors_with("A", position=counts), Clock())
    )
    assert (("insertion", "position") not in found) == fits


@pytest.mark.parametrize(
    ("state", "item", "problem"),
    [
        ({"position": 120_021.0}, "position", "beyond the soft limits, 0 to 120 mm"),
        ({"position": -21.0}, "position", "beyond the soft limits, 0 to 120 mm"),
        ({"position": float("nan")}, "position", "is not a number"),
        ({"moving": True}, "motor", "moves, though this command does not move it"),
        ({"stopped": "the motor is off: position error"}, "motor", "the motor is off: position error"),
        ({"forward_limit": True}, "limit switches", "the forward limit switch is active at 0.000 mm"),
        (
            {"forward_limit": True, "reverse_limit": True},
            "limit switches",
            "both limit switches are active: check their wiring and polarity",
        ),
        ({"commanded": 201.0}, "commanded - measured", FAR_OFF),
        ({"commanded": float("nan")}, "commanded - measured", FAR_OFF),
    ],
    ids=str,
)
def test_what_a_motor_should_not_be_is_a_problem(state, item, problem):
    found = problems(check_motors(rig(), motors_with("A", **state), Clock()))
    assert found[("insertion", item)] == problem
    assert set(found) <= {("insertion", item), ("insertion", "commanded - measured")}


@pytest.mark.parametrize(
    "state",
    [
        {"position": 120_020.0, "commanded": 120_020.0},  # within the tolerance
        {"reverse_limit": True},  # the switch of its home
        {"on": False, "commanded": 5000.0},  # nothing is commanded of a motor that is off
        {"commanded": 199.0},
    ],
    ids=str,
)
def test_what_a_motor_may_be_is_none(state):
    assert problems(check_motors(rig(), motors_with("A", **state), Clock())) == {}


def test_the_limits_of_a_motor_that_turns_the_other_way_are_those_of_its_axis():
    found = rig(axes__guide_y__range_mm=[-5, 15])
    inside, outside = (
        {"position": counts, "commanded": counts} for counts in (-7000.0, 7000.0)
    )  # 14 and -14 mm
    assert problems(check_motors(found, motors_with("C", **inside), Clock())) == {}
    assert problems(check_motors(found, motors_with("C", **outside), Clock())) == {
        ("guide_y", "position"): "beyond the soft limits, -5 to 15 mm"
    }


def test_a_motor_that_is_off_is_found_off():
    findings = check_motors(rig(), motors_with("B", on=False), Clock())
    assert [of(findings, name, "motor").found for name in ("insertion", "rotation")] == ["A, on", "B, off"]


def test_a_channel_that_the_driver_lacks_is_a_problem():
    found = problems(check_motors(rig(), Motors(("A", "C", "D")), Clock()))
    assert found == {("rotation", "motor"): "the driver has no channel B; it has A, C, D"}


def test_a_slow_controller_is_a_problem():
    class Slow(Motors):
        def read(self):
            clock.wait(0.03)
            return super().read()

    clock = Clock()
    found = problems(check_motors(rig(), Slow(), clock))
    assert found == {("driver", "reply"): "longer than a tick of the loop, 25 ms"}


def test_an_insertion_that_cannot_start_from_here_is_a_problem():
    for position, count in ((30_000.0, 0), (50_000.0, 1)):  # 40 mm deep need less than the stroke of 110 mm
        device = motors_with("A", position=position, commanded=position)
        found = problems(check_motors(rig(), device, Clock(), PLANE))
        assert len(found) == count
    assert found[("insertion", "room")] == (
        "at 50 mm, 70 mm to the high end of range_mm (120): the advance to guard.past_target_mm = 2 past the target "
        "is 73.5 mm"
    )


def test_a_position_that_is_uncertain_by_backlash_is_said_so():
    findings = check_motors(rig(axes__guide_y__backlash_mm=0.08), Motors(), Clock())
    assert of(findings, "guide_y", "position").found == (
        "0 mm (0 counts), uncertain by 0.04 mm (half of backlash_mm)"
    )


def test_a_rig_that_is_slower_than_its_scenario_is_said_so():
    slow = rig(**KINDS, axes__insertion__acceleration_mm_s2=5.0)
    findings = check_rig(slow, Clock(), 1.0, PLANE)
    assert of(findings, "insertion", "speed").found == (
        "2.11 of 10 mm/s: acceleration_mm_s2 = 5 brakes from no more within the queue"
    )
    assert of(findings, "guide_y", "speed").found == "5 mm/s"
    assert of(findings, "insertion", "largest step").found == "1 mm in 1.1 s, planned for 0.2 s"


@pytest.mark.parametrize("rate", [40.0, 20.0])
def test_the_rate_of_the_frames_is_measured(rate):
    clock = Clock()
    found = check_tracker(Tracker(clock, rate=rate), clock, 2.0)
    assert of(found, "tracker", "frames").found.startswith(f"{rate:.1f} Hz, ")
    assert problems(found) == {}


def test_another_rate_than_the_scenarios_is_a_problem():
    clock = Clock()
    found = problems(check_tracker(Tracker(clock, rate=20.0), clock, 2.0, PLANE))
    assert found == {("tracker", "frames"): "tracker.rate_hz of the scenario is 40"}


def test_a_tracker_without_frames_is_a_problem_with_its_status():
    clock = Clock()
    found = check_tracker(Tracker(clock, rate=0.0, status="no reply to INIT"), clock, 1.0)
    assert found == [Finding("tracker", "frames", "none in 1 s", "no frame: no reply to INIT")]


def test_a_single_frame_has_no_rate():
    clock = Clock()
    found = problems(check_tracker(Tracker(clock, rate=1.0), clock, 1.5))
    assert found == {("tracker", "frames"): "too few for a rate"}


def test_missed_frames_are_counted():
    clock = Clock()

    class Skipping(Tracker):
        def read(self):
            return tuple(frame for frame in super().read() if frame.number % 4)

    found = check_tracker(Skipping(clock), clock, 1.0)
    assert of(found, "tracker", "frames").found.endswith(" 29 frames, 9 missed")


def test_a_needle_without_a_sensor_is_a_problem():
    clock = Clock()
    found = check_tracker(Tracker(clock, sensors=("ref1", "ref2")), clock, 1.0)
    assert problems(found) == {("tracker", "sensor tip"): "the needle's sensor must have the name tip"}
    assert of(found, "tracker", "sensor ref1").found == "measured in 100% at 1.00, 2.00, 3.00 mm"


def test_a_sensor_that_is_seldom_measured_is_a_problem():
    clock = Clock()

    class Seldom(Tracker):
        def read(self):
            lost = SensorReading(None, status="out of volume")
            return tuple(
                Frame(frame.time, frame.number, {"tip": lost} if frame.number % 5 == 0 else frame.readings)
                for frame in super().read()
            )

    found = check_tracker(Seldom(clock), clock, 2.0)
    assert problems(found) == {("tracker", "sensor tip"): "measured in too few frames: out of volume"}


@pytest.mark.parametrize("lost", [1, 2])
def test_one_frame_without_a_position_is_no_problem_however_few_there_are(lost):
    clock = Clock()

    class Short(Tracker):
        def read(self):
            nothing = {"tip": SensorReading(None, status="missing")}
            return tuple(
                Frame(frame.time, frame.number, nothing if frame.number < lost else frame.readings)
                for frame in super().read()
            )

    found = check_tracker(Short(clock), clock, 0.2)
    assert of(found, "tracker", "frames").found.endswith(" 7 frames, 0 missed")
    assert bool(problems(found)) == (lost > 1)


@pytest.mark.parametrize("place", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0)])
def test_a_position_that_is_not_a_number_is_not_measured(place):
    clock = Clock()

    class Wrong(Tracker):
        def read(self):
            tip = SensorReading(place, status=VISIBLE)
            return tuple(Frame(frame.time, frame.number, {"tip": tip}) for frame in super().read())

    found = check_tracker(Wrong(clock), clock, 2.0)
    why = "measured in too few frames: its position is not a number"
    assert problems(found) == {("tracker", "sensor tip"): why}


def test_the_references_that_the_monitor_needs_are_counted():
    clock = Clock()
    needs = IntendedInsertion(load_scenario("phantom"))
    found = problems(check_tracker(Tracker(clock, sensors=("tip", "ref1")), clock, 1.0, needs))
    rule = "monitor.references of the scenario is 3: a sensor whose name begins with ref is one"
    assert found == {("tracker", "reference sensors"): rule}
    all_there = Tracker(Clock(), sensors=("tip", "ref1", "ref2", "ref3"))
    assert problems(check_tracker(all_there, all_there.clock, 1.0, needs)) == {}


def test_a_device_that_cannot_be_reached_does_not_hide_the_other(monkeypatch):
    def gone(_settings, _channels):
        raise RunError("192.168.1.2: no connection: timed out")

    monkeypatch.setattr(bench_rig, "drivers", gone)
    findings = check_rig(rig(**KINDS), Clock(), 1.0)
    assert problems(findings) == {("driver", "connection"): "192.168.1.2: no connection: timed out"}
    assert of(findings, "tracker", "sensor tip").problem == ""


def test_a_device_that_fails_later_is_a_problem_and_closed(monkeypatch):
    device = Motors(fails="A: no reply to TPA")
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: device)
    findings = check_rig(rig(**KINDS), Clock(), 1.0)
    assert problems(findings) == {("driver", "reading"): "A: no reply to TPA"}
    assert of(findings, "driver", "connection").problem == ""
    assert device.closed


def test_an_error_in_a_driver_of_your_own_is_a_problem(monkeypatch):
    def broken(_settings, _channels):
        raise ValueError("bad byte")

    monkeypatch.setattr(bench_rig, "drivers", broken)
    (line,) = problems(check_rig(rig(**KINDS), Clock(), 1.0)).values()
    assert line.startswith("driver bench_rig:drivers: ValueError: bad byte (test_check.py, line ")


def test_a_part_that_is_not_installed_is_a_problem():
    findings = check_rig(rig(tracker__kind="bench_rig:trackers"), Clock(), 1.0)
    (line,) = problems(findings).values()
    assert line.startswith('driver.kind = "bench": must be one of ')


def test_an_identity_is_shown(monkeypatch):
    device = Motors()
    device.identity = "DMC4143 Rev 1.3h"
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: device)
    findings = check_rig(rig(**KINDS), Clock(), 1.0)
    assert of(findings, "driver", "connection").found == "bench_rig:drivers, DMC4143 Rev 1.3h"


def set_up(commands):
    """The findings on an emulated Galil that was set up by these commands."""
    with peer() as device:
        device.device, _ = reply(device.device, commands)
        given = {"address": f"127.0.0.1:{device.port}", "reply_timeout_ms": 1000}
        with closing(factory(given, ("A", "B", "C"))) as connected:
            return check_motors(rig(), connected, Clock())


@pytest.mark.parametrize(
    ("commands", "axis", "item", "problem"),
    [
        (
            "LDA=1",
            "insertion",
            "switches in use",
            "forward disabled in the controller: it does not stop the motor",
        ),
        ("LDB=3", "rotation", "switches in use", "reverse and forward disabled in the controller"),
        ("FLA=119000", "insertion", "controller's limits", "narrower than range_mm, 0 to 120 mm"),
        ("FLC=5000", "guide_y", "controller's limits", "narrower than range_mm, -15 to 15 mm"),
        ("ERA=100;OEA=1", "insertion", "motor off on error", "below max_error_mm (0.2): it comes before"),
    ],
)
def test_what_is_set_up_in_the_controller_is_compared_with_the_file(commands, axis, item, problem):
    ((where, line),) = problems(set_up(commands)).items()
    assert where == (axis, item)
    assert line.startswith(problem)


def test_a_controller_that_leaves_the_axes_their_range_has_no_problem():
    findings = set_up("FLA=121000;BLA=-1000;ERA=400;OEA=1")
    assert problems(findings) == {}
    shown = {
        item: of(findings, "insertion", item).found for item in ("controller's limits", "motor off on error")
    }
    assert shown == {
        "controller's limits": "-1 to 121 mm, also while its home is searched",
        "motor off on error": "beyond 0.4 mm",
    }
    assert of(findings, "guide_y", "controller's limits").found == "none"
    assert of(findings, "guide_y", "motor off on error").found == "no"


def test_a_scenario_that_does_not_fit_is_a_line_for_each_problem(monkeypatch):
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: Motors(("A",)))
    small = rig(**KINDS, axes__guide_y=None, axes__rotation=None)
    found = [one.problem for one in check_rig(small, Clock(), 1.0, PLANE) if one.part == "scenario"]
    assert found == [
        "axes.guide_y: missing: the guide moves",
        "axes.rotation: missing: the needle is rolled (bevel flips)",
    ]
