"""Test of the axes: a wrong scale, direction, channel or lost motion is found, with the value that fits."""

import re

import numpy as np
import pytest

from bench_axes import AirRig
from flexneedle.errors import DriverError, InputError, RunError
from flexneedle.lab.rig.preflight.axis_findings import (
    describe_motions,
    measure_motion,
    share_after_probe,
)
from flexneedle.lab.rig.preflight.axis_test import (
    MotorHistory,
    measure_rest,
    plan_axis_test,
    run_axis_test,
    run_axis_tests,
)
from flexneedle.lab.rig.preflight.frame_turn import describe_frame
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.types import Measurement

RIG = load_rig("emulated")
AIR = {
    name: np.array(row, float)
    for name, row in {"insertion": (1, 0, 0), "guide_y": (0, 1.2, 0), "guide_z": (0, 0, 1.2)}.items()
}


def outcome_of(rig, responses=AIR):
    """Run the whole test; return the motions and the problems by (axis, item)."""
    motors = MotorHistory()
    rig.listener = motors.add
    rest = measure_rest(rig, 1.0)
    plans = plan_axis_test(RIG, rig.positions, rest, responses)
    runs = [run_axis_test(rig, plan, lambda run: share_after_probe(RIG, responses, run)) for plan in plans]
    motions = {run.name: measure_motion(RIG, responses, run, motors) for run in runs}
    found = [*describe_motions(RIG, motions, 0.2), *describe_frame(motions)]
    return motions, {(one.part, one.item): one.problem for one in found if one.problem}, found


def test_a_right_rig_has_no_problem_and_returns_to_its_start():
    rig = AirRig(RIG)
    motions, problems, found = outcome_of(rig)
    assert problems == {}
    assert rig.positions == pytest.approx(dict.fromkeys(rig.positions, 0.0))
    assert motions["insertion"].scale == pytest.approx(1.0, abs=0.02)
    assert motions["insertion"].delay[0] == pytest.approx(0.02, abs=0.01)
    assert next(one.found for one in found if one.part == "rotation").startswith("not seen")


@pytest.mark.parametrize("axis", ["insertion", "guide_y", "guide_z"])
@pytest.mark.parametrize("scale", [0.5, 0.9, 0.95, 1.05, 1.1, 2.0, -1.0, -2.0, 5.0])
def test_a_wrong_scale_or_direction_names_the_key_and_the_value_that_fits(axis, scale):
    motions, problems, _ = outcome_of(AirRig(RIG, {axis: scale}))
    assert {name for name, _ in problems} == {axis}
    assert motions[axis].scale == pytest.approx(scale, rel=0.02 if abs(scale) < 3 else 0.1)
    if abs(scale) != 1.0:
        counts = float(problems[axis, "scale"].rsplit(" ", 1)[1])
        assert counts == pytest.approx(2000.0 / abs(scale), rel=0.02 if abs(scale) < 3 else 0.1)
    if scale < 0.0:
        assert problems[axis, "sign"] == f"axes.{axis}.direction = 1: must be -1"


SWAPS = [
    ("insertion", "guide_y"),
    ("insertion", "guide_z"),
    ("guide_y", "guide_z"),
    ("rotation", "guide_y"),
    ("rotation", "insertion"),
]


@pytest.mark.parametrize(("one", "other"), SWAPS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_swapped_channels_are_named(one, other, sign):
    axes = dict(RIG.axes.items())
    ratio = sign * axes[one].scale / axes[other].scale
    _, problems, _ = outcome_of(AirRig(RIG, {one: (other, ratio), other: (one, 1.0 / ratio)}))
    assert (
        f'axes.{one}.channel = "{axes[one].channel}": must be "{axes[other].channel}"'
        in problems[one, "axis"]
        or one == "rotation"
    )
    assert {name for name, _ in problems} >= {one}


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0, -1.0, 0.9])
@pytest.mark.parametrize("shown", [{"roll": True}, {"run_out": 0.4}])
def test_the_roll_is_seen_by_the_sensor_or_by_the_run_out(scale, shown):
    motions, problems, _ = outcome_of(AirRig(RIG, {"rotation": scale}, **shown))
    assert motions["rotation"].scale == pytest.approx(scale, abs=0.1 if "run_out" in shown else 0.02)
    hidden = (
        (1.0, 0.9) if "run_out" in shown else (1.0,)
    )  # in a guide with clearance the tip rolls on no circle
    assert bool(problems) == (scale not in hidden)


def test_lost_motion_is_a_problem_of_the_insertion_and_a_note_for_the_guide():
    motions, problems, _ = outcome_of(AirRig(RIG, lost={"insertion": 0.3, "guide_y": 0.3}))
    assert motions["insertion"].lost[0] == pytest.approx(0.3, abs=0.05)
    assert set(problems) == {("insertion", "lost motion")}
    assert problems["insertion", "lost motion"].startswith("axes.insertion.backlash_mm = 0: must be about 0.")
    assert motions["insertion"].scale == pytest.approx(1.0, abs=0.02)


def test_a_motor_that_does_not_drive_its_axis_and_a_tilted_frame_are_problems():
    assert set(outcome_of(AirRig(RIG, {"guide_y": 0.0}))[1]) == {("guide_y", "motion")}
    _, problems, _ = outcome_of(AirRig(RIG, tilt=0.3))
    directions = {(name, "direction") for name in ("insertion", "guide_y")}
    assert set(problems) == {*directions, ("tracker", "frame")}, (
        "and no scale, which follows from the directions"
    )


@pytest.mark.parametrize(
    ("degrees", "sd", "wrong"), [(2, 0.04, False), (5, 0.04, True), (-5, 0.04, True), (3, 0.3, False)]
)
def test_a_frame_that_is_turned_by_a_few_degrees_is_found_as_far_as_the_noise_allows(degrees, sd, wrong):
    _, problems, found = outcome_of(AirRig(RIG, tilt=np.radians(degrees), sd=sd))
    parts = {(name, "direction") for name in ("insertion", "guide_y")} | {("tracker", "frame")}
    assert set(problems) == (parts if wrong else set())
    if wrong:
        turn = next(one.found for one in found if one.item == "frame")
        assert re.fullmatch(r"turned by [456]° about -?z", turn)
        assert turn.endswith("-z") == (degrees < 0)


@pytest.mark.parametrize("sd", [0.0, 0.04])
def test_a_tip_that_moves_with_no_axis_is_a_problem_of_the_tracker(sd):
    """A tracker that repeats its values, or a sensor beside the needle."""
    loose = dict.fromkeys(("insertion", "guide_y", "guide_z"), 0.0)
    _, problems, found = outcome_of(AirRig(RIG, loose, sd=sd))
    assert set(problems) == {("tracker", "sensor tip")}
    assert len(found) == 1


def test_late_readings_are_a_problem():
    motions, problems, _ = outcome_of(AirRig(RIG, delay=0.3))
    assert motions["insertion"].delay[0] == pytest.approx(0.3, abs=0.01)
    assert ("insertion", "delay") in problems


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("busy", [0.1, 0.3, 0.5])
def test_a_busy_computer_is_no_problem_of_the_rig(busy, seed):
    """Times without a tick, in which the motors stop, and late ticks: correlated errors of the motors' times."""
    motions, problems, found = outcome_of(AirRig(RIG, busy=busy, seed=seed))
    assert problems == {}
    lines = [one for one in found if one.item == "delay"]
    assert len(lines) == 3
    for name, line in zip(AIR, lines, strict=True):
        if motions[name].delay is None:
            assert re.search(r"the computer was busy \(late by up to \d+ ms\)", line.found)
        else:
            delay, sd = motions[name].delay
            assert abs(delay - 0.02) < max(0.05, 4.0 * sd)


def test_without_a_scenario_the_scale_of_the_base_is_not_checked():
    air = {"insertion": AIR["insertion"]}
    _, problems, found = outcome_of(AirRig(RIG), air)
    assert problems == {}
    assert [one.found for one in found if one.part == "guide_y"] == [
        "depends on needle and guide; give --scenario"
    ]


def test_more_noise_needs_a_longer_way_and_the_insertion_moves_away_from_the_skin():
    for sd, way in ((0.01, 2.0), (0.09, 4.0)):
        rig = AirRig(RIG, sd=sd)
        plan = plan_axis_test(RIG, rig.positions, measure_rest(rig, 1.0), AIR)[0]
        assert plan.move.distance == pytest.approx(way, rel=0.3)
    back = plan_axis_test(RIG, {**rig.positions, "insertion": 30.0}, measure_rest(rig, 1.0), AIR)[0]
    assert back.move.distance < 0.0


def test_a_probe_moves_no_other_axis_far_if_their_channels_are_swapped():
    """A motor of 100,000 counts a degree would move a guide of 2,000 counts/mm by 500 mm in 10°."""
    fine = RIG.axes.rotation.model_copy(update={"counts_per_deg": 100_000.0})
    rig = RIG.model_copy(update={"axes": RIG.axes.model_copy(update={"rotation": fine})})
    plan = plan_axis_test(rig, AirRig(rig).positions, measure_rest(AirRig(rig), 1.0), AIR)[1]
    assert abs(plan.probe * fine.scale) <= 4.0 * 2000.0 * 1.001


def test_an_axis_without_room_and_a_tip_that_is_not_measured_are_refused():
    rig = AirRig(RIG)
    narrow = RIG.model_copy(
        update={
            "axes": RIG.axes.model_copy(
                update={"guide_y": RIG.axes.guide_y.model_copy(update={"range_mm": (-1.0, 1.0)})}
            )
        }
    )
    with pytest.raises(InputError, match="guide_y: at 0 mm: 2 mm to a side"):
        plan_axis_test(narrow, rig.positions, measure_rest(AirRig(RIG, sd=0.01), 1.0), AIR)
    rig.read = lambda: (Measurement(0.0, None, None),)
    with pytest.raises(RunError, match="tip: measured in 0 frames"):
        measure_rest(rig, 1.0)


@pytest.mark.parametrize("at", [0.3, 1.0, 1.6])
@pytest.mark.parametrize("scale", [1.0, 0.9])
def test_a_needle_that_passes_through_the_clearance_of_its_guide_is_no_wrong_scale(at, scale):
    """A needle that rests on one side of the guide passes to the other side on the way, and is not moved meanwhile."""
    rig = AirRig(RIG, {"guide_y": scale}, clearance=(at, 0.1))
    motions, problems, _ = outcome_of(rig)
    assert motions["guide_y"].scale == pytest.approx(scale, abs=0.03)
    assert (("guide_y", "scale") in problems) == (scale != 1.0)


@pytest.mark.parametrize("axis", ["insertion", "guide_y", "guide_z"])
@pytest.mark.parametrize("scale", [25.4, -25.4, 1 / 25.4])
def test_counts_in_inches_are_found_within_the_free_air(axis, scale):
    rig = AirRig(RIG, {axis: scale})
    motions, problems, found = outcome_of(rig)
    assert max(abs(way) for name, way in rig.farthest.items() if name != "rotation") < 3.5
    assert {name for name, _ in problems} == {axis}
    if scale == 1 / 25.4:
        assert next(one.found for one in found if one.part == axis).startswith(
            "no motion of the tip by more than"
        )
    else:
        assert motions[axis].scale == pytest.approx(scale, rel=0.05)


@pytest.mark.parametrize("scale", [57.3, -57.3])
def test_degrees_for_radians_are_not_taken_for_another_scale(scale):
    """A needle that turns 57 times would show a turn modulo 360°."""
    motions, problems, _ = outcome_of(AirRig(RIG, {"rotation": scale}, roll=True))
    assert motions["rotation"].scale == pytest.approx(scale, rel=0.02)
    assert ("rotation", "scale") in problems


TURNED = {
    "x by 180°": {"guide_y": -1.0, "guide_z": -1.0},
    "x by 90°": {"guide_y": ("guide_z", 1.0), "guide_z": ("guide_y", -1.0)},
    "-x by 90°": {"guide_y": ("guide_z", -1.0), "guide_z": ("guide_y", 1.0)},
    "z by 90°": {"insertion": ("guide_y", 1.0), "guide_y": ("insertion", -1.0)},
    "y by 180°": {"insertion": -1.0, "guide_z": -1.0},
    "": {"guide_y": ("guide_z", 1.0), "guide_z": ("guide_y", 1.0)},  # swapped: mirrored
    " ": {"guide_z": -1.0},
}


@pytest.mark.parametrize("about", TURNED)
def test_a_turned_frame_of_the_tracker_is_named_beside_the_axes(about):
    _, problems, found = outcome_of(AirRig(RIG, TURNED[about]))
    turns = [one.found for one in found if (one.part, one.item) == ("tracker", "frame")]
    assert ("tracker", "frame") in problems or not about.strip()
    assert [turn.startswith("turned by ") for turn in turns] == ([True] if about.strip() else [])
    if about.strip():
        axis, angle = about.split(" by ")
        assert turns == [f"turned by {angle} about {axis}"]


def test_after_a_fault_the_axes_before_it_are_kept_and_the_one_that_did_not_come_back_is_named():
    class Stuck(AirRig):
        def move_to(self, axis, position, speed=None):
            if axis == "rotation" and position > 1.0:
                raise DriverError("rotation: at the forward limit")
            super().move_to(axis, position, speed)

    rig, runs = Stuck(RIG), []
    plans = plan_axis_test(RIG, rig.positions, measure_rest(rig, 1.0), AIR)
    with pytest.raises(
        DriverError,
        match=r"forward limit; rotation was tested from 0 deg, and is not back: check .*direction",
    ):
        run_axis_tests(rig, plans, lambda run: share_after_probe(RIG, AIR, run), runs)
    assert [run.name for run in runs] == ["insertion"]
