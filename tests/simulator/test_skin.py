"""Below the skin a free needle is held by little but its tip: cuts there are resolved for any step."""

import numpy as np
import pytest

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.mechanics import model
from flexneedle.scenario.worlds import world
from flexneedle.types import DG_Y, THETA, X, Y
from reference.cases import numbers, tight

PHANTOM = load_scenario("phantom")
# Thin needles, with and without a guide: worlds, and how far (mm) steps and spacings of 1 mm may be off.
THIN = {26: 0.03, 31: 0.065, 37: 0.05}


def end(scenario, step):
    """Lateral position (mm) of the tip at the target's depth, in even steps, its guide moved by 2 mm in air."""
    simulator = Simulator(scenario, threads=1)
    gap, way = scenario.setup.tip_to_skin_mm, scenario.setup.tip_to_skin_mm + scenario.target.depth_mm
    count = int(np.ceil(way / step))
    rows = controls(count, db_x=way / count)
    if scenario.setup.has_guide:
        in_air = max(1, int(gap * count / way))
        rows[:in_air, DG_Y] = 2.0 / in_air
    return float(simulator.replay(simulator.start(), rows)[1][-1, 1])


def refined(scenario, length):
    """Steps and spacing of one length (mm)."""
    return end(scenario.with_values({"contact.spacing_mm": length}), length)


@pytest.mark.parametrize("number", THIN)
def test_halving_steps_and_spacing_converges(number):
    scenario = world(number, "perfect")
    fine = refined(scenario, 0.125)
    error = np.abs([refined(scenario, length) - fine for length in (2.0, 1.0, 0.5, 0.25)])
    assert error[1] < THIN[number]
    assert (error[:-1] / error[1:] > 1.5).all()


@pytest.mark.parametrize("number", THIN)
def test_even_intervals_and_whole_steps_would_be_far_off(number, monkeypatch):
    """The error is several times larger than with the finer resolution below the skin."""
    scenario = world(number, "perfect")
    fine, resolved = refined(scenario, 0.125), refined(scenario, 1.0)
    monkeypatch.setattr(model, "_SKIN_EDGES", ())
    monkeypatch.setattr(model, "SKIN_ZONE", 0.0)
    assert abs(refined(scenario, 1.0) - fine) > max(0.1, 4.0 * abs(resolved - fine))


def at(simulator, state, x):
    """The needle pushed until its tip is at x (mm)."""
    for _ in range(3):
        state = simulator.replay(state, [Control(db_x=x - state.tip[0])])[0]
    return state


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("before", [-2.5, -0.1, 0.0, 0.6, 2.6])
def test_the_state_is_continuous_in_the_command(before, flip):
    """From anywhere about the skin, under a side load, a command that is 1 µm longer each time, up to 1 mm.

    How far the tip gets may change its slope where a part or the skin is reached, but never jump and come back to it.
    """
    simulator = tight(world(37, "perfect"))  # 0.02 µm is less than a solve's slide
    loaded = simulator.replay(simulator.start(), [Control(dg_y=2.0)])[0]
    rows = controls(1001, 1, db_x=np.arange(1001)[:, None] * 1e-3, roll=np.pi * flip)
    change = np.diff(simulator.rollout(at(simulator, loaded, before), rows).tips[:, 0], axis=0)[
        :, [X, Y, THETA]
    ]
    beside = np.stack([change[:-2], change[2:]])
    out = np.maximum(change[1:-1] - beside.max(axis=0), beside.min(axis=0) - change[1:-1])
    assert (out.max(axis=0) < 0.02 * np.abs(change).max(axis=0)).all()


def test_a_step_below_the_skin_equals_its_parts():
    """One command of 1 mm from a part's end: the same as four of a quarter, the bevel rolled before the first."""
    simulator = Simulator(PHANTOM, threads=1)
    state = at(simulator, simulator.replay(simulator.start(), [Control(db_x=28.0, dg_y=0.3)])[0], 0.5)
    assert state.tip[0] == pytest.approx(0.5, abs=1e-6)
    whole = simulator.step(state, Control(db_x=1.0, dg_y=0.4, flip=True))
    parts = simulator.step(state, Control(db_x=0.25, dg_y=0.1, flip=True))
    for _ in range(3):
        parts = simulator.step(parts, Control(db_x=0.25, dg_y=0.1))
    np.testing.assert_allclose(whole.tip, parts.tip, atol=1e-4)
    np.testing.assert_allclose(whole.contacts.rest, parts.contacts.rest, atol=1e-4)
    assert whole.bevel == -1


@pytest.mark.parametrize("command", [Control(db_x=-1.0), Control(dg_y=0.3), Control()])
def test_a_step_that_cuts_nothing_is_not_divided(command):
    """Pulling back, or moving the guide alone."""
    simulator = Simulator(PHANTOM, threads=1)
    state = simulator.replay(simulator.start(), [Control(db_x=30.0, dg_y=0.3)])[0]
    undivided = Simulator(PHANTOM, threads=1, constants=simulator.model._replace(zone=-1.0))
    here, there = simulator.step(state, command), undivided.step(state, command)
    np.testing.assert_array_equal(numbers(here), numbers(there))
