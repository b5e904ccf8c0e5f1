"""Cost terms of a user: listed in a scenario by name or as a function, evaluated by planner and controllers."""

import sys
from types import ModuleType

import numpy as np
import pytest

import flexneedle
from flexneedle.control.controllers import check_tables
from flexneedle.costs.terms import CE_MPC, PLAN
from flexneedle.costs.weighted_sum import Trajectories, evaluate_cost
from flexneedle.errors import InputError, ScenarioError
from flexneedle.types import DG_Y

# Without another test's warning (tests/scenario/test_old_weights.py).
SMALL = {"plan.samples": 32, "plan.iterations": 2, "plan.max_iterations": 2}


def guide_speed(trajectories):
    return np.abs(trajectories.controls[:, :, DG_Y]).sum(axis=1)


def depth_left(trajectories, target):
    return np.abs(target[0] - trajectories.tips[:, -1, 0])


@pytest.fixture
def module(monkeypatch):
    made = ModuleType("own_costs")
    monkeypatch.setitem(sys.modules, "own_costs", made)
    for function in (guide_speed, depth_left):
        setattr(made, function.__name__, function)
    return made


def with_terms(*terms, section="plan", **changes):
    listed = [{"term": term, "weight": weight} for term, weight in terms]
    return flexneedle.load_scenario("phantom").with_values({f"{section}.terms": listed} | SMALL | changes)


@pytest.mark.usefixtures("module")
def test_a_plan_charges_a_term_by_name_and_passes_the_target_to_one_that_takes_it():
    scenario = with_terms(("own_costs:guide_speed", 100.0), ("own_costs:depth_left", 0.1))
    plan = flexneedle.plan(scenario, threads=1)
    assert plan.terms.keys() >= {"own_costs:guide_speed", "own_costs:depth_left"}
    assert plan.cost == pytest.approx(sum(plan.terms.values()), rel=1e-6)
    free = flexneedle.plan(scenario.with_values({"plan.terms": None}), threads=1)
    assert np.abs(plan.controls[:, DG_Y]).sum() < np.abs(free.controls[:, DG_Y]).sum()
    assert "own_costs:guide_speed" not in free.terms


@pytest.mark.parametrize("section", ["plan", "control.ce_mpc", "control.adaptive_mpc"])
def test_a_function_is_recorded_by_its_name(module, monkeypatch, section):
    monkeypatch.setattr(module.guide_speed, "__module__", "own_costs")
    values = with_terms((module.guide_speed, 0.5), section=section).values()
    for key in section.split("."):
        values = values[key]
    assert values["terms"][0]["term"] == "own_costs:guide_speed"


@pytest.mark.usefixtures("module")
def test_controllers_charge_it_too():
    scenario = with_terms(("own_costs:guide_speed", 3.0), section="control.ce_mpc")
    settings = check_tables(scenario).control.tables["ce_mpc"]
    assert settings["terms"][0]["weight"] == 3.0
    names = [weight.name for _, weight in CE_MPC.rows()]
    assert names == ["zones", "deviation", "guide", "energy"]


@pytest.mark.parametrize(
    "wrong",
    [None, 3, lambda: 0.0, lambda a, target, other: a + target + other, lambda a, other: a + other],
    ids=["nothing", "a number", "no argument", "three arguments", "an unknown argument"],
)
def test_anything_but_a_function_of_trajectories_is_refused(module, wrong):
    module.wrong = wrong
    with pytest.raises(ScenarioError) as caught:
        with_terms(("own_costs:wrong", 1.0))
    assert caught.value.problems[0].startswith("plan.terms[0].term")


@pytest.mark.parametrize("name", ["guide_speed", "own_costs:none", "no_such_module:term"])
@pytest.mark.usefixtures("module")
def test_a_name_that_cannot_be_found_is_refused(name):
    with pytest.raises(ScenarioError) as caught:
        with_terms((name, 1.0))
    assert caught.value.problems[0].startswith("plan.terms[0].term")


def zero_controls(trajectories):
    trajectories.controls[:] = 1.0
    return trajectories.energy[:, 0]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda t: t.energy,
        lambda t: t.energy.sum(),
        lambda t: t.no_such_array,
        lambda t: t.energy[:, 0] * np.nan,
        zero_controls,
    ],
    ids=["another shape", "a number", "an error", "NaN", "changed arrays"],
)
def test_wrong_values_errors_and_changed_arrays_name_the_term(module, wrong):
    module.wrong = wrong
    settings = with_terms(("own_costs:wrong", 1.0)).plan
    arrays = np.zeros((2, 4, 9)), np.zeros((2, 4, 5)), np.zeros((2, 4)), np.ones((2, 4), dtype=bool)
    with pytest.raises(InputError, match="own_costs:wrong"):
        evaluate_cost(PLAN.terms(settings, target=(1.0, 0.0, 0.0))[-1:], Trajectories(*arrays))
