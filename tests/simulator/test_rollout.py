"""Rollouts: the same bits as single steps, for any number of threads."""

from dataclasses import astuple

import numpy as np
import pytest

from flexneedle import Control, Simulator, load_scenario
from reference.cases import insert_to, numbers
from reference.draws import draw_controls

PHANTOM = load_scenario("phantom")


@pytest.fixture(scope="module")
def controls():
    """24 sequences of 60 random steps."""
    rng = np.random.default_rng(7)
    scenario = PHANTOM.with_values({"setup.stroke_mm": 69.0})
    return np.stack([draw_controls(scenario, 60, rng) for _ in range(24)])


def test_rollout_equals_repeated_steps_to_the_last_bit(controls):
    """Tips, strain energy weighted by layer, and convergence, from a state in the tissue."""
    simulator = Simulator(PHANTOM.with_values({"tissue.0.energy_weight": 0.3, "tissue.1.energy_weight": 2.0}))
    start = insert_to(simulator, 12.0)
    result = simulator.rollout(start, controls)
    assert result.tips.shape == (24, 60, 5)
    assert result.energy.shape == result.converged.shape == (24, 60)
    for j in range(0, 24, 7):
        state = start
        for k, row in enumerate(controls[j]):
            state = simulator.step(state, Control.of(row))
            assert state.tip.tobytes() == result.tips[j, k].tobytes()
            assert state.converged == result.converged[j, k]
            assert state.strain_energy == result.energy[j, k]
    assert result.energy[:, -1].min() > 0.0


def test_bytes_do_not_depend_on_the_number_of_threads(controls):
    """1, 2 and 3 threads, and one sequence at a time."""
    results = []
    for threads in (1, 2, 3):
        simulator = Simulator(PHANTOM, threads=threads)
        results.append(astuple(simulator.rollout(insert_to(simulator, 12.0), controls)))
    simulator = Simulator(PHANTOM, threads=1)
    single = [astuple(simulator.rollout(insert_to(simulator, 12.0), row[None])) for row in controls]
    results.append(tuple(np.concatenate(arrays) for arrays in zip(*single, strict=True)))
    for result in results[1:]:
        for array, first in zip(result, results[0], strict=True):
            assert array.tobytes() == first.tobytes()


def test_mean_square_deflection_agrees_with_the_nodes(controls):
    """∫y² dx/L against Simpson's rule on a fine needle state."""
    simulator = Simulator(PHANTOM.with_values({"needle.nodes": 2001}))
    start = insert_to(simulator, 12.0)
    plain = simulator.rollout(start, controls[:2])
    result = simulator.rollout(start, controls[:2], deflection=True)
    assert plain.tips.tobytes() == result.tips.tobytes()
    assert plain.deflection.size == 0
    for j in range(2):
        state = start
        for row in controls[j]:
            state = simulator.step(state, Control.of(row))
        x, y, *_ = state.nodes.T
        mean = np.trapezoid(y**2, x) / 150.0
        assert result.deflection[j, -1] == pytest.approx(mean, rel=1e-5)


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_the_deflection_counts_from_the_axis_of_the_entry(preset, controls):
    """Moved and tilted with the entry, and from a given line; a straight needle has none from its axis."""
    simulator = Simulator(preset)
    values = {"entry.lateral_mm": -4.0, "entry.slope_mrad": 30.0}
    if preset == "phantom3d":
        values |= {"entry.lateral_z_mm": 7.0, "entry.slope_z_mrad": -20.0}
    moved = Simulator(load_scenario(preset).with_values(values | {"setup.stroke_mm": 69.0}))
    still = moved.rollout(moved.start(), np.zeros((1, 1, 9)), deflection=True)
    assert still.deflection[0, 0] < 1e-12
    own = moved.rollout(moved.start(), np.zeros((2, 1, 9)), deflection=True, axes=[[0.0, 0.0], [1.0, 0.0]])
    x = np.linspace(moved.start().base[0], moved.start().tip[0], 2001)
    y = np.array([moved.scenario.entry.lateral(each) for each in x])
    y = y.real if preset == "phantom" else y
    for found, line in zip(own.deflection[:, 0], (y, y - 1.0), strict=True):
        assert found == pytest.approx(np.trapezoid(np.abs(line) ** 2, x) / 150.0, rel=1e-6)
    if preset == "phantom":
        return
    # Without tissue forces that depend on the place, an entry that is only moved has the same deflections.
    shifted = Simulator(
        load_scenario(preset).with_values({"entry.lateral_mm": -4.0, "entry.lateral_z_mm": 7.0})
    )
    here, there = (
        each.rollout(each.start(), controls[:3, :30], deflection=True) for each in (simulator, shifted)
    )
    np.testing.assert_allclose(there.deflection, here.deflection, rtol=1e-6, atol=1e-9)


def test_empty_and_single_batches():
    """No sequence, no step, one step."""
    simulator = Simulator(PHANTOM)
    state = simulator.start()
    assert simulator.rollout(state, np.zeros((0, 5, 9))).tips.shape == (0, 5, 5)
    assert simulator.rollout(state, np.zeros((3, 0, 9))).tips.shape == (3, 0, 5)
    control = Control(db_x=1.0, dg_y=0.1)
    one = simulator.rollout(state, [[control]])
    np.testing.assert_array_equal(one.tips[0, 0], simulator.step(state, control).tip)


def test_rollout_leaves_its_inputs_alone(controls):
    """Neither the state nor the controls change; lists and read-only arrays are accepted."""
    simulator = Simulator(PHANTOM)
    state = insert_to(simulator, 12.0)
    before, kept = (numbers(state).tobytes(), state.rest.tobytes(), state.mesh.tobytes()), controls.copy()
    frozen = controls[:3].copy()
    frozen.flags.writeable = False
    simulator.rollout(state, frozen)
    simulator.rollout(state, frozen.tolist())
    assert before == (numbers(state).tobytes(), state.rest.tobytes(), state.mesh.tobytes())
    np.testing.assert_array_equal(frozen, kept[:3])
