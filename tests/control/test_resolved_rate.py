"""Resolved rate: the Jacobian against steps one by one, the damped inverse against least squares, the law by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import flexneedle
from flexneedle.control.controllers import CONTROLLERS, resolved_rate
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DG_Y, ROLL, STILL, Control, X, Y
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
RATE = CONTROLLERS["resolved-rate"]


def decide(plan, estimate, **settings):
    scenario = PHANTOM.with_values({f"control.resolved_rate.{key}": value for key, value in settings.items()})
    task = task_of(Simulator(scenario, threads=1), plan, "resolved-rate")
    return RATE.decide(task, RATE.begin(task), estimate, np.random.default_rng(0))[0]


def stepped(state, rows):
    """The state after rows of controls, one step at a time."""
    simulator = Simulator(state.scenario, threads=1)
    for row in rows:
        state = simulator.step(state, Control.of(row))
    return state


def disturbed(rows, by):
    """Rows whose first guide step is longer."""
    changed = np.array(rows)
    changed[0, DG_Y] += by
    return changed


@pytest.mark.parametrize(
    "steps", [5, 35, 60]
)  # none in which the tip passes the skin: the Jacobian is not smooth there
@pytest.mark.parametrize("ahead", [1.0, 7.3])
def test_jacobian_is_the_finite_difference_of_steps(quick_plan, along, steps, ahead):
    state = along(quick_plan, steps)
    rows = resolved_rate.nominal_controls(PHANTOM, quick_plan, state, ahead, 0.05, 0.0)
    end, jacobian = resolved_rate.guide_jacobian(Simulator(PHANTOM, threads=1), state, rows, 0.05)
    np.testing.assert_array_equal(end, stepped(state, rows).tip)
    right, left = (stepped(state, disturbed(rows, by)).tip[Y] for by in (0.01, -0.01))
    assert jacobian.shape == (2, 1)
    across, out = jacobian[:, 0]
    assert across == pytest.approx((right - left) / 0.02, rel=1e-3)
    assert 0.0 < across < 2.0
    assert out == 0.0


def damped_inverse(jacobian, damping):
    """Motion of the guide that moves the tip by 1 mm, in the plane."""
    (step,) = resolved_rate.solve_damped(np.array([[jacobian], [0.0]]), np.array([1.0, 0.0]), damping)
    return step


@given(
    jacobian=arrays(float, (2, 2), elements=st.floats(-2, 2)), off=arrays(float, 2, elements=st.floats(-1, 1)),
    damping=st.floats(0.05, 1),
)  # fmt: skip
def test_the_damped_inverse_on_two_axes(jacobian, off, damping):
    """It solves (JᵀJ + λ²) u = Jᵀ off."""
    step = resolved_rate.solve_damped(jacobian, off, damping)
    normal = jacobian.T @ jacobian + damping**2 * np.eye(2)
    np.testing.assert_allclose(normal @ step, jacobian.T @ off, atol=1e-12)


def test_on_the_plan_it_continues_with_the_plan(quick_plan, along, estimated):
    for steps in (10, 40, 60):
        command = decide(quick_plan, estimated(along(quick_plan, steps))).command
        assert command.dg_y == pytest.approx(quick_plan.controls[steps, DG_Y], abs=0.02)
        assert command == Control(db_x=1.0, dg_y=command.dg_y, roll=command.roll)


@pytest.mark.parametrize("offset", [-0.2, 0.2])
def test_off_the_plan_the_guide_step_is_the_damped_inverse_of_the_deviation_ahead(
    quick_plan, along, estimated, offset
):
    """The whole law, with steps simulated one by one."""
    on_plan = along(quick_plan, 45)
    state = Simulator(PHANTOM, threads=1).step(on_plan.with_estimate(base=(offset,)), Control())
    depth = state.tip[0] + np.arange(6)
    planned = np.diff(np.interp(depth, quick_plan.tips[:, X], quick_plan.guide[:, 0]))
    rows = controls(len(planned), db_x=1.0, dg_y=planned)
    end = stepped(state, rows).tip
    right, left = (stepped(state, disturbed(rows, by)).tip[Y] for by in (0.05, -0.05))
    jacobian = (right - left) / 0.1
    off = np.interp(end[X], quick_plan.tips[:, X], quick_plan.tips[:, Y]) - end[Y]
    given = decide(quick_plan, estimated(state), gain=0.4, damping=0.2, lookahead_mm=5.0, curvature_per_m=0.0)
    step = planned[0] + 0.4 * jacobian * off / (jacobian**2 + 0.2**2)
    assert given.command == Control(db_x=1.0)._replace(dg_y=pytest.approx(step, rel=1e-9))
    back = decide(quick_plan, estimated(on_plan), gain=0.4, damping=0.2, curvature_per_m=0.0).command.dg_y
    assert np.sign(given.command.dg_y - back) == -np.sign(end[Y] - stepped(on_plan, rows).tip[Y])


def test_the_innovation_of_the_newest_reading_is_assumed_to_stay(quick_plan, along, estimated):
    """A tip measured 0.01 mm lateral of its prediction shifts the step by the guide motion that moves it back."""
    state, settings = along(quick_plan, 45), {"gain": 0.5, "damping": 0.1, "lookahead_mm": 3.0}
    plain = decide(quick_plan, estimated(state), **settings).command.dg_y
    shifted = decide(quick_plan, estimated(state, innovation=(0.4, 0.01, 0.0)), **settings).command.dg_y
    rows = resolved_rate.nominal_controls(PHANTOM, quick_plan, state, 3.0, 0.05, 0.0)
    _, jacobian = resolved_rate.guide_jacobian(Simulator(PHANTOM, threads=1), state, rows, 0.05)
    assert plain - shifted == pytest.approx(0.5 * damped_inverse(jacobian[0, 0], 0.1) * 0.01, rel=1e-6)


@given(
    steps=st.integers(0, 70), way=st.floats(0.01, 40), limit=st.floats(0.02, 0.5), reach=st.floats(0.02, 15),
    roll=st.sampled_from([0.0, np.pi]), advance=st.floats(0.2, 2.0),
)  # fmt: skip
@hypothesis_settings(max_examples=60)
def test_nominal_controls_insert_by_the_way_and_leave_room_for_the_disturbance(
    quick_plan, along, steps, way, limit, reach, roll, advance
):
    state = along(quick_plan, steps)
    low, high = min(limit, reach) * 0.25, reach - min(limit, reach) * 0.25
    scenario = PHANTOM.with_values(
        {
            "setup.max_guide_step_mm": limit, "setup.max_guide_travel_mm": reach,
            "setup.max_advance_mm": advance, "target.lateral_mm": 0.0,
        }
    )  # fmt: skip
    centred = state.needle._replace(boundary=state.needle.boundary._replace(guide=0.0))
    start = replace(state, solved=state.solved.with_needle(centred))
    rows = resolved_rate.nominal_controls(scenario, quick_plan, start, way, low, roll)
    assert rows[:, DB_X].sum() == pytest.approx(way)
    assert rows[:, DB_X].min() > 0.0
    assert rows[:, DB_X].max() <= advance + 1e-12
    assert np.abs(rows[:, DG_Y]).max() <= limit - low + 1e-12
    assert np.abs(np.cumsum(rows[:, DG_Y])).max() <= high + 1e-12
    assert rows[:, ROLL].tolist() == [roll] + [0.0] * (len(rows) - 1)


def test_the_path_is_led_to_the_target_at_its_end(quick_plan):
    goal = replace(quick_plan, target=(40.0, 6.0, 0.0))
    assert resolved_rate.planned_offset(goal, 40.0).tolist() == [6.0, 0.0]
    assert resolved_rate.planned_offset(goal, 50.0).tolist() == [6.0, 0.0]
    x, y = quick_plan.tips[-5, :2]
    assert resolved_rate.planned_offset(goal, float(x)).tolist() == [pytest.approx(y), 0.0]


def test_at_the_target_depth_nothing_moves(quick_plan, along, estimated):
    state = along(quick_plan, 60)
    past = replace(quick_plan, target=(float(state.tip[0]), 9.0, 0.0))
    assert decide(past, estimated(state)).command == STILL


def test_a_look_ahead_of_less_than_a_step_is_one_step(quick_plan, along, estimated):
    state = estimated(along(quick_plan, 30))
    assert decide(quick_plan, state, lookahead_mm=0.01) == decide(quick_plan, state, lookahead_mm=1.0)
