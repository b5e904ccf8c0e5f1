"""Bevel alone: full advance, no lateral motion, the bevel towards the target by its own settings."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control import bang_bang
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
BEVEL = CONTROLLERS["bevel-only"]


def command(plan, estimate, **settings):
    scenario = PHANTOM.with_values({f"control.bevel_only.{key}": value for key, value in settings.items()})
    task = task_of(Simulator(scenario, threads=1), plan, "bevel-only")
    decision, memory = BEVEL.decide(task, BEVEL.begin(task), estimate, np.random.default_rng(0))
    assert memory is None
    return decision.command


def aimed(plan, state, lateral, ahead=20.0):
    """The plan with a target at these distances (mm) ahead of a tip and off its line."""
    x, y, _, theta, _ = state.tip
    return replace(plan, target=(float(x) + ahead, float(y + ahead * np.tan(theta) + lateral), 0.0))


def test_it_advances_by_full_steps_and_moves_nothing_laterally(quick_plan, estimated, along):
    for steps in (0, 20, 50):
        given = command(quick_plan, estimated(along(quick_plan, steps)))
        assert given == Control(db_x=1.0, roll=given.roll)


@pytest.mark.parametrize("rolled", [False, True])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_bevel_rolls_to_the_target_in_tissue_and_stays_in_air(quick_plan, estimated, along, side, rolled):
    """The target is further from the tip's line than either path."""
    for steps, in_air in ((50, False), (5, True)):
        state = Simulator(PHANTOM).step(along(quick_plan, steps), Control(flip=rolled))
        right_way = state.bevel.real == side
        given = command(aimed(quick_plan, state, 2.0 * side), estimated(state))
        assert given.roll == (0.0 if right_way or in_air else math.pi)


def test_curvature_and_dead_band_are_its_own(quick_plan, estimated, along):
    """The target is off the line by a share of half the paths' separation, which the curvature sets."""
    state = along(quick_plan, 50)
    half = 0.5 * 10e-3 * 20.0**2
    estimate = estimated(state)
    for share, flips in ((1.3, False), (1.8, True)):
        away = aimed(quick_plan, state, -(share - 1.0) * half * state.bevel.real)
        assert (command(away, estimate, curvature_per_m=10.0, flip_dead_band=0.5).roll > 0.0) is flips
    away = aimed(quick_plan, state, -3.0 * state.bevel.real)
    assert command(away, estimate, curvature_per_m=10.0).roll == math.pi
    assert command(away, estimate, curvature_per_m=0.0).roll == 0.0  # both paths are the same line


def test_the_rule_gets_three_standard_deviations_of_a_reading(quick_plan, estimated, along, monkeypatch):
    calls, rule = [], bang_bang.choose_roll

    def spied(*args, **options):
        calls.append((*args[2:], options))
        return rule(*args, **options)

    monkeypatch.setattr(bang_bang, "choose_roll", spied)
    command(quick_plan, estimated(along(quick_plan, 50)), curvature_per_m=2.0, flip_dead_band=0.25)
    noise = pytest.approx(3 * 0.07 / 3**0.5)
    assert calls == [(pytest.approx(2e-3), quick_plan.target, 0.25, noise, {"within": None})]
