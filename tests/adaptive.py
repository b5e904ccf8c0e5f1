"""Estimates and decisions of the default controller."""

from dataclasses import replace

import numpy as np

import flexneedle
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.path import path_of_plan
from flexneedle.estimation.identification import Identification
from flexneedle.simulator.simulator import Simulator
from tasks import begun_with, task_of

PHANTOM = flexneedle.load_scenario("phantom")
QUICK = PHANTOM.with_values(
    {
        f"control.adaptive_mpc.{key}": value
        for key, value in (("paths", 12), ("unguided_iterations", 1), ("effort", 1))
    }
)
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
ADAPTIVE = CONTROLLERS["adaptive-mpc"]


def estimate_of(state, scenario=PHANTOM, **fields):
    """An estimate of this state."""
    begun = Identification().begin(begun_with(Simulator(scenario, threads=1), state.roll))
    return replace(begun, state=replace(state, scenario=scenario), tips=state.tip[None], **fields)


def decided(plan, estimate, seed=0, path=None):
    """Decision and memory after it, with a current path that is the plan's unless another is given."""
    task = task_of(estimate.nominal, plan)
    begun, path = ADAPTIVE.begin(task), path or after(path_of_plan(plan), estimate.state.tip[0])
    memory = replace(begun, path=path, roll=estimate.state.roll)
    return ADAPTIVE.decide(task, memory, estimate, np.random.default_rng(seed))


def corrected(ahead, z):
    """The current path with the corrections of a sample (d,)."""
    return ahead.path_of(ahead.controls(z[None])[0][0])


def rolls_at(*depths):
    """Rolls (k, 2) of a path, by half a turn at each of these depths (mm)."""
    return np.column_stack([np.array(depths, dtype=float), np.pi * np.arange(1, len(depths) + 1)])


def unrolled(path):
    """The path without a roll."""
    return replace(path, rolls=rolls_at())


def after(path, x):
    """The path without the rolls that were made."""
    return replace(path, rolls=path.rolls[path.rolls[:, 0] > x])


def decide(plan, estimate, seed=0):
    return decided(plan, estimate, seed)[0]
