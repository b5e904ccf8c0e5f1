"""Simulators with estimated constants: a bent needle in closed form, other tissue, and replayed insertions."""

import math
import pickle

import numpy as np
import pytest

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.mechanics.model import Adaptation
from flexneedle.types import ROLL, THETA
from reference.cases import EI, FOUNDATION, LENGTH_MM, insert_to, long_beam, numbers, repeat, tight

PHANTOM = load_scenario("phantom")
SIMULATOR = Simulator(PHANTOM, threads=1)
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
STIFFNESS = PHANTOM.needle.bending_stiffness
LENGTH = PHANTOM.needle.length_mm


def adaptation(stiffness=(1.0, 1.0), shift=None, **others):
    """Return estimated constants of the tissue, by default without a displaced boundary."""
    still = np.zeros(len(stiffness) - 1)
    return Adaptation(still if shift is None else np.array(shift), np.array(stiffness), **others)


def adapted(simulator, estimated):
    """Return the simulator with estimated constants."""
    return simulator.with_model(simulator.adapt(estimated))


def bent(scenario, bend, roll=0.0):
    """Return the simulator of a needle with a natural bend, and the needle at the start."""
    simulator = adapted(tight(scenario, slide=1e-10), adaptation(bend=bend))
    return simulator, simulator.step(simulator.start(roll), Control())


# ---- natural bend


@pytest.mark.parametrize(("bend", "roll", "bevel"), [(0.5, 0.0, 1), (-1.2, math.pi, -1)])
def test_a_free_needle_is_an_arc_that_rolls_with_the_bevel(bend, roll, bevel):
    """y = ½κx², κ = 2w/L², in every node, unstrained; shortened by ½∫y'² = κ²L³/6."""
    _, state = bent(BARE, bend, roll)
    kappa = bevel * 2.0 * bend / LENGTH**2
    x = state.nodes[:, 0] - state.base[0]
    np.testing.assert_allclose(state.nodes[:, 1], 0.5 * kappa * x**2, atol=1e-11)
    np.testing.assert_allclose(state.nodes[:, THETA], kappa * x, atol=1e-13)
    assert state.tip[1] == pytest.approx(bevel * bend, rel=1e-3)
    assert LENGTH - x[-1] == pytest.approx(kappa**2 * LENGTH**3 / 6.0, rel=1e-3)
    assert state.energy == pytest.approx(0.0, abs=1e-15)
    assert state.reactions.base_force == pytest.approx((0.0, 0.0), abs=1e-13)
    assert state.converged


def test_a_guide_straightens_a_bent_needle():
    """Clamp and guide `a` apart: force −3EIκ/2a, slope κa/4 there, energy 3EIκ²a/8, and an arc beyond."""
    _, state = bent(PHANTOM, 0.8, math.pi)
    arm, over = -41.0 - state.base[0], state.tip[0] + 41.0
    kappa = -2.0 * 0.8 / LENGTH**2
    assert state.tip[1] == pytest.approx(kappa * arm * over / 4.0 + 0.5 * kappa * over**2, rel=1e-9)
    assert state.tip[THETA] == pytest.approx(kappa * arm / 4.0 + kappa * over, rel=1e-9)
    assert state.reactions.guide_force[0] == pytest.approx(-1.5 * STIFFNESS * kappa / arm, rel=1e-9)
    assert state.energy == pytest.approx(3.0 * STIFFNESS * kappa**2 * arm / 8.0, rel=1e-9)


def test_a_bent_end_in_tissue_is_the_beam_on_springs_with_an_end_moment():
    """y = 2EIκβ²/k and θ = κ/β at the free end (Hetényi 1946), second order in the spacing."""
    depth, beta, kappa = 160.0, 1 / LENGTH_MM, 1e-5
    errors = []
    for spacing in (2.0, 1.0, 0.5):
        scenario = long_beam(depth, spacing=spacing)
        simulator = Simulator(scenario, threads=1)
        state = simulator.step(simulator.start(), Control(db_x=depth + 1.0))
        length = scenario.needle.length_mm
        state = adapted(simulator, adaptation((1.0,), bend=0.5 * kappa * length**2)).step(state, Control())
        errors.append(
            [
                state.tip[1] / (2.0 * EI * kappa * beta**2 / FOUNDATION) - 1.0,
                state.tip[THETA] / (kappa / beta) - 1.0,
            ]
        )
    order = np.log2(np.abs(np.divide(errors[:-1], errors[1:])))
    assert np.abs(errors[-1]).max() < 3e-3
    assert order.min() > 1.7


# ---- tissue and bevel


FACTORS = (1.5, 0.6, 1.2, 0.4, 1.7, 0.9, 1.3, 0.8, 1.1)  # of cells of 4 mm, the last without a lower end
LAYERS = [PHANTOM.values()["tissue"][k >= 5] for k in range(9)]
CELLS = [
    layer
    | {"name": str(k), "thickness_mm": 4.0, "shear_modulus_kpa": layer["shear_modulus_kpa"] * FACTORS[k]}
    for k, layer in enumerate(LAYERS)
]
SAME = {  # boundaries displaced by whole intervals, so that the contact points are at the same depths
    "factors": (
        adaptation((1.7, 0.6), bevel=0.4),
        {
            "tissue.0.shear_modulus_kpa": 1.82 * 1.7,
            "tissue.1.shear_modulus_kpa": 3.63 * 0.6,
            "needle.bevel.offset_mm": 1.6,
        },
    ),
    "displaced boundary": (adaptation(shift=(-2.0,)), {"tissue.0.thickness_mm": 18.0}),
    "vanished layer": (adaptation((5.0, 1.0), (-30.0,)), {"tissue.0.shear_modulus_kpa": 3.63}),
    "cells": (adaptation(cell=4.0, variation=np.array(FACTORS)), {"tissue": CELLS}),
}


@pytest.mark.parametrize(("estimated", "changes"), SAME.values(), ids=SAME)
def test_estimated_constants_equal_another_scenario(estimated, changes):
    """An insertion to 39 mm with a roll and guide motion; in steps."""
    ends = []
    for simulator in (adapted(SIMULATOR, estimated), Simulator(PHANTOM.with_values(changes), threads=1)):
        state = insert_to(simulator, 37.0)
        for control in (Control(db_x=1.0, dg_y=0.3, flip=True), Control(db_x=0.4, dg_y=-0.2)):
            state = simulator.step(state, control)
        ends.append(repeat(simulator, state, Control(db_x=1.0), 2)[-1])
    np.testing.assert_allclose(ends[0].nodes, ends[1].nodes, atol=1e-9)
    np.testing.assert_allclose(ends[0].contacts.rest, ends[1].contacts.rest, atol=1e-9)
    assert ends[0].strain_energy == pytest.approx(ends[1].strain_energy, rel=1e-7)


# ---- replays


def rows_of(count):
    rng = np.random.default_rng(8)
    advance, guide = rng.uniform(0.3, 1.0, count), rng.uniform(-0.2, 0.25, count)
    return controls(count, db_x=advance, dg_y=guide, roll=np.where(rng.random(count) < 0.1, np.pi, 0.0))


@pytest.mark.parametrize("bend", [0.0, 0.5])
def test_a_replay_is_repeated_steps_bit_for_bit(bend):
    """From the start and from a state on the way."""
    rows = rows_of(80)
    assert (rows[:, ROLL] > 0).sum() > 3
    estimated = adaptation(
        (1.2, 0.7), (1.3,), cell=2.5, variation=np.linspace(0.5, 1.5, 12), bevel=1.4, bend=bend
    )
    simulator = adapted(SIMULATOR, estimated)
    state = SIMULATOR.start().with_estimate(base=(0.3, 0.0), slope=(-1e-3, 0.0))
    for first, last in ((0, 50), (50, 80)):
        after, tips = simulator.replay(state, rows[first:last])
        for k in range(first, last):
            state = simulator.step(state, Control.of(rows[k]))
            np.testing.assert_array_equal(tips[k - first], state.tip)
        assert after == state
        assert after.strain_energy == state.strain_energy
    assert state.tip[0] > 15.0


def test_a_replay_changes_neither_state_nor_controls():
    simulator = Simulator(PHANTOM, threads=1)
    state, rows = insert_to(simulator, 5.0), rows_of(10)
    before = numbers(state), state.rest.copy(), state.compression.copy(), rows.copy()
    one, _ = simulator.replay(state, rows)
    again, _ = simulator.replay(state, rows)
    assert one == again
    for kept, now in zip(before, (numbers(state), state.rest, state.compression, rows), strict=True):
        np.testing.assert_array_equal(kept, now)
    assert not one.rest.flags.writeable


def test_a_pickled_simulator_keeps_its_adaptation_and_threads():
    """After the threads were used; the simulator that was adapted is unchanged."""
    nominal = Simulator(PHANTOM, threads=2)
    before = insert_to(nominal, 10.0)
    simulator = adapted(nominal, adaptation((1.5, 0.5), (2.2,), bevel=1.3, bend=0.4))
    assert insert_to(nominal, 10.0) == before
    state = insert_to(simulator, 10.0)
    rows = np.tile(rows_of(30), (16, 1, 1))
    tips = simulator.rollout(state, rows).tips
    twin = pickle.loads(pickle.dumps(simulator))
    assert twin.threads == 2
    assert twin.scenario == simulator.scenario
    assert insert_to(twin, 10.0) == state
    np.testing.assert_array_equal(twin.rollout(state, rows).tips, tips)
    assert state.tip[1] != before.tip[1]
