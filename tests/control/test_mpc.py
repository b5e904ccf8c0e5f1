"""Advance and guide of a period: within limits, back to the plan, the same for the same seed."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control import mpc
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.interface import is_at_depth
from flexneedle.costs.terms import CE_MPC, drop_zones
from flexneedle.costs.weighted_sum import evaluate_cost, outputs_of
from flexneedle.estimation.task import Task
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DB_Y, DG_Y, DG_Z, ROLL, STILL, Control, X, Y
from tasks import stretched, task_of

PHANTOM = flexneedle.load_scenario("phantom")


@pytest.fixture(scope="module")
def plan(quick_plan):
    return quick_plan


def choose(plan, state, scenario=PHANTOM, seed=0, *, roll=0.0):
    task = task_of(Simulator(scenario, 1), plan, "ce-mpc")
    return mpc.choose_step(
        task.simulator, plan, state, task.settings, roll=roll, rng=np.random.default_rng(seed)
    )


def decide(plan, estimate, seed=0):
    """Return the decision of the paper's controller."""
    task = task_of(Simulator(PHANTOM, threads=1), plan, "ce-mpc")
    return CONTROLLERS["ce-mpc"].decide(task, None, estimate, np.random.default_rng(seed))[0]


def test_on_the_plan_it_continues_with_the_plan(plan, along):
    for periods in (10, 40, 60):
        choice = choose(plan, along(plan, periods))
        assert choice.command.dg_y == pytest.approx(plan.controls[periods, DG_Y], abs=0.06)
        assert choice.command.db_x == pytest.approx(plan.controls[periods, DB_X], abs=0.1)


@pytest.mark.parametrize("offset", [-1.0, 1.0])
def test_the_deviation_shrinks_over_the_next_periods(plan, along, offset):
    """The guide acts against a base clamp that is off to one side."""
    simulator, state = Simulator(PHANTOM), along(plan, 10, base=(offset,))
    rng = np.random.default_rng(0)

    def deviation():
        return abs(state.tip[Y] - np.interp(state.tip[X], plan.tips[:, X], plan.tips[:, Y]))

    first = deviation()
    for _ in range(12):
        choice = mpc.choose_step(simulator, plan, state, mpc.CeMpc(), roll=0.0, rng=rng)
        state = simulator.step(state, Control(db_x=choice.command.db_x, dg_y=choice.command.dg_y))
    assert first > 0.1
    assert deviation() < 0.2 * first


@pytest.mark.parametrize("left", [0.7, 0.3, 1e-6])
def test_last_advance_ends_at_the_target_depth(plan, left, along):
    state = along(plan, len(plan.controls) - 1)
    near = replace(plan, target=(float(state.tip[0]) + left, 5.0, 0.0))
    choice = choose(near, state)
    assert choice.command.db_x == pytest.approx(left, abs=0.21 if left > 0.5 else 1e-12)
    assert choice.command.db_x <= left + 1e-12


def test_past_the_target_nothing_moves_any_more(plan, along):
    state = along(plan, len(plan.controls))
    past = replace(plan, target=(float(state.tip[0]) - 0.5, 5.0, 0.0))
    choice = choose(past, state)
    assert (choice.command.db_x, choice.command.dg_y) == (0.0, 0.0)


def test_spread_describes_the_first_guide_step(plan, along):
    """The advance is fixed here; a guide that cannot move has no spread."""
    state = along(plan, 30)
    fixed = PHANTOM.with_values({"plan.advance_sigma_mm": 0.0})
    assert 1e-3 < choose(plan, state, fixed).spread < 0.5
    bare = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
    choice = choose(plan, Simulator(bare).start(), bare)
    assert (choice.spread, choice.command.dg_y) == (0.0, 0.0)


def test_cost_belongs_to_the_chosen_steps(plan, along):
    """With a horizon of one step it can be computed again: pose against the planned one, guide, energy."""
    weights = {
        "control.ce_mpc.horizon": 1, "control.ce_mpc.orientation_weight_mm": 40.0, "control.ce_mpc.guide_weight": 3.0,
        "control.ce_mpc.energy_weight_per_mj": 2.0,
    }  # fmt: skip
    scenario = PHANTOM.with_values(weights)
    state = along(plan, 40, scenario, base=(1.0,))
    choice = choose(plan, state, scenario)
    after = Simulator(scenario).step(state, Control(db_x=choice.command.db_x, dg_y=choice.command.dg_y))
    at = np.interp(state.tip[0], plan.tips[:, 0], np.arange(len(plan.tips)))
    goal = [np.interp(at + 1, np.arange(len(plan.tips)), plan.tips[:, k]) for k in range(5)]
    off = (after.tip - goal) * [1.0, 1.0, 1.0, 40.0, 40.0]
    guide = choice.command.dg_y - plan.controls[int(at + 1e-9), DG_Y]
    expected = (off**2).sum() + 3.0 * guide**2 + 2.0 * after.strain_energy
    assert choice.cost == pytest.approx(expected, rel=1e-9)


def test_no_random_search_of_many_samples_beats_it_by_much(plan, along):
    """One step ahead: the command is near the best of a fine grid."""
    scenario = PHANTOM.with_values({"control.ce_mpc.horizon": 1})
    state = along(plan, 40, scenario, base=(1.0,))
    simulator, choice = Simulator(scenario), choose(plan, state, scenario)
    reference, nominal = mpc.plan_window(plan, float(state.tip[0]), 1)
    grid = np.stack(np.meshgrid(np.linspace(0.5, 1, 41), np.linspace(-0.5, 0.5, 81)), axis=-1).reshape(-1, 2)
    controls = mpc.make_controls(scenario, state, grid, np.zeros((1, 4)), 40.0, roll=0.0)
    settings = mpc.CeMpc(horizon=1)
    charged = drop_zones(
        CE_MPC.terms(
            settings,
            reference=reference,
            orientation=settings.orientation_weight_mm,
            nominal=nominal[:, [DG_Y, DG_Z]],
        )
    )
    trajectories = simulator.rollout(state, controls, **outputs_of(charged)._asdict())
    best = evaluate_cost(charged, trajectories).min()
    assert choice.cost <= best + 0.002


def test_the_guide_stays_within_its_travel_from_the_entry_on_each_axis():
    """The needle enters off both axes, by different distances."""
    entry = {"entry.lateral_mm": -2.0, "entry.lateral_z_mm": 5.0, "target.lateral_z_mm": 5.0}
    scenario = PHANTOM.with_values({"setup.axes": 2, "setup.max_guide_travel_mm": 8.0} | entry)
    state = Simulator(scenario, 1).start()
    for sign in (-1.0, 1.0):
        z = np.repeat([[0.9, sign, sign]], 30, axis=1)
        rows = mpc.make_controls(scenario, state, z, np.zeros((30, 4)), 40.0, roll=0.0)
        end = np.array(state.guide) + rows[0, :, DG_Y : DG_Z + 1].sum(axis=0)
        np.testing.assert_allclose(end, [-2.0 + 8.0 * sign, 5.0 + 8.0 * sign])


@pytest.mark.parametrize("roll", [np.pi, 0.0])
def test_rollouts_roll_the_bevel_only_in_the_first_step_and_if_asked(plan, roll, along):
    state = along(plan, 40)
    controls = mpc.make_controls(
        PHANTOM, state, np.tile([0.9, 0.1], (3, 8)), np.zeros((8, 4)), 30.0, roll=roll
    )
    assert (controls[:, 0, ROLL] == roll).all()
    assert (controls[:, 1:, ROLL] == 0.0).all()


def test_the_rollouts_include_the_roll(plan, along):
    """The bevel that the rule chose acts on the steps that are searched, so the cost differs."""
    state, scenario = along(plan, 50), PHANTOM.with_values({"control.ce_mpc.energy_weight_per_mj": 0.0})
    kept, rolled = (choose(plan, state, scenario, roll=roll) for roll in (0.0, np.pi))
    assert kept.cost != rolled.cost


def test_command_has_the_inputs_of_the_plane_and_leaves_the_base_alone(plan, along, estimated):
    command = decide(plan, estimated(along(plan, 30))).command
    assert command == Control(db_x=command.db_x, dg_y=command.dg_y, roll=command.roll)
    assert command.roll in (0.0, np.pi)


@pytest.mark.parametrize(("short", "there"), [(0.02, False), (0.009, True), (-0.5, True)])
def test_arrived_at_the_depth_within_the_tolerance_or_past_it(plan, short, there, along, estimated):
    state = along(plan, 60)
    goal = replace(plan, target=(float(state.tip[0]) + short, 5.0, 0.0))
    assert is_at_depth(Task(Simulator(PHANTOM), goal), None, estimated(state)) is there


@pytest.mark.parametrize(("more", "there"), [(0.02, False), (0.009, True)])
def test_arrived_where_the_stroke_is_used_up(plan, more, there, along, estimated):
    """The needle stays before the target, and the last advance goes to the end of the stroke at most."""
    advanced = float(plan.controls[:60, DB_X].sum())
    short = PHANTOM.with_values({"setup.stroke_mm": advanced + more, "target.depth_mm": 10.0})
    state = along(plan, 60, short)
    assert is_at_depth(Task(Simulator(short), plan), None, estimated(state)) is there
    assert choose(plan, state, short).command.db_x <= more + 1e-9


def test_planned_base_steps_are_followed_and_caught_up_with():
    """A missed base step is made up for as fast as the limits of step and travel allow."""
    plan = flexneedle.plan(PHANTOM.with_values({"plan.base_sigma_mm": 0.1, "plan.iterations": 2}), seed=3)
    scenario = PHANTOM.with_values({"setup.max_base_step_mm": 0.2})
    moved = np.cumsum(plan.controls[:, DB_Y])
    state = Simulator(scenario).start()
    steps = mpc.steps_to_planned_base(scenario.setup, plan, state, plan.tips[1:9, 0])
    assert abs(moved[:8]).max() > 0.01
    np.testing.assert_allclose(np.cumsum(steps[:, 0]), moved[:8], atol=1e-12)
    away = moved[20] + np.sign(moved[20]) * 0.5
    ahead = replace(plan, controls=stretched(plan.controls, away / moved[20], DB_Y))
    caught_up = mpc.steps_to_planned_base(scenario.setup, ahead, state, np.full(9, plan.tips[21, 0]))
    assert abs(caught_up).max() == pytest.approx(0.2)
    assert caught_up[:, 0].sum() == pytest.approx(away)
    far = replace(plan, controls=stretched(plan.controls, 1e4, DB_Y))
    to_the_end = mpc.steps_to_planned_base(scenario.setup, far, state, np.repeat(plan.tips[-1:, 0], 400))
    assert abs(np.cumsum(to_the_end[:, 0])).max() == pytest.approx(15.0)


def test_controls_carry_the_base_steps_while_the_needle_advances(plan, along):
    base = np.array([[0.1, 0.0, 1e-3, 0.0]] * 8)
    z = np.tile(np.repeat([0.9, 0.0], 8), (2, 1))
    controls = mpc.make_controls(PHANTOM, along(plan, 10), z, base, 2.0, roll=0.0)
    np.testing.assert_allclose(controls[:, :3, DB_Y:DG_Y], np.broadcast_to(base[:3], (2, 3, 4)))
    assert (controls[:, 3:] == STILL).all()
