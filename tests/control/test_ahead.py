"""The predicted shape for controllers that predict none: the rest of the plan from the estimated state."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control.ahead import predict_planned_shape, remaining_controls
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, Control, Motion, X
from tasks import task_of

PLANE = flexneedle.load_scenario("phantom").with_values(
    {
        "needle.nodes": 31, "setup.tip_to_skin_mm": 6.0, "target.depth_mm": 24.0, "plan.samples": 64,
    }
)  # fmt: skip
SCENARIOS = {"plane": PLANE, "space": PLANE.with_values({"setup.axes": 2, "target.lateral_z_mm": 3.0})}


@pytest.fixture(scope="module", params=SCENARIOS)
def plan(request):
    return flexneedle.plan(SCENARIOS[request.param], threads=1)


def estimates(plan, controller, steps):
    """The estimate before any motion, and after steps of the plan without a reading."""
    task = task_of(Simulator(plan.scenario, 1), plan, controller)
    estimate = CONTROLLERS[controller].observer.begin(task)
    for k, row in enumerate(plan.controls[:steps]):
        estimate = estimate.move(Motion(Control.of(row), 0.2 * k, 0.2 * (k + 1)))
    return task, estimate


@pytest.mark.parametrize("steps", [0, 15, 26])
def test_the_rest_of_a_plan_ends_where_the_plan_ends(plan, steps):
    """Guide, base and rolls are complete; the final shape is the plan's, but for the length of a step at each roll."""
    task, estimate = estimates(plan, "open-loop", steps)
    rows = remaining_controls(task, estimate)
    left = plan.controls[steps:]
    assert rows[:, DB_X].max() <= task.scenario.setup.max_advance_mm + 1e-9
    assert estimate.state.tip[X] + rows[:, DB_X].sum() == pytest.approx(plan.target[0], abs=1e-6)
    np.testing.assert_allclose(
        rows[:, [DG_Y, DG_Z]].sum(axis=0), left[:, [DG_Y, DG_Z]].sum(axis=0), atol=0.02
    )
    assert rows[:, ROLL].sum() == pytest.approx(left[:, ROLL].sum(), abs=1e-9)
    nodes, sd = predict_planned_shape(task, estimate)
    np.testing.assert_allclose(nodes[:, 1:3], plan.shapes[-1][:, 1:3], atol=0.15)
    assert np.isfinite(sd).all()
    assert (sd[:, 1] == 0.0).all() == (plan.scenario.setup.axes == 1)


def test_the_base_goes_to_its_planned_pose(plan):
    """The plan moves and turns the base on every axis of the scenario."""
    columns = [DB_Y, DB_THETA] if plan.scenario.setup.axes == 1 else [DB_Y, DB_Z, DB_THETA, DB_PSI]
    rows = plan.controls.copy()
    rows[:, columns] = 1e-3 * np.arange(1, 1 + len(columns))
    task, estimate = estimates(replace(plan, controls=rows), "open-loop", 6)
    moved = remaining_controls(task, estimate)[:, columns].sum(axis=0)
    np.testing.assert_allclose(moved, rows[6:, columns].sum(axis=0), atol=1e-2)
    assert moved.min() > 0.02


def test_at_the_target_the_predicted_shape_is_the_present_one(plan):
    task, estimate = estimates(plan, "open-loop", len(plan.controls))
    rows = remaining_controls(task, estimate)
    assert rows.shape == (1, 9)
    assert np.abs(rows[0, DG_Y:]).max() < 1e-3
    np.testing.assert_allclose(predict_planned_shape(task, estimate).nodes, estimate.state.nodes, atol=2e-4)
