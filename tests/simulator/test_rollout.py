"""Rollouts: the same bits as single steps, outputs by name, and a model and a state for each sequence."""

import numpy as np
import pytest

from flexneedle import Control, Simulator, load_scenario
from flexneedle.errors import InputError
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.batch import COLUMNS as OUTPUTS
from reference.cases import insert_to, numbers
from reference.draws import draw_controls

PHANTOM = load_scenario("phantom")


@pytest.fixture(scope="module")
def controls():
    """3 sequences of 60 random steps."""
    rng = np.random.default_rng(7)
    scenario = PHANTOM.with_values({"setup.stroke_mm": 69.0})
    return np.stack([draw_controls(scenario, 60, rng) for _ in range(3)])


def assert_outputs(found, k, state, scenario):
    """Assert that the outputs (m, …) of a rollout after step k are the outputs of a state, to rounding in space."""
    bending = scenario.needle.bending_stiffness
    moments = np.append(state.mesh["moment"], state.needle.solution.loads.moment)
    reactions = state.reactions
    np.testing.assert_array_equal(found["tips"][k], state.tip)
    assert found["converged"][k] == state.converged
    assert found["energy"][k] == state.strain_energy
    assert found["stretch"][k] == pytest.approx(state.contacts.stretch.min(initial=1.0), abs=1e-15)
    strain = np.abs(moments).max() / bending * 0.5 * scenario.needle.outer_diameter
    assert found["strain"][k] == pytest.approx(strain, rel=1e-14, abs=0.0)
    np.testing.assert_array_equal(found["shapes"][k], state.nodes)
    loads = [*reactions.base_force, *reactions.base_moment, *reactions.guide_force]
    np.testing.assert_array_equal(found["loads"][k], loads)


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_rollout_equals_repeated_steps_to_the_last_bit(preset):
    """All outputs of each step and of the last, energy weighted by layer, and the state at the end."""
    weights = {"tissue.0.energy_weight": 0.3, "tissue.1.energy_weight": 2.0}
    scenario = load_scenario(preset).with_values(weights)
    simulator, rng = Simulator(scenario), np.random.default_rng(7)
    rows = np.stack([draw_controls(scenario, 30, rng) for _ in range(9)])
    start = insert_to(simulator, 12.0)
    result = simulator.rollout(start, rows, outputs=OUTPUTS, ends=True)
    assert result.tips.shape == (9, 30, 5)
    assert result.converged.all()
    for j in (0, 5, 8):
        found, state = {name: array[j] for name, array in vars(result).items()}, start
        for k, row in enumerate(rows[j]):
            state = simulator.step(state, Control.of(row))
            assert_outputs(found, k, state, scenario)
        assert result.ends[j] == state
        assert result.ends[j].roll == state.roll
    assert result.energy[:, -1].min() > 0.0
    last = simulator.rollout(start, rows, at_end=OUTPUTS)
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(last, name), getattr(result, name)[:, -1:], err_msg=name)
    assert last.tips.tobytes() == result.tips.tobytes()
    assert last.ends == ()
    plain = simulator.rollout(start, rows)
    assert [name for name in OUTPUTS if getattr(plain, name).size] == []


def test_each_sequence_has_its_own_model_and_state():
    """As with a simulator each: tissue, bevel, bend and clearance, another needle, and starts at different depths."""
    stiff = Simulator(PHANTOM.with_values({"needle.gauge": "18G", "tissue.0.alpha": -4.0})).model
    changes = [
        Adaptation(np.array([shift]), np.array([1.4, 0.6]), bevel=1.2, bend=bend, clearance=loose)
        for shift, bend, loose in ((0.0, 0.0, 0.0), (2.5, 0.5, 0.0), (-1.0, -0.3, 0.1))
    ]
    simulator = Simulator(PHANTOM, threads=2)
    models = [simulator.model, stiff, *map(simulator.adapt, changes)] * 2
    states = [insert_to(simulator, depth) for depth in (-20.0, 2.0, 9.5, 10.0, 17.0)] + [
        simulator.start()
    ] * 5
    rows = np.stack([draw_controls(PHANTOM, 25, np.random.default_rng(k)) for k in range(10)])
    asked = {"outputs": OUTPUTS, "ends": True, "limits": False}
    together = simulator.rollout(states, rows, models=models, **asked)
    for k, (model, state) in enumerate(zip(models, states, strict=True)):
        alone = simulator.with_model(model).rollout(state, rows[k : k + 1], **asked)
        for name in ("tips", "converged", *OUTPUTS):
            assert getattr(alone, name)[0].tobytes() == getattr(together, name)[k].tobytes(), (k, name)
        assert alone.ends[0] == together.ends[k]
        assert together.ends[k].model is model
    one_state = simulator.rollout(states[2], rows, models=models, limits=False)
    one_model = simulator.rollout(states, rows, limits=False)
    assert one_state.tips[2].tobytes() == together.tips[2].tobytes()
    assert one_model.tips[5].tobytes() == together.tips[5].tobytes()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"states": 2}, "number of states = 2: must be 3, one for each sequence, or one state"),
        ({"models": 4}, "number of models = 4: must be 3, one for each sequence"),
        ({"outputs": ["tips"]}, "output = 'tips': must be one of energy, stretch, deflection, loads, "),
        ({"at_end": ["strain", "work"]}, "output = 'work': must be one of energy, "),
    ],
)
def test_what_does_not_fit_the_sequences_is_refused(asked, message):
    simulator = Simulator(PHANTOM)
    start, models = simulator.start(), [simulator.model] * asked.pop("models", 3)
    states = [start] * asked.pop("states", 3)
    with pytest.raises(InputError) as caught:
        simulator.rollout(states, np.zeros((3, 2, 9)), models=models, **asked)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_mean_square_deflection_agrees_with_the_nodes(controls):
    """∫y² dx/L against Simpson's rule on a fine needle state."""
    simulator = Simulator(PHANTOM.with_values({"needle.nodes": 2001}))
    start = insert_to(simulator, 12.0)
    plain = simulator.rollout(start, controls[:2])
    result = simulator.rollout(start, controls[:2], outputs=["deflection"])
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
    still = moved.rollout(moved.start(), np.zeros((1, 1, 9)), outputs=["deflection"])
    assert still.deflection[0, 0] < 1e-12
    own = moved.rollout(
        moved.start(), np.zeros((2, 1, 9)), outputs=["deflection"], axes=[[0.0, 0.0], [1.0, 0.0]]
    )
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
        each.rollout(each.start(), controls[:3, :30], outputs=["deflection"]) for each in (simulator, shifted)
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
