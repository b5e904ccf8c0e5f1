"""Resolved rate: the Jacobian against steps one by one, the damped inverse against least squares, the law by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from flexneedle.control.methods import METHODS, resolved_rate
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
RATE = METHODS["resolved-rate"]


def decide(plan, estimate, **settings):
    scenario = PHANTOM.with_values({f"control.resolved_rate.{key}": value for key, value in settings.items()})
    task = task_of(Simulator(scenario, threads=1), plan, "resolved-rate")
    return RATE.decide(task, RATE.begin(task), estimate, np.random.default_rng(0))[0]


def stepped(state, rows):
    """The state after rows of controls, one step at a time."""
    simulator = Simulator(state.scenario, threads=1)
    for row in rows:
        state = simulator.step(state, Control.from_row(row))
    return state


def disturbed(rows, by):
    """Rows whose first guide step is longer."""
    changed = np.array(rows)
    changed[0, 3] += by
    return changed


@pytest.mark.parametrize(
    "steps", [5, 35, 60]
)  # none in which the tip passes the skin: the Jacobian is not smooth there
@pytest.mark.parametrize("ahead", [1.0, 7.3])
def test_jacobian_is_the_finite_difference_of_steps(quick_plan, along, steps, ahead):
    state = along(quick_plan, steps)
    rows = resolved_rate.nominal(PHANTOM.setup, quick_plan, state, ahead, 0.05, flip=False)
    end, jacobian = resolved_rate.sensitivity(Simulator(PHANTOM, threads=1), state, rows, 0.05)
    np.testing.assert_array_equal(end, stepped(state, rows).tip)
    right, left = (stepped(state, disturbed(rows, by)).tip[1] for by in (0.01, -0.01))
    assert jacobian == pytest.approx((right - left) / 0.02, rel=1e-3)
    assert 0.0 < jacobian < 2.0


@given(jacobian=st.floats(-2, 2), damping=st.floats(1e-3, 1))
@hypothesis_settings(derandomize=True)
def test_damped_inverse_is_the_least_squares_solution(jacobian, damping):
    """Of J u = 1 and λ u = 0 together."""
    expected = np.linalg.lstsq(np.array([[jacobian], [damping]]), np.array([1.0, 0.0]), rcond=None)[0][0]
    assert resolved_rate.damped_inverse(jacobian, damping) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_damped_inverse_by_hand():
    assert resolved_rate.damped_inverse(0.5, 0.0) == 2.0
    assert resolved_rate.damped_inverse(0.3, 0.1) == pytest.approx(3.0)
    assert resolved_rate.damped_inverse(0.0, 0.2) == resolved_rate.damped_inverse(0.0, 0.0) == 0.0


def test_on_the_plan_it_goes_on_with_the_plan(quick_plan, along, estimated):
    for steps in (10, 40, 60):
        command = decide(quick_plan, estimated(along(quick_plan, steps))).command
        assert command[3] == pytest.approx(quick_plan.controls[steps, 3], abs=0.02)
        assert command[:3] == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("offset", [-0.2, 0.2])
def test_off_the_plan_the_guide_step_is_the_damped_inverse_of_the_deviation_ahead(
    quick_plan, along, estimated, offset
):
    """All of the law, with steps taken one by one in place of what it calls."""
    on_plan = along(quick_plan, 45)
    state = Simulator(PHANTOM, threads=1).step(on_plan.with_estimate(base_y=offset), Control())
    depth = state.tip[0] + np.arange(6)
    planned = np.diff(np.interp(depth, quick_plan.tips[:, 0], quick_plan.guide))
    rows = [[1.0, 0.0, 0.0, step, -1.0] for step in planned]
    end = stepped(state, rows).tip
    right, left = (stepped(state, disturbed(rows, by)).tip[1] for by in (0.05, -0.05))
    jacobian = (right - left) / 0.1
    off = np.interp(end[0], quick_plan.tips[:, 0], quick_plan.tips[:, 1]) - end[1]
    given = decide(quick_plan, estimated(state), gain=0.4, damping=0.2, lookahead_mm=5.0, curvature_per_m=0.0)
    step = planned[0] + 0.4 * jacobian * off / (jacobian**2 + 0.2**2)
    assert given.command == (1.0, 0.0, 0.0, pytest.approx(step, rel=1e-9), -1)
    back = decide(quick_plan, estimated(on_plan), gain=0.4, damping=0.2, curvature_per_m=0.0).command[3]
    assert np.sign(given.command[3] - back) == -np.sign(end[1] - stepped(on_plan, rows).tip[1])


def test_what_the_newest_reading_was_off_is_taken_to_stay(quick_plan, along, estimated):
    """A tip measured 0.01 mm lateral of its prediction shifts the step by the guide motion that moves it back."""
    state, settings = along(quick_plan, 45), {"gain": 0.5, "damping": 0.1, "lookahead_mm": 3.0}
    plain = decide(quick_plan, estimated(state), **settings).command[3]
    shifted = decide(quick_plan, estimated(state, innovation=(0.4, 0.01)), **settings).command[3]
    rows = resolved_rate.nominal(PHANTOM.setup, quick_plan, state, 3.0, 0.05, flip=False)
    _, jacobian = resolved_rate.sensitivity(Simulator(PHANTOM, threads=1), state, rows, 0.05)
    assert plain - shifted == pytest.approx(
        0.5 * resolved_rate.damped_inverse(jacobian, 0.1) * 0.01, rel=1e-6
    )


def test_without_gain_the_plan_is_all_there_is(quick_plan, along, estimated):
    state = along(quick_plan, 30)
    off = Simulator(PHANTOM, threads=1).step(state.with_estimate(base_y=1.0), Control())
    depth = off.tip[0] + np.array([0.0, 1.0])
    planned = np.diff(np.interp(depth, quick_plan.tips[:, 0], quick_plan.guide))[0]
    assert decide(quick_plan, estimated(off), gain=0.0).command[3] == pytest.approx(planned)


@given(
    steps=st.integers(0, 70), way=st.floats(0.01, 40), limit=st.floats(0.02, 0.5), reach=st.floats(0.02, 15),
    flip=st.booleans(), advance=st.floats(0.2, 2.0),
)  # fmt: skip
@hypothesis_settings(deadline=None, derandomize=True, max_examples=60)
def test_nominal_controls_insert_by_the_way_and_leave_room_for_the_disturbance(
    quick_plan, along, steps, way, limit, reach, flip, advance
):
    state = along(quick_plan, steps)
    low, high = min(limit, reach) * 0.25, reach - min(limit, reach) * 0.25
    setup = PHANTOM.setup.model_copy(
        update={"max_guide_step_mm": limit, "max_guide_travel_mm": reach, "max_advance_mm": advance}
    )
    centred = state.needle._replace(boundary=state.needle.boundary._replace(guide=0.0))
    start = replace(state, needle=centred)
    rows = resolved_rate.nominal(setup, quick_plan, start, way, low, flip=flip)
    assert rows[:, 0].sum() == pytest.approx(way)
    assert rows[:, 0].min() > 0.0
    assert rows[:, 0].max() <= advance + 1e-12
    assert np.abs(rows[:, 3]).max() <= limit - low + 1e-12
    assert np.abs(np.cumsum(rows[:, 3])).max() <= high + 1e-12
    assert (rows[:, 4] > 0).tolist() == [flip] + [False] * (len(rows) - 1)


def test_the_path_is_led_to_the_target_at_its_end(quick_plan):
    goal = replace(quick_plan, target=(40.0, 6.0))
    assert resolved_rate.planned_y(goal, 40.0) == 6.0
    assert resolved_rate.planned_y(goal, 50.0) == 6.0
    x, y = quick_plan.tips[-5, :2]
    assert resolved_rate.planned_y(goal, float(x)) == pytest.approx(y)


def test_at_the_target_depth_nothing_moves_any_more(quick_plan, along, estimated):
    state = along(quick_plan, 60)
    past = replace(quick_plan, target=(float(state.tip[0]), 9.0))
    assert decide(past, estimated(state)).command == (0.0, 0.0, 0.0, 0.0, -1)


def test_the_last_advance_ends_at_the_target_depth(quick_plan, along, estimated):
    state = along(quick_plan, 60)
    near = replace(quick_plan, target=(float(state.tip[0]) + 0.3, 5.0))
    assert decide(near, estimated(state)).command[0] == pytest.approx(0.3)


def test_a_look_ahead_of_less_than_a_step_is_one_step(quick_plan, along, estimated):
    state = estimated(along(quick_plan, 30))
    assert decide(quick_plan, state, lookahead_mm=0.01) == decide(quick_plan, state, lookahead_mm=1.0)
