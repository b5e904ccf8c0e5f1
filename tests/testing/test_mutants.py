"""Each kit fails on wrong parts, and each fault is found by the check of the rule that it breaks."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from flexneedle import Control, Controller, Decision, travel_left
from flexneedle.testing import ControllerConformance
from flexneedle.types import ROLL
from kits import checks_of
from testing.wrong_devices import (
    AddsToThePosition,
    ChangesItsFrames,
    ClosesOnce,
    Device,
    DoesNotStop,
    FailsAsOSError,
    HidesItsFailure,
    IgnoresFurtherPositions,
    IgnoresTheSpeed,
    LeapsWhenSwitchedOn,
    Motors,
    MovesToDefine,
    MovesToReconnect,
    MovesWhenOpened,
    MovesWithoutPower,
    ReadsOneChannel,
    ReadsTuples,
    RepliesLate,
    TakesAnyPosition,
    WaitsForTheEnd,
    of_device,
    of_motors,
)
from testing.wrong_phantoms import (
    Axes,
    Camera,
    ChangesItsRow,
    DrawsFromTheGlobalGenerator,
    MovesWhenRead,
    Repeats,
    SharesItsState,
    Unicycle,
    Waits,
    of_camera,
    of_driver,
    of_plant,
    reporting,
    with_values,
)


def straight(task, memory, estimate, rng):
    """Follow the plan: its flips, and a full step."""
    del rng
    plan, left = task.plan, travel_left(task.scenario, task.plan, estimate.state)
    due = np.sum(plan.tips[:-1, 0][plan.controls[:, ROLL] != 0.0] <= estimate.tip[0])
    command = Control(db_x=min(left, task.scenario.setup.max_advance_mm), flip=bool(due > memory))
    return Decision(command, "straight"), memory + command.rolls


@dataclass
class Hidden:
    """State outside the memory."""

    calls: int = 0


def changes_the_plan(task, memory, estimate, rng):
    task.plan.tips.flags.writeable = True
    task.plan.tips[-1] = 0.0
    return straight(task, memory, estimate, rng)


def exceeds_its_step(task, memory, estimate, rng):
    decision, after = straight(task, memory, estimate, rng)
    return replace(
        decision, command=decision.command._replace(db_x=2.0 * task.scenario.setup.max_advance_mm)
    ), after


def draws_globally(task, memory, estimate, rng):
    decision, after = straight(task, memory, estimate, rng)
    advance = decision.command.db_x * np.random.uniform(0.5, 1.0)  # noqa: NPY002
    return replace(decision, command=decision.command._replace(db_x=advance)), after


HIDDEN = Hidden()


def keeps_state(task, memory, estimate, rng):
    HIDDEN.calls += 1
    decision, after = straight(task, memory, estimate, rng)
    return replace(decision, why=f"call {HIDDEN.calls}"), after


def does_not_advance(task, memory, estimate, rng):
    del task, estimate, rng
    return Decision(Control(), "wait"), memory


def appends_to_its_memory(task, memory, estimate, rng):
    memory.append(0)
    decision, _ = straight(task, 0, estimate, rng)
    return decision, memory


def is_silent(task, memory, estimate, rng):
    decision, after = straight(task, memory, estimate, rng)
    return replace(decision, why=""), after


def of_controller(decide=straight, **options):
    made = Controller("mutant", "a fault", **{"begin": lambda _: 0, "decide": decide, **options})
    return type("Kit", (ControllerConformance,), {"make": lambda _: made, "error_mm": 3.0})


SOUND = {
    "plant": of_plant(Unicycle),
    "driver": of_driver(Axes),
    "tip tracker": of_camera(Camera),
    "tracker": of_device(Device),
    "motors": of_motors(Motors),
    "controller": of_controller(),
}
MUTANTS = [
    (of_plant(with_values(Unicycle, metres=1e-3)), "test_base_moves_the_tip_in_millimetres"),
    (of_plant(with_values(Unicycle, degrees=180 / math.pi)), "test_roll_turns_the_bevel_in_radians"),
    (of_plant(with_values(Unicycle, side=-1.0)), "test_path_bends_towards_the_bevel"),
    (of_plant(with_values(Unicycle, slips=0.01)), "test_still_command_moves_nothing"),
    (of_plant(with_values(Unicycle, strain_energy=math.nan)), "test_energy_and_stretch_are_physical"),
    (of_plant(with_values(Unicycle, nodes=np.zeros((3, 3)))), "test_nodes_end_at_the_tip"),
    (of_plant(with_values(Unicycle, tip=np.zeros(3))), "test_tip_is_a_pose"),
    (of_plant(lambda truth, _: Unicycle(truth, 0.0)), "test_starts_where_the_scenario_does"),
    (of_plant(lambda *_: object()), "test_has_the_parts_of_the_port"),
    (of_plant(ChangesItsRow), "test_command_and_truth_are_not_changed"),
    (of_plant(SharesItsState), "test_plants_are_independent"),
    (of_plant(MovesWhenRead), "test_reading_changes_nothing"),
    (of_driver(reporting(lambda motion: motion.control)), "test_motion_has_control_and_times"),
    (of_driver(reporting(lambda m: m._replace(control=Control(1e-3)))), "test_motion_has_control_and_times"),
    (of_driver(reporting(lambda m: m._replace(begun=0.0))), "test_motion_has_control_and_times"),
    (of_driver(reporting(lambda m: m._replace(ended=m.ended + 1.0))), "test_motion_has_control_and_times"),
    (of_driver(reporting(lambda m: m._replace(begun=m.begun - 0.1))), "test_motions_follow_each_other"),
    (of_driver(reporting(lambda m: m._replace(turned=None))), "test_roll_precedes_the_travel"),
    (of_driver(with_values(Axes, first=0.1)), "test_roll_precedes_the_travel"),
    (of_driver(reporting(lambda m: m._replace(begun=m.ended))), "test_travel_takes_its_duration"),
    (of_driver(with_values(Axes, limit=math.inf)), "test_command_beyond_a_limit_is_refused"),
    (of_driver(with_values(Axes, stops=1.0)), "test_stop_at_rest_does_nothing"),
    (of_camera(with_values(Camera, unit=0.1)), "test_positions_are_the_tip_at_their_times"),
    (of_camera(with_values(Camera, lag=1.0)), "test_times_increase_and_are_past"),
    (of_camera(with_values(Camera, order=-1)), "test_times_increase_and_are_past"),
    (of_camera(with_values(Camera, rate=0.5)), "test_readings_arrive_before_they_are_stale"),
    (of_camera(with_values(Camera, late=100)), "test_tip_is_measured_before_the_needle_moves"),
    (of_camera(with_values(Camera, image=lambda *_: (0.0, 1.0))), "test_read_returns_measurements"),
    (of_camera(with_values(Camera, status=None)), "test_has_the_parts_of_the_port"),
    (of_camera(Repeats), "test_each_reading_is_returned_once"),
    (of_camera(Waits), "test_read_neither_waits_nor_moves"),
    (of_camera(DrawsFromTheGlobalGenerator), "test_same_seed_same_readings"),
    (of_device(with_values(Device, length=2.0)), "test_frames_are_of_their_type"),
    (of_device(with_values(Device, ahead=1.0)), "test_frames_are_in_their_order"),
    (of_device(with_values(Device, number=0)), "test_frames_are_in_their_order"),
    (of_device(with_values(Device, sensor="needle")), "test_needle_sensor_has_positions"),
    (of_device(with_values(Device, position=None)), "test_needle_sensor_has_positions"),
    (of_device(with_values(Device, status="starting")), "test_arrives_at_its_rate"),
    (of_device(with_values(Device, status=None)), "test_has_the_parts_of_the_port"),
    (of_device(with_values(Device, takes=0.5)), "test_read_does_not_wait"),
    (of_device(ChangesItsFrames), "test_frames_do_not_change"),
    (of_device(HidesItsFailure), "test_failure_is_reported"),
    (of_motors(WaitsForTheEnd), "test_follow_does_not_wait_for_the_end"),
    (of_motors(RepliesLate), "test_calls_reply_in_time"),
    (of_motors(IgnoresFurtherPositions), "test_follow_replaces_the_position_before"),
    (of_motors(MovesWithoutPower), "test_motor_that_is_off_does_not_move"),
    (of_motors(MovesToReconnect), "test_reconnect_moves_nothing"),
    (of_motors(ClosesOnce), "test_close_can_be_repeated"),
    (of_motors(MovesWhenOpened), "test_opening_and_reading_move_nothing"),
    (of_motors(DoesNotStop), "test_stop_ends_a_motion"),
    (of_motors(IgnoresTheSpeed), "test_speed_is_limited"),
    (of_motors(MovesToDefine), "test_define_renames_the_position"),
    (of_motors(TakesAnyPosition), "test_position_that_is_not_finite_is_refused"),
    (of_motors(ReadsOneChannel), "test_read_returns_the_state_of_each_channel"),
    (of_motors(ReadsTuples), "test_read_returns_the_state_of_each_channel"),
    (of_motors(LeapsWhenSwitchedOn), "test_power_holds_the_motor_where_it_is"),
    (type("Kit", (of_motors(Motors),), {"switches_off": False}), "test_power_holds_the_motor_where_it_is"),
    (of_motors(FailsAsOSError), "test_failures_are_driver_errors"),
    (of_motors(AddsToThePosition), "test_follow_moves_to_a_position_and_stops_there"),
    (of_motors(with_values(Motors, identity=3)), "test_has_the_parts_of_the_port"),
    (of_controller(changes_the_plan), "test_plan_is_not_changed"),
    (of_controller(exceeds_its_step), "test_commands_keep_the_limits"),
    (of_controller(draws_globally), "test_same_seed_same_decisions"),
    (of_controller(keeps_state), "test_decision_follows_from_its_arguments"),
    (of_controller(appends_to_its_memory, begin=lambda _: []), "test_decision_follows_from_its_arguments"),
    (of_controller(does_not_advance), "test_ends_at_the_target"),
    (of_controller(arrived=lambda *_: True), "test_ends_at_the_target"),
    (of_controller(is_silent), "test_decides_with_a_reason"),
    (of_controller(predicts=True), "test_predictions_are_numbers"),
    (type("Kit", (ControllerConformance,), {"make": lambda _: straight}), "test_is_a_controller"),
]


@pytest.mark.parametrize("port", SOUND)
def test_a_sound_part_passes(port):
    kit = SOUND[port]
    for name in checks_of(kit):
        getattr(kit(), name)()


@pytest.mark.parametrize(
    ("kit", "check"), MUTANTS, ids=[f"{n}-{check}" for n, (_, check) in enumerate(MUTANTS)]
)
def test_a_fault_is_found_by_the_check_of_its_rule(kit, check):
    with pytest.raises(AssertionError):
        getattr(kit(), check)()


def test_every_check_finds_a_fault():
    found = {check for _, check in MUTANTS}
    assert {name for kit in SOUND.values() for name in checks_of(kit)} == found
