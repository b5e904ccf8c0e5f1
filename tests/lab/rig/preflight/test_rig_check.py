"""`rig check`: each device is compared with the rig file; nothing is moved, powered or changed."""

import math
from contextlib import closing
from dataclasses import replace

import pytest

import bench_rig
from bench_rig import Motors, Tracker, rig
from flexneedle.errors import RunError
from flexneedle.lab.emulators.galil.controller import reply
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.preflight.rig_check import IntendedInsertion, check_motors, check_rig, check_tracker
from flexneedle.scenario.files import load_scenario
from flexneedle.types import SensorReading
from galil_peer import peer
from rooms import ManualClock

PLANE = IntendedInsertion(load_scenario("phantom").with_values({"monitor.references": 0}))
KINDS = {"driver__kind": "bench_rig:drivers", "tracker__kind": "bench_rig:trackers"}


def problems(findings):
    return {(one.part, one.item): one.problem for one in findings if one.problem}


def found_of(findings, part, item):
    (found,) = [one for one in findings if (one.part, one.item) == (part, item)]
    return found.found


def motors_with(channel="A", **state):
    device = Motors()
    device.set(channel, **state)
    return device


def test_a_rig_that_agrees_with_its_file_has_no_problem_and_is_closed(monkeypatch):
    motors = Motors()
    motors.identity = "DMC4143 Rev 1.3h"
    monkeypatch.setattr(bench_rig, "drivers", lambda *_: motors)
    findings = check_rig(rig(**KINDS), ManualClock(), 2.0, PLANE)
    assert problems(findings) == {}
    assert (motors.calls, motors.closed) == ([], True)
    assert found_of(findings, "driver", "connection") == "bench_rig:drivers, DMC4143 Rev 1.3h"
    assert found_of(findings, "insertion", "queued motion") == "0.5 mm (loop.queue_mm)"
    assert found_of(findings, "scenario", "fit") == "Two-layer tissue phantom"


def test_a_failed_device_does_not_hide_the_other(monkeypatch):
    def disconnected(*_):
        raise RunError("192.168.1.2: no connection: timed out")

    def broken(*_):
        raise ValueError("bad byte")

    failing = Motors(fails="A: no reply to TPA")
    for drivers, item, line in (
        (disconnected, "connection", "192.168.1.2: no connection: timed out"),
        (broken, "connection", "ValueError: bad byte (test_rig_check.py, line "),
        (lambda *_: failing, "reading", "A: no reply to TPA"),
    ):
        monkeypatch.setattr(bench_rig, "drivers", drivers)
        findings = check_rig(rig(**KINDS), ManualClock(), 1.0)
        ((where, problem),) = problems(findings).items()
        assert where == ("driver", item)
        assert problem.startswith(line)
        assert found_of(findings, "tracker", "sensor tip").startswith("measured in 100%")
    assert failing.closed


def test_a_scenario_that_does_not_fit_and_a_slow_rig_are_findings(monkeypatch):
    monkeypatch.setattr(bench_rig, "drivers", lambda *_: Motors(("A",)))
    slow = rig(**KINDS, axes__guide_y=None, axes__rotation=None, axes__insertion__acceleration_mm_s2=5.0)
    findings = check_rig(slow, ManualClock(), 1.0, PLANE)
    found = [one.problem.split(":")[0] for one in findings if one.part == "scenario"]
    assert found == ["axes.guide_y", "axes.rotation"]
    assert found_of(findings, "insertion", "speed").startswith("2.11 of 10 mm/s")
    assert found_of(findings, "insertion", "largest step") == "1 mm in 1.1 s, planned for 0.2 s"


# Motors


def test_positions_are_in_the_unit_of_the_axis_and_in_counts():
    device = motors_with("A", position=12345.0, commanded=12345.0)
    device.set("B", position=9000.0, on=False)
    device.set("C", position=-1500.0, commanded=-1500.0)
    findings = check_motors(rig(axes__guide_y__backlash_mm=0.08), device, ManualClock())
    assert {name: found_of(findings, name, "position") for name in ("insertion", "rotation", "guide_y")} == {
        "insertion": "12.345 mm (12345 counts)",
        "rotation": "90 deg (9000 counts)",
        # Its motor turns in the other direction.
        "guide_y": "3 mm (-1500 counts), uncertain by 0.04 mm (half of backlash_mm)",
    }
    assert [found_of(findings, name, "motor") for name in ("insertion", "rotation")] == ["A, on", "B, off"]


@pytest.mark.parametrize(
    ("changes", "state", "item", "problem"),
    [
        ({}, {"position": 120_021.0}, "position", "beyond the soft limits, 0 to 120 mm"),
        ({"axes__insertion__backlash_mm": 0.05}, {"position": -50.0}, "position", "beyond the soft limits"),
        ({}, {"position": math.nan}, "position", "is not a number"),
        ({}, {"moving": True}, "motor", "reported as moving, as also at rest"),
        ({}, {"stopped": "position error"}, "motor", "position error"),
        ({}, {"forward_limit": True}, "limit switches", "the forward limit switch is active at 0.000 mm"),
        ({}, {"forward_limit": True, "reverse_limit": True}, "limit switches", "both limit switches are"),
        ({}, {"commanded": 201.0}, "commanded - measured", "must be at most max_error_mm (0.2)"),
        ({}, {"position": 120_020.0, "commanded": 120_020.0}, "", ""),  # within the tolerance
        ({"axes__insertion__backlash_mm": 0.05}, {"position": -25.0}, "", ""),  # half of the backlash
        ({}, {"reverse_limit": True}, "", ""),  # the switch of its home
        ({}, {"on": False, "commanded": 5000.0}, "", ""),  # nothing is commanded of a motor that is off
        ({}, {"commanded": 199.0}, "", ""),
    ],
)
def test_a_motor_that_is_not_ready_is_a_problem(changes, state, item, problem):
    found = problems(check_motors(rig(**changes), motors_with("A", **state), ManualClock()))
    if item == "position":
        found.pop(("insertion", "commanded - measured"), None)
    assert set(found) == ({("insertion", item)} if item else set())
    assert all(line.startswith(problem) for line in found.values())


def test_a_reversed_motor_has_the_limits_of_its_axis():
    made = rig(axes__guide_y__range_mm=[-5, 15])
    for counts, expected in ((-7000.0, set()), (7000.0, {("guide_y", "position")})):  # 14 and −14 mm
        device = motors_with("C", position=counts, commanded=counts)
        assert set(problems(check_motors(made, device, ManualClock()))) == expected


def test_a_missing_channel_and_a_slow_controller_are_problems():
    class Slow(Motors):
        def read(self):
            clock.wait(0.03)
            return super().read()

    clock = ManualClock()
    assert problems(check_motors(rig(), Slow(("A", "C", "D")), clock)) == {
        ("rotation", "motor"): "the driver has no channel B; it has A, C, D",
        ("driver", "reply"): "longer than a tick of the loop, 25 ms",
    }


def test_an_insertion_that_cannot_start_from_here_is_a_problem():
    for position, expected in ((30_000.0, set()), (50_000.0, {("insertion", "room")})):
        device = motors_with("A", position=position, commanded=position)
        assert set(problems(check_motors(rig(), device, ManualClock(), PLANE))) == expected


@pytest.mark.parametrize(
    ("commands", "axis", "item", "problem"),
    [
        ("LDA=1", "insertion", "switches in use", "forward disabled in the controller"),
        ("LDB=3", "rotation", "switches in use", "reverse and forward disabled in the controller"),
        ("FLA=119000", "insertion", "controller's limits", "narrower than range_mm, 0 to 120 mm"),
        ("FLC=5000", "guide_y", "controller's limits", "narrower than range_mm, -15 to 15 mm"),
        ("ERA=100;OEA=1", "insertion", "motor off on error", "below max_error_mm (0.2): it would act before"),
        ("FLA=121000;BLA=-1000;ERA=400;OEA=1", "insertion", "", ""),
    ],
)
def test_the_settings_of_a_controller_are_compared_with_the_file(commands, axis, item, problem):
    with peer() as device:
        device.device, _ = reply(device.device, commands)
        given = {"address": f"127.0.0.1:{device.port}", "reply_timeout_ms": 1000}
        with closing(factory(given, ("A", "B", "C"))) as connected:
            findings = check_motors(rig(), connected, ManualClock())
    found = problems(findings)
    assert set(found) == ({(axis, item)} if item else set())
    assert all(line.startswith(problem) for line in found.values())
    if not item:
        limits = found_of(findings, axis, "controller's limits")
        assert limits == "-1 to 121 mm, also while its home is searched"
        assert found_of(findings, axis, "motor off on error") == "beyond 0.4 mm"
        assert found_of(findings, "guide_y", "controller's limits") == "none"


def test_an_axis_off_its_start_is_a_problem_whether_or_not_the_scenario_moves_it():
    made = rig(axes__guide_z={**bench_rig.VALUES["axes"]["guide_y"], "channel": "D"})
    device = Motors(("A", "B", "C", "D"))
    device.set("B", position=3000.0, commanded=3000.0)
    device.set("D", position=-750.0, commanded=-750.0)
    findings = check_motors(made, device, ManualClock(), PLANE)
    assert problems(findings) == {
        (
            "guide_z",
            "start",
        ): "must be within 0.02 mm of 0, on the needle's axis: flexneedle rig ready RIG --scenario SCENARIO"
    }
    assert found_of(findings, "rotation", "start").startswith("at 30 deg, rolled to the plan's angle")
    assert ("guide_z", "start") not in problems(check_motors(made, device, ManualClock()))


# Tracker


LOST, INFINITE = SensorReading(None, status="out of volume"), SensorReading((0.0, math.inf, 0.0))


class ChangedTracker(Tracker):
    """A tracker whose frames are changed: None leaves a frame out."""

    def __init__(self, change, **options):
        super().__init__(ManualClock(), **options)
        self._change = change

    def read(self):
        return tuple(filter(None, map(self._change, super().read())))


def reading(where, tip):
    """Return a change of the tip's reading in frames with such a number."""
    return lambda frame: replace(frame, readings={"tip": tip}) if where(frame.number) else frame


@pytest.mark.parametrize(
    ("device", "seconds", "problem"),
    [
        (Tracker(ManualClock()), 2.0, ""),
        (Tracker(ManualClock(), rate=20.0), 2.0, "frames: tracker.rate_hz of the scenario is 40"),
        (Tracker(ManualClock(), rate=0.0, status="no reply"), 1.0, "frames: no frame: no reply"),
        (Tracker(ManualClock(), status="no reply"), 2.0, "status: must be ok"),
        (
            Tracker(ManualClock(), sensors=("ref1",)),
            1.0,
            "sensor tip: the needle's sensor must have the name tip",
        ),
        (ChangedTracker(reading(lambda number: number % 5 == 0, LOST)), 2.0, "sensor tip: measured in"),
        (ChangedTracker(reading(lambda number: number < 1, LOST)), 0.2, ""),  # one frame is allowed
        (ChangedTracker(reading(lambda number: number < 2, LOST)), 0.2, "sensor tip: measured in too few"),
        (ChangedTracker(reading(lambda _: True, INFINITE)), 2.0, "sensor tip: measured in too few"),
    ],
)
def test_a_tracker_that_is_not_ready_is_a_problem(device, seconds, problem):
    found = problems(check_tracker(rig(), device, device.clock, seconds, PLANE))
    (line,) = [f"{item}: {line}" for (_, item), line in found.items()] or [""]
    assert line.startswith(problem)
    assert bool(line) == bool(problem)


@pytest.mark.parametrize(
    ("place", "turn", "changes", "problem"),
    [
        ((-28.5, 0.0, 1.7), None, {}, "z must be within 0.6 mm of 0.0"),
        ((-28.5, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5), {}, ""),  # its z axis is x
        (
            (-28.5, 0.0, 0.0),
            (1.0, 0.0, 0.0, 0.0),
            {},
            "dz/dx = 1571 mrad: must be within 30",
        ),
        ((-28.5, 0.0, 0.0), None, {"tracker.tip_offset_mm": 2.0}, "tracker.tip_offset_mm is 2: the sensor"),
    ],
)
def test_a_tip_that_is_not_at_the_start_of_the_scenario_is_a_problem(place, turn, changes, problem):
    device = ChangedTracker(reading(lambda _: True, SensorReading(place, turn)))
    wanted = replace(PLANE, scenario=PLANE.scenario.with_values(changes))
    found = problems(check_tracker(rig(), device, device.clock, 1.0, wanted))
    assert found.get(("tip", "start"), "").startswith(problem)
    assert set(found) <= {("tip", "start")}
    assert bool(found) == bool(problem)


def test_the_rate_missed_frames_and_positions_are_measured():
    device = ChangedTracker(lambda frame: frame if frame.number % 4 else None)
    findings = check_tracker(rig(), device, device.clock, 1.0)
    rate, frames = found_of(findings, "tracker", "frames").split(" Hz, ")
    assert float(rate) == pytest.approx(0.75 * 40.0, rel=0.05)
    assert frames == "29 frames, 9 missed"
    assert found_of(findings, "tracker", "sensor tip") == "measured in 100% at -28.50, 0.10, 0.20 mm"


def test_the_references_that_the_monitor_needs_are_counted():
    needs = IntendedInsertion(load_scenario("phantom"))
    for sensors, expected in (
        (("tip", "ref1"), {("tracker", "reference sensors")}),
        (("tip", "ref1", "ref2", "ref3"), set()),
    ):
        device = Tracker(ManualClock(), sensors=sensors)
        assert set(problems(check_tracker(rig(), device, device.clock, 1.0, needs))) == expected
