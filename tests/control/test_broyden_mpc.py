"""Broyden MPC: the update's laws, the bounded solve against others, and all of it on needles that are linear."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import lsq_linear

import flexneedle
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.controllers import broyden_mpc as bm
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DG_Y, Control, X, Y
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
BROYDEN = CONTROLLERS["broyden-mpc"]
SETTINGS = bm.BroydenMpc()
RNG = np.random.default_rng(0)
NUMBERS = st.floats(-2.0, 2.0)
MATRIX, VECTOR = arrays(float, (2, 2), elements=NUMBERS), arrays(float, 2, elements=NUMBERS)
MOVE = VECTOR.filter(lambda move: np.abs(move).max() > 0.05)


# ---- Broyden's update


@given(jacobian=MATRIX, moved=MOVE, measured=VECTOR)
def test_the_full_update_meets_the_secant_equation(jacobian, moved, measured):
    np.testing.assert_allclose(bm.broyden_update(jacobian, moved, measured, 1.0) @ moved, measured, atol=1e-9)


@given(jacobian=MATRIX, moved=MOVE, measured=VECTOR, gain=st.floats(0, 1))
def test_the_update_changes_nothing_across_the_move_and_is_of_rank_one(jacobian, moved, measured, gain):
    updated = bm.broyden_update(jacobian, moved, measured, gain)
    across = np.array([-moved[1], moved[0]])
    np.testing.assert_allclose(updated @ across, jacobian @ across, atol=1e-9)
    assert np.linalg.matrix_rank(updated - jacobian, tol=1e-9) <= 1


@given(jacobian=MATRIX, moved=MOVE, measured=VECTOR, other=MATRIX)
def test_no_other_matrix_that_meets_the_equation_is_nearer(jacobian, moved, measured, other):
    nearest = bm.broyden_update(jacobian, moved, measured, 1.0)
    meets = other + np.outer(measured - other @ moved, moved) / (moved @ moved)
    assert np.linalg.norm(nearest - jacobian) <= np.linalg.norm(meets - jacobian) + 1e-9


def test_the_gain_is_the_share_of_the_update_that_is_made():
    by_hand = bm.broyden_update(np.diag([1.0, 1.0]), np.array([1.0, 0.0]), np.array([1.0, 0.2]), 0.65)
    np.testing.assert_allclose(by_hand, [[1.0, 0.0], [0.13, 1.0]], atol=1e-15)
    assert SETTINGS.update_gain == 0.65


# ---- the bounded solve


@given(
    matrix=arrays(float, (5, 4), elements=NUMBERS), right=arrays(float, 5, elements=st.floats(-5, 5)),
    lower=arrays(float, 4, elements=st.floats(-2, 0)), upper=arrays(float, 4, elements=st.floats(0, 2)),
)  # fmt: skip
@hypothesis_settings(max_examples=100)
def test_the_bounded_solve_costs_no_more_than_scipys(matrix, right, lower, upper):
    z = bm.bounded_least_squares(matrix, right, lower, upper)
    assert (z >= lower).all()
    assert (z <= upper).all()
    best = lsq_linear(matrix, right, (lower - 1e-9, upper + 1e-9), method="bvls", tol=1e-14)
    cost = np.sum((matrix @ z - right) ** 2)
    assert cost <= 2.0 * best.cost + 1e-6


def test_the_bounded_solve_is_the_best_of_a_fine_grid():
    matrix = np.array([[1.0, 0.2, 0.0], [0.0, 0.8, -0.5], [0.3, 0.0, 0.6], [-1.0, 1.0, 0.0]])
    right, upper = np.array([1.5, -0.7, 0.9, 0.2]), np.array([0.5, 0.4, 0.6])
    z = bm.bounded_least_squares(matrix, right, -upper, upper)
    axis = np.linspace(-1.0, 1.0, 61)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3) * upper
    costs = ((grid @ matrix.T - right) ** 2).sum(axis=1)
    assert ((matrix @ z - right) ** 2).sum() <= costs.min()
    np.testing.assert_allclose(z, grid[costs.argmin()], atol=0.05)
    assert np.isclose(np.abs(z), upper).any()
    assert not np.isclose(np.abs(z), upper).all()


def test_free_of_its_bounds_the_solve_is_plain_least_squares():
    rng = np.random.default_rng(3)
    matrix, right = rng.normal(size=(6, 4)), rng.normal(size=6)
    z = bm.bounded_least_squares(matrix, right, np.full(4, -1e3), np.full(4, 1e3))
    np.testing.assert_allclose(z, np.linalg.lstsq(matrix, right, rcond=None)[0], rtol=1e-5)


def test_a_guide_without_effect_or_room_stays():
    free = np.full(2, 1.0)
    assert (bm.bounded_least_squares(np.zeros((2, 2)), np.ones(2), -free, free) == 0.0).all()
    assert (bm.bounded_least_squares(np.eye(2), np.ones(2), np.zeros(2), np.zeros(2)) == 0.0).all()


# ---- linear MPC


def moves(plan, jacobian, tip, guide=0.0, steps=4, **settings):
    ahead = np.arange(1.0, steps + 1)
    chosen = SETTINGS.model_copy(update=settings)
    found, cost = bm.solve_guide_moves(
        chosen, PHANTOM, plan, jacobian, np.array(tip), ahead, np.array([guide])
    )
    return found[:, 0], cost


def straight(plan, lateral):
    """The plan with a path at one lateral position."""
    tips = np.zeros_like(plan.tips)
    tips[:, X], tips[:, Y] = plan.tips[:, X], lateral
    return replace(plan, tips=tips, target=(plan.target[0], lateral, 0.0))


def test_free_of_limits_and_weight_the_prediction_meets_the_path_at_every_step(quick_plan):
    jacobian = np.array([[1.0, 0.0], [0.1, 0.8]])
    begin = float(np.interp(12.0, quick_plan.tips[:, X], quick_plan.tips[:, Y])) - 0.2
    found, cost = moves(quick_plan, jacobian, (12.0, begin), guide_weight=0.0)
    tip = begin + 0.1 * np.arange(1, 5) + 0.8 * found
    goal = np.interp(12.0 + np.arange(1, 5), quick_plan.tips[:, X], quick_plan.tips[:, Y])
    unlimited = np.abs(found) < 0.5 * np.arange(1, 5)
    assert unlimited.any()
    np.testing.assert_allclose(tip[unlimited], goal[unlimited], atol=1e-7)
    assert cost == pytest.approx(((tip - goal) ** 2).sum(), abs=1e-9)


def test_the_cost_of_guide_steps_by_hand(quick_plan):
    """With one step, effect 1 and weight 1 the guide takes half of a lateral offset of 0.2 mm."""
    found, cost = moves(straight(quick_plan, 0.2), np.eye(2), (10.0, 0.0), steps=1, guide_weight=1.0)
    assert found[0] == pytest.approx(0.1)
    assert cost == pytest.approx(0.02)


def test_steps_and_places_of_the_guide_keep_their_limits(quick_plan):
    far = straight(quick_plan, 9.0)
    found, _ = moves(far, np.eye(2), (10.0, 0.0), guide=5.2)
    np.testing.assert_allclose(found, [0.5, 0.8, 0.8, 0.8])  # 0.5 mm a step, no further than 6 mm
    found, _ = moves(far, np.eye(2), (10.0, 0.0), guide=5.2, max_guide_travel_mm=99.0)
    np.testing.assert_allclose(found, [0.5, 1.0, 1.5, 2.0])
    assert (SETTINGS.horizon, SETTINGS.max_guide_travel_mm) == (4, 6.0)


# ---- the whole controller, on needles that are linear


def linear_run(plan, slope, effect, *, delay=1, steps=30):
    """Drive a tip y = slope x + effect guide; readings come `delay` steps late. Tips, guides, the last memory."""
    scenario = PHANTOM.with_values(
        {"control.broyden_mpc.guide_weight": 0.0, "control.broyden_mpc.guide_effect": 1.0}
    )
    task = task_of(Simulator(scenario, threads=1), plan, "broyden-mpc")
    memory, inputs, tips = BROYDEN.begin(task), [np.zeros(2)], [np.array([-28.5, 0.0])]
    for k in range(steps):
        insertion, guide = inputs[-1]
        measured = tips[k - delay] if k >= delay else None
        state = SimpleNamespace(
            travel=np.array([insertion, 0.0, 0.0, 0.0, 0.0, guide, 0.0]), guide=(guide, 0.0),
            tip=np.array([*tips[-1], 0.0, 0.0, 0.0]),
            base=np.array([scenario.start_base_x + insertion, 0.0, 0.0, 0.0, 0.0]),
        )  # fmt: skip
        estimate = SimpleNamespace(state=state, measured=None if measured is None else (*measured, 0.0))
        decision, memory = BROYDEN.decide(task, memory, estimate, RNG)
        command = decision.command
        assert command == Control(db_x=command.db_x, dg_y=command.dg_y)
        inputs.append(inputs[-1] + np.array(command)[[DB_X, DG_Y]])
        tips.append(np.array([-28.5 + inputs[-1][0], slope * inputs[-1][0] + effect * inputs[-1][1]]))
    return np.array(tips), np.array(inputs), memory


@pytest.mark.parametrize("delay", [1, 2])
@pytest.mark.parametrize(("slope", "effect"), [(0.05, 1.0), (-0.03, 1.0), (0.03, 0.8)])
def test_a_linear_needle_is_identified_and_kept_on_its_path(quick_plan, slope, effect, delay):
    """Readings are compared with the inputs at their time, so that late ones cost no accuracy."""
    tips, _, memory = linear_run(straight(quick_plan, 0.0), slope, effect, delay=delay)
    assert np.abs(tips[:3, 1]).max() > 0.02
    np.testing.assert_allclose(tips[20:, 1], 0.0, atol=5e-3)
    direction = memory.jacobian @ [1.0, -slope / effect]
    np.testing.assert_allclose(direction, [1.0, 0.0], atol=2e-3)  # what it needs to know of the Jacobian


def test_a_lateral_path_is_reached_by_guide_steps_within_their_limit(quick_plan):
    tips, inputs, _ = linear_run(straight(quick_plan, 2.0), 0.0, 0.7)
    assert np.abs(np.diff(inputs[:, 1])).max() == pytest.approx(0.5)
    assert tips[-1, 1] == pytest.approx(2.0, abs=1e-3)


def test_before_the_first_reading_it_goes_straight_on(quick_plan):
    _, inputs, memory = linear_run(straight(quick_plan, 2.0), 0.0, 1.0, steps=3, delay=3)
    np.testing.assert_array_equal(inputs[:, 1], 0.0)
    np.testing.assert_array_equal(memory.jacobian, np.eye(2))
    assert memory.last_update is None


def test_an_old_reading_updates_nothing():
    memory = bm.JacobianEstimate(
        np.eye(2), ((0.0, 28.5, 0.0),), (np.array([0.0, 0.0]), np.array([28.5, 0.0]))
    )
    assert bm.update_jacobian(memory, np.array([0.02, 0.05]), np.array([28.52, 0.0]), 0.65) is memory
    further = bm.update_jacobian(memory, np.array([1.0, 0.05]), np.array([29.5, 0.0]), 0.65)
    assert further.jacobian[1, 0] == pytest.approx(0.65 * 0.05)


def test_inputs_are_interpolated_and_the_last_eight_are_kept():
    memory = bm.JacobianEstimate(np.eye(2), ((1.0, 10.0, 0.2), (2.0, 11.0, 0.6), (2.5, 11.5, 0.6)))
    np.testing.assert_allclose(bm.interpolate_inputs(memory, 1.25), [10.25, 0.3])
    np.testing.assert_allclose(bm.interpolate_inputs(memory, 9.0), [11.5, 0.6])
    for k in range(20):
        memory = bm.record_inputs(memory, 3.0 + k, np.zeros(2))
    assert len(memory.history) == 8
