"""Needles and their readings for tests of observers."""

from dataclasses import replace

import numpy as np

import flexneedle
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Measurement, Motion
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom").with_values({"control.axial_scale_sd": 0.0})
QUIET = PHANTOM.with_values({"tracker.jitter_mm": 1e-3})
AHEAD = Control(db_x=1.0)


def start_with(scenario, **corrections):
    """A needle in air whose base differs from the model's."""
    simulator = Simulator(scenario)
    return simulator.step(simulator.start().with_estimate(**corrections), Control())


def begun(simulator, state=None, roll=0.0, **correction):
    """The estimate at the start, or at a state."""
    estimate = StateCorrection(**correction).begin(begun_with(simulator, roll))
    return estimate if state is None else replace(estimate, state=state, past=state, tips=state.tip[None])


def in_tissue(simulator, steps=40):
    """A needle that went straight in."""
    state = simulator.start()
    for _ in range(steps):
        state = simulator.step(state, Control(db_x=1.0))
    return state


def readings_between(before, after, start=0.0, count=4):
    """Exact readings of the tip during a period of one second."""
    parts = (np.arange(count) + 1) / count
    points = before.tip[:2] + parts[:, None] * (after.tip[:2] - before.tip[:2])
    return [
        Measurement(float(start + t), float(x), float(y)) for t, (x, y) in zip(parts, points, strict=True)
    ]


def follow(truth, estimate, plant, steps, *, noise=0.0, force=0.0, guide=0.0):
    """Advance plant and estimate together; return both and the innovations of each period."""
    rng = np.random.default_rng(0)
    command = AHEAD._replace(dg_y=guide)
    innovations = []
    for k in range(steps):
        before, truth = truth, plant.step(truth.with_estimate(tip_load=(force,)), command)
        readings = [replace(s, y=s.y + rng.normal(0.0, noise)) for s in readings_between(before, truth, k)]
        estimate = estimate.move(Motion(command, k, k + 1.0)).observe(readings)
        innovations.append(estimate.innovation)
    return truth, estimate, np.array(innovations)
