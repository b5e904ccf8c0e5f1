"""What the tests of the controllers share: a plan that is made quickly, its mirror image, estimates by hand."""

import math
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.estimation.identification import Identified
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_THETA, DB_Y, DG_Y, Control
from reference.cases import MIRROR
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom")


@pytest.fixture(scope="session")
def quick_plan():
    """A plan to (40, 5) that gets there, if not in the best way."""
    return flexneedle.plan(PHANTOM, (40.0, 5.0), seed=1, threads=1)


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
    """The state after so many steps of a plan, in a scenario of its own if one is given, then corrected."""

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
    monkeypatch.setattr(Identified, "_due_parameters", lambda self: iter(range(self.parameters.size)))
