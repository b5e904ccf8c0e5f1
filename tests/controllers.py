"""Fixtures of the tests of controllers: quick plans, mirror images, estimates by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.estimation import fit
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_THETA, DB_Y, DG_Y, Control, X
from reference.cases import MIRROR
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom")


@pytest.fixture(scope="session")
def quick_plan():
    """A plan that reaches (40, 5)."""
    return flexneedle.plan(PHANTOM, (40.0, 5.0), seed=1, threads=1)


@pytest.fixture(scope="session")
def short_plan():
    """A plan of 25 steps in its own scenario, with few samples for each controller that searches."""
    few = {"control.ce_mpc.samples": 8, "control.ce_mpc.iterations": 1}
    few |= {"control.adaptive_mpc.paths": 12, "control.adaptive_mpc.unguided_iterations": 1}
    near = {
        "setup.tip_to_skin_mm": 5.0,
        "target.depth_mm": 20.0,
        "target.lateral_mm": 2.0,
        "needle.nodes": 31,
    }
    return flexneedle.plan(PHANTOM.with_values({**near, **few, "plan.samples": 48}), seed=1, threads=1)


@pytest.fixture(scope="session")
def mirrored():
    """The mirror image of a plan: every y and slope dy/dx with the other sign, and the bevel on the other side."""

    def mirror(plan):
        controls = plan.controls.copy()
        controls[:, [DB_Y, DB_THETA, DG_Y]] *= -1.0
        return replace(
            plan,
            target=(plan.target[0], -plan.target[1], plan.target[2]),
            roll=math.pi - plan.roll,
            controls=controls,
            tips=plan.tips * MIRROR,
            guide=plan.guide * [-1.0, 1.0],
            shapes=plan.shapes * MIRROR,
        )

    return mirror


@pytest.fixture(scope="session")
def along():
    """The state after some steps of a plan, in the phantom or another scenario, then corrected."""

    def go(plan, steps, scenario=PHANTOM, **corrections):
        simulator = Simulator(scenario, threads=1)
        state = simulator.start(plan.roll)
        for row in plan.controls[:steps]:
            state = simulator.step(state, Control.of(row.tolist()))
        if corrections:
            state = simulator.step(state.with_estimate(**corrections), Control())
        return state

    return go


@pytest.fixture(scope="session")
def estimated():
    """An estimate of a state, with any of its other fields."""

    def estimate(state, **fields):
        return replace(
            StateCorrection().begin(begun_with(Simulator(state.scenario, threads=1))),
            state=state,
            **fields,
        )

    return estimate


@pytest.fixture
def all_fresh(monkeypatch):
    """Every derivative simulated in every period."""
    monkeypatch.setattr(fit, "due_parameters", lambda fitted: iter(range(fitted.parameters.size)))


def assert_predicted_shapes(done, target):
    """Assert that each period has a shape that ends at the target's depth, and the last one where the needle ended."""
    assert all(period.predicted is not None for period in done.periods)
    for period in done.periods[::10]:
        assert period.predicted.nodes[-1, X] == pytest.approx(target[0], abs=0.6)
        assert (period.predicted.sd[:, 0] > 0.0).any()
    last = done.periods[-1]
    assert np.abs(last.predicted.nodes[-1, 1:3] - last.estimate[1:3]).max() < 0.5
