"""Open loop: positions of the plan are replayed, in spite of motors that stop short; no reading is used."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DG_Y, ROLL, Control
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
OPEN = CONTROLLERS["open-loop"]
RNG = np.random.default_rng(0)
MOTORS = [DB_X, DG_Y]


def truncated(moved, row, grid=0.01):
    """A row as carried out by motors that stop at the last multiple of `grid` on the way."""
    ends = (moved + row) / grid
    return np.where(row >= 0.0, np.floor(ends + 1e-6), np.ceil(ends - 1e-6)) * grid - moved


def replayed(plan, estimated, scenario=PHANTOM, motor=truncated):
    """Commands, and the positions of base x and guide after each, with a driver's motor."""
    task = task_of(Simulator(scenario, threads=1), plan, "open-loop")
    state, memory = task.simulator.start(plan.roll), OPEN.begin(task)
    commands, places = [], []
    while not OPEN.arrived(task, memory, estimated(state)):
        decision, memory = OPEN.decide(task, memory, estimated(state), RNG)
        row = np.array(decision.command)
        row[MOTORS] = motor(state.travel[MOTORS], row[MOTORS])
        commands.append(decision.command)
        state = task.simulator.step(state, Control.of(row.tolist()))
        places.append(state.travel[MOTORS])
    return commands, np.array(places)


def test_positions_follow_the_plan_through_a_motor_that_stops_short(quick_plan, estimated):
    """They lag by at most one resolution; repeated steps would lose some at each."""
    planned = np.cumsum(quick_plan.controls[:, MOTORS], axis=0)
    _, places = replayed(quick_plan, estimated)
    assert places.shape == planned.shape
    assert np.abs(places - planned).max() < 0.01 + 1e-6
    lost = np.zeros(2)
    for row in quick_plan.controls[:, MOTORS]:
        lost = lost + truncated(lost, row)
    assert np.abs(lost - planned[-1]).max() > 0.1


def test_a_perfect_motor_gets_the_planned_steps(quick_plan, estimated):
    commands, _ = replayed(quick_plan, estimated, motor=lambda _moved, row: row)
    np.testing.assert_allclose(commands, quick_plan.controls, atol=1e-9)


def test_bevel_rolls_where_planned(quick_plan, estimated):
    rolls = quick_plan.controls.copy()
    rolls[[12, 40], ROLL] = np.pi
    commands, _ = replayed(replace(quick_plan, controls=rolls), estimated)
    assert [k for k, command in enumerate(commands) if command.roll > 0.0] == [12, 40]


def test_readings_change_nothing(quick_plan, estimated, along):
    task, state = task_of(Simulator(PHANTOM, threads=1), quick_plan, "open-loop"), along(quick_plan, 20)
    blind = OPEN.decide(task, 20, estimated(state), RNG)[0].command
    seeing = OPEN.decide(
        task, 20, estimated(state, measured=(1.0, 9.0, 0.0), innovation=(0.5, 3.0, 0.0)), RNG
    )[0].command
    assert blind == seeing == pytest.approx(tuple(quick_plan.controls[20]))


def test_it_has_arrived_once_the_steps_are_used_up_and_carried_out(quick_plan, estimated, along):
    """A needle that was held has not."""
    task, count = task_of(Simulator(PHANTOM, threads=1), quick_plan, "open-loop"), len(quick_plan.controls)
    end = estimated(along(quick_plan, count))
    assert not OPEN.arrived(task, count - 1, end)
    assert OPEN.arrived(task, count, end)
    held = estimated(along(quick_plan, 5))
    assert not OPEN.arrived(task, count, held)
    assert OPEN.decide(task, count, held, None)[0].command.db_x > 0.0


def test_steps_and_reach_of_a_smaller_setup_are_kept(quick_plan, estimated):
    """A plan of a larger setup is carried out slower and with less lateral travel."""
    tight = {"setup.max_guide_step_mm": 0.02, "setup.max_guide_travel_mm": 0.4, "target.lateral_mm": 0.0}
    commands, places = replayed(quick_plan, estimated, PHANTOM.with_values(tight))
    assert max(abs(command.dg_y) for command in commands) <= 0.02
    assert np.abs(places[:, 1]).max() == pytest.approx(0.4)
