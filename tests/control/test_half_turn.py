"""Half a turn in air, which separates a constant error of the tracker from the run-out."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from adaptive import ADAPTIVE, PHANTOM
from flexneedle.control.half_turn import DONE, may_turn, turn_in_air
from flexneedle.estimation.identification import Identification
from flexneedle.simulator.control import Limits, limit_half_turn
from flexneedle.simulator.simulator import Simulator
from synthetic import make_plan
from tasks import task_of

SPACE = PHANTOM.with_values({"setup.axes": 2})
BIASED = {"tracker.bias_sd_mm": 1.0, "phantom.tracker_bias_mm": 2.0}


@pytest.mark.parametrize("roll", [0.0, 2.0, -3.0])
@pytest.mark.parametrize(
    "changes", [{}, {"setup.max_rotation_deg": 180.0}, {"setup.rotation": "half-turns"}, {"setup.axes": 1}]
)
def test_the_needle_returns_and_keeps_its_limits(changes, roll):
    scenario = SPACE.with_values(changes)
    roll = 0.0 if scenario.setup.half_turns else roll
    plan = replace(make_plan("manipulation", (40.0, 1.0, 0.0), 0), scenario=scenario, roll=roll)
    task = task_of(Simulator(scenario, threads=1), plan)
    step, angle, steps = 0, roll, []
    while step < DONE:
        decision, step = turn_in_air(task, step, angle)
        Limits.of(scenario).check(np.zeros(7), np.array([decision.command]), angle)
        turn = decision.command.roll
        if scenario.setup.half_turns:
            angle += limit_half_turn(angle, turn)
        elif steps:  # the first is not carried out
            angle += turn
        steps.append(decision)
    turns = [abs(one.command.roll) for one in steps if one.command.roll]
    assert turns == pytest.approx([math.pi] * (2 if scenario.setup.half_turns else 3))
    assert angle == pytest.approx(roll)
    assert sum(one.rest > 0.0 for one in steps) == 2


def test_the_error_of_the_tracker_is_known_before_the_needle_advances():
    scenario = flexneedle.load_scenario("phantom3d").with_values(BIASED)
    decided = []
    insertion = flexneedle.insert(
        scenario,
        flexneedle.plan(scenario, seed=0),
        seed=1,
        listeners=[lambda event: decided.append(event) if isinstance(event, flexneedle.Decided) else None],
    )
    rolls = [period.applied.roll for period in insertion.periods[:3]]
    assert sorted(np.abs(rolls)) == pytest.approx([0.0, math.pi, math.pi])
    first = decided[4].estimate
    sds = np.sqrt(np.diag(first.covariance))
    assert sds[first.slots.bias].max() < 0.15
    assert insertion.true_error_mm < 0.3


def test_a_turn_that_ends_a_little_short_is_done():
    task = task_of(
        Simulator(SPACE, threads=1), replace(make_plan("manipulation", (40.0, 1.0, 0.0), 0), scenario=SPACE)
    )
    step, angle, rolls = 0, 0.0, 0
    while step < DONE:
        decision, step = turn_in_air(task, step, angle)
        angle += 0.99 * decision.command.roll
        rolls += decision.command.roll != 0.0
    assert rolls == 2


def test_without_a_tracker_there_is_none():
    changes = {
        "tracker.bias_sd_mm": 1.0,
        "tracker.enabled": False,
        "sensor": [{"kind": "fbg", "sites_mm": [20.0]}],
    }
    scenario = SPACE.with_values(changes)
    plan = replace(make_plan("manipulation", (40.0, 1.0, 0.0), 0), scenario=scenario)
    task = task_of(Simulator(scenario, threads=1), plan)
    assert not may_turn(task, Identification().begin(task))


def test_a_tracker_without_a_constant_error_needs_none():
    plan = replace(make_plan("manipulation", (40.0, 1.0, 0.0), 0), scenario=SPACE)
    task = task_of(Simulator(SPACE, threads=1), plan)
    decision, memory = ADAPTIVE.decide(
        task, ADAPTIVE.begin(task), Identification().begin(task), np.random.default_rng(0)
    )
    assert decision.command.roll == 0.0
    assert memory.turns == 0
