"""A guide with clearance: an inequality, so that the needle bears on one wall, which pushes, or on none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.mechanics.model import Adaptation
from flexneedle.mechanics.solve import COUPLED_ITERATIONS
from reference.cases import repeat, tight

PHANTOM = load_scenario("phantom")
GUIDE_X = PHANTOM.setup.guide_x
EXACT = tight(PHANTOM)
TOLERANCE = 1e-9  # mm


def loose(clearance, **others):
    """The simulator of the phantom with a clearance (mm)."""
    return EXACT.with_model(EXACT.adapt(Adaptation(np.zeros(1), np.ones(2), clearance=clearance, **others)))


def off_centre(state):
    """Lateral position (mm) of the needle in the guide, from the guide's middle."""
    return float(state.mesh["y"][state.mesh["x"] == GUIDE_X][0]) - state.guide[0]


def wall(state):
    """The wall on which the needle bears: −1 or +1, 0 for none."""
    return state.needle.solution.last.guide.wall


def loaded(clearance, depth, guide, base_y=0.0, base_turn=0.0):
    """States of an insertion to a depth (mm), the guide moved by 0.1 mm a step as far as `guide` (mm) in tissue."""
    simulator = loose(clearance)
    start = simulator.start().with_estimate(base=(base_y, 0.0), slope=(base_turn, 0.0))
    states = [simulator.step(start, Control())]
    states += repeat(simulator, states[-1], Control(db_x=1.0), int(depth - PHANTOM.setup.start_tip_x))
    steps = int(np.ceil(abs(guide) / 0.1))
    return states + repeat(simulator, states[-1], Control(dg_y=guide / max(steps, 1)), steps)


def test_the_clearance_of_a_scenario_is_in_its_model_and_stays_with_other_changes():
    scenario = PHANTOM.with_values({"setup.guide_clearance_mm": 0.05})
    simulator = Simulator(scenario)
    same = Adaptation(np.zeros(1), np.ones(2))
    assert simulator.model.clearance == simulator.adapt(same).clearance == 0.05
    assert simulator.adapt(same._replace(clearance=0.1)).clearance == 0.1
    moved = [each.step(each.start(), Control(dg_y=0.04)).tip[1] for each in (simulator, Simulator(PHANTOM))]
    assert moved[0] == pytest.approx(0.0, abs=1e-9)
    assert moved[1] != pytest.approx(0.0, abs=1e-3)


# ---- in air, where the needle is straight until something touches it


@pytest.mark.parametrize("guide", [0.0, 0.049, -0.049])
def test_a_needle_free_within_the_clearance_bears_no_force(guide):
    state = loose(0.05).step(EXACT.start(), Control(dg_y=guide))
    np.testing.assert_allclose(state.nodes[:, 1], 0.0, atol=1e-12)
    assert state.reactions.guide_force == (0.0, 0.0)
    assert state.reactions.base_force == pytest.approx((0.0, 0.0), abs=1e-12)
    assert off_centre(state) == pytest.approx(-guide, abs=1e-12)


@pytest.mark.parametrize("side", [1, -1])
def test_beyond_the_clearance_one_wall_pushes(side):
    """It is where the wall is, and pushed as an exact guide that is moved less by the clearance would."""
    state = loose(0.05).step(EXACT.start(), Control(dg_y=0.3 * side))
    exact = EXACT.step(EXACT.start(), Control(dg_y=0.25 * side))
    assert off_centre(state) == pytest.approx(-0.05 * side, abs=1e-12)
    assert np.sign(state.reactions.guide_force[0]) == side
    assert state.reactions.guide_force == pytest.approx(exact.reactions.guide_force, rel=1e-9)
    np.testing.assert_allclose(state.tip, exact.tip, atol=1e-9)


def test_a_flip_takes_a_bent_needle_from_one_wall_to_the_other():
    simulator = loose(0.05, bend=1.0)
    state = simulator.step(simulator.start(), Control())
    rolled = simulator.step(state, Control(flip=True))
    assert state.converged
    assert rolled.converged
    assert off_centre(state) == pytest.approx(0.05)
    assert off_centre(rolled) == pytest.approx(-0.05)
    assert rolled.reactions.guide_force[0] == pytest.approx(-state.reactions.guide_force[0], rel=1e-9)


@settings(max_examples=15)
@given(
    clearance=st.floats(1e-3, 0.5), guide=st.floats(-0.5, 0.5),
    base_y=st.floats(-1.0, 1.0), base_turn=st.floats(-5e-3, 5e-3),
)  # fmt: skip
def test_between_the_walls_the_needle_takes_the_position_of_least_energy(clearance, guide, base_y, base_turn):
    """A guide without clearance prescribes each position."""
    start = EXACT.start().with_estimate(base=(base_y, 0.0), slope=(base_turn, 0.0))
    found = loose(clearance).step(start, Control(dg_y=guide))
    places = guide + clearance * np.linspace(-1.0, 1.0, 21)
    energies = [EXACT.step(start, Control(dg_y=place)).energy for place in places.clip(-0.5, 0.5)]
    assert found.energy <= min(energies) + 1e-12
    there = EXACT.replay(start, [Control(dg_y=guide + off_centre(found))])[0]
    assert found.energy == pytest.approx(there.energy, rel=1e-9, abs=1e-15)


# ---- in tissue


@settings(max_examples=12)
@given(
    clearance=st.floats(1e-3, 0.5), guide=st.floats(-3.0, 3.0), depth=st.integers(-20, 30),
    base_y=st.floats(-1.0, 1.0), base_turn=st.floats(-5e-3, 5e-3),
)  # fmt: skip
def test_force_and_gap_are_complementary(clearance, guide, depth, base_y, base_turn):
    """A wall only pushes, the needle is never beyond one, and where it touches none nothing pushes."""
    for state in loaded(clearance, depth, guide, base_y, base_turn):
        off, force = off_centre(state), state.reactions.guide_force[0]
        lower, upper = max(0.0, force), max(0.0, -force)  # of the lower wall upwards, and of the upper one
        assert abs(off) <= clearance + TOLERANCE
        assert lower * (clearance + off) == pytest.approx(0.0, abs=TOLERANCE)
        assert upper * (clearance - off) == pytest.approx(0.0, abs=TOLERANCE)
        assert state.converged


def test_rollouts_converge_and_equal_steps():
    """A guide that goes from wall to wall, rolls of the bevel, an uneven advance: bit for bit as in single steps."""
    rng = np.random.default_rng(4)
    advance, guide = rng.uniform(0.3, 1.0, (24, 60)), rng.uniform(-0.1, 0.1, (24, 60))
    roll = np.where(rng.random((24, 60)) < 0.05, np.pi, 0.0)
    rows = controls(24, 60, db_x=advance, dg_y=guide, roll=roll)
    simulator = loose(0.08)
    rolled = simulator.rollout(simulator.start(), rows)
    assert rolled.converged.all()
    walls = set()
    for sample in (0, 7, 23):
        state = simulator.start()
        for row, tip in zip(rows[sample], rolled.tips[sample], strict=True):
            state = simulator.step(state, Control.of(row))
            walls.add(np.sign(wall(state)))
            np.testing.assert_array_equal(state.tip, tip)
            assert state.iterations <= COUPLED_ITERATIONS
    assert walls == {-1.0, 0.0, 1.0}


@pytest.mark.parametrize("clearance", [0.0, 5e-324, 1e-12, 1e-4])
@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_a_clearance_however_small_is_solved(preset, clearance):
    """A needle that nothing bends touches its guide without force, on no side in particular."""
    scenario = load_scenario(preset).with_values({"needle.bevel.offset_mm": 0.0})
    simulator = Simulator(scenario)
    simulator = simulator.with_model(
        simulator.adapt(Adaptation(np.zeros(1), np.ones(2), clearance=clearance))
    )
    states = repeat(simulator, simulator.start(), Control(db_x=1.0), 40)
    moved = simulator.step(states[-1], Control(dg_y=clearance))
    assert all(state.converged for state in (*states, moved))
    assert np.abs(moved.nodes[:, 1:3]).max() <= 2.0 * clearance + 1e-9
