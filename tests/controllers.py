"""What the tests of the controllers share: a plan that is made quickly, its mirror image, estimates by hand."""

from dataclasses import replace

import pytest

import flexneedle
from flexneedle.estimation.identification import Identified
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom")


@pytest.fixture(scope="session")
def quick_plan():
    """A plan to (40, 5) that gets there, if not in the best way."""
    return flexneedle.plan(PHANTOM, (40.0, 5.0), seed=1, threads=1)


@pytest.fixture(scope="session")
def mirrored():
    """The mirror image of a plan: every lateral place, angle and the bevel with the other sign."""

    def mirror(plan):
        return replace(
            plan,
            target=(plan.target[0], -plan.target[1]),
            bevel=-plan.bevel,
            controls=plan.controls * [1.0, -1.0, -1.0, -1.0, 1.0],
            tips=plan.tips * [1.0, -1.0, -1.0],
            guide=-plan.guide,
            shapes=plan.shapes * [1.0, -1.0, -1.0],
        )

    return mirror


@pytest.fixture(scope="session")
def along():
    """The state after so many steps of a plan, in a scenario of its own if one is given, then corrected."""

    def go(plan, steps, scenario=PHANTOM, **corrections):
        simulator = Simulator(scenario, threads=1)
        state = simulator.start(plan.bevel)
        for row in plan.controls[:steps]:
            state = simulator.step(state, Control.from_row(row.tolist()))
        if corrections:
            state = simulator.step(state.with_estimate(**corrections), Control())
        return state

    return go


@pytest.fixture(scope="session")
def estimated():
    """An estimate of a state, with any of its other fields."""

    def estimate(state, **fields):
        return replace(
            StateCorrection().begin(begun_with(Simulator(state.scenario, threads=1), 1)),
            state=state,
            **fields,
        )

    return estimate


@pytest.fixture
def all_fresh(monkeypatch):
    """Every derivative simulated in every period."""
    monkeypatch.setattr(Identified, "_due", lambda self: iter(range(self.parameters.size)))
