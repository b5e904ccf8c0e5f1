"""The virtual phantom: drawn by a seed alone, stepped more finely than the model, with a clock of its own."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.errors import CommandError
from flexneedle.phantom import Phantom, draw
from flexneedle.phantom.phantom import Truth
from flexneedle.simulator import Control, Simulator

PHANTOM = load_scenario("phantom")
AHEAD = (1.0, 0.0, 0.0, 0.1, -1)


def drawn(seed, scenario=PHANTOM):
    return draw(scenario, np.random.default_rng(seed))


def factors(truth):
    """Stiffness of each layer and bevel, relative to the scenario."""
    layers = [
        true.shear_modulus_kpa / told.shear_modulus_kpa
        for true, told in zip(truth.scenario.tissue, PHANTOM.tissue, strict=True)
    ]
    return [*layers, truth.scenario.needle.bevel.offset_mm / PHANTOM.needle.bevel.offset_mm]


@given(seed=st.integers(0, 2**63))
@hypothesis_settings(deadline=None, derandomize=True, max_examples=50)
def test_draw_is_within_its_ranges_and_changes_nothing_else(seed):
    truth = drawn(seed)
    *layers, bevel = factors(truth)
    assert all(0.6 <= factor <= 1.6 for factor in layers)
    assert 0.5 <= bevel <= 1.5
    changed = {key for key, value in truth.scenario.flat().items() if PHANTOM.flat()[key] != value}
    expected = {f"tissue.{k}.shear_modulus_kpa" for k in (0, 1)}
    assert changed <= expected | {"needle.bevel.offset_mm", "contact.spacing_mm"}
    assert truth.scenario.contact.spacing_mm == PHANTOM.phantom.contact_spacing_mm == 0.5


def test_draws_are_uniform_and_normal_as_the_scenario_says():
    truths = [drawn(seed) for seed in range(800)]
    layers = np.array([factors(truth) for truth in truths])
    np.testing.assert_allclose(layers.mean(axis=0), [1.1, 1.1, 1.0], atol=0.05)
    np.testing.assert_allclose(layers.std(axis=0), np.array([1.0, 1.0, 1.0]) / np.sqrt(12), rtol=0.1)
    assert np.abs(np.corrcoef(layers.T) - np.eye(3)).max() < 0.15  # each on its own
    start = np.array([(truth.base_y, truth.base_turn) for truth in truths])
    np.testing.assert_allclose(start.mean(axis=0) / (0.5, 0.003), 0.0, atol=0.15)
    np.testing.assert_allclose(start.std(axis=0), (0.5, 0.003), rtol=0.1)


def test_draw_depends_on_the_seed_alone():
    assert drawn(7) == drawn(7)
    assert drawn(7) != drawn(8)


def test_a_phantom_without_spread_is_the_model_but_for_its_mesh():
    certain = {
        "phantom.shear_modulus_factor": [1.0, 1.0], "phantom.bevel_factor": [1.0, 1.0],
        "phantom.start_offset_sd_mm": 0.0, "phantom.start_angle_sd_mrad": 0.0,
        "phantom.contact_spacing_mm": 1.0,
    }  # fmt: skip
    scenario = PHANTOM.with_values(certain)
    assert drawn(0, scenario) == Truth(scenario, 0.0, 0.0)


def test_the_needle_starts_where_the_clamp_really_holds_it():
    truth = Truth(PHANTOM, 0.4, -0.002)
    phantom = Phantom(truth, -1)
    np.testing.assert_allclose(phantom.state.base[1:], [0.4, -0.002])
    assert phantom.state.bevel == -1
    simulator = Simulator(PHANTOM)
    expected = simulator.step(simulator.start(-1).believing(base_y=0.4, base_turn=-0.002), Control())
    np.testing.assert_allclose(phantom.state.tip, expected.tip)
    assert abs(phantom.state.tip[1]) > 0.01
    assert phantom.now() == 0.0


def test_a_command_is_carried_out_in_finer_steps():
    """1 mm in steps of 0.25: four equal parts, and the bevel turns once."""
    phantom = Phantom(Truth(PHANTOM, 0.0, 0.0), 1)
    simulator = Simulator(PHANTOM)
    state = simulator.start()
    for _ in range(32):
        assert phantom.apply((*AHEAD[:4], 1), 0.2) == (*AHEAD[:4], 1)
        for part in range(4):
            state = simulator.step(state, Control(0.25, dg_y=0.025, flip=part == 0))
    np.testing.assert_array_equal(phantom.state.scalars, state.scalars)


@pytest.mark.parametrize(
    ("advance", "parts"), [(0.0, 1), (0.25, 1), (0.26, 2), (0.75, 3), (1.0, 4), (-1.0, 4)]
)
def test_parts_are_no_longer_than_the_step_of_the_phantom(advance, parts):
    phantom = Phantom(Truth(PHANTOM, 0.0, 0.0), 1)
    phantom.apply((1.0, 0.0, 0.0, 0.0, -1), 0.2)
    seen = []
    inner = phantom._simulator
    counted = {"step": lambda _, *args: seen.append(1) or inner.step(*args), "check": inner.check}
    phantom._simulator = type("Counted", (), counted)()
    phantom.apply((advance, 0.0, 0.0, 0.0, -1), 0.2)
    assert len(seen) == parts


def test_all_inputs_of_a_command_arrive():
    phantom = Phantom(Truth(PHANTOM, 0.1, 0.001), 1)
    phantom.apply((0.9, 0.2, 0.002, 0.3, 1), 0.2)
    np.testing.assert_allclose(phantom.state.base, [PHANTOM.start_base_x + 0.9, 0.3, 0.003])
    assert phantom.state.guide == pytest.approx(0.3)
    assert phantom.state.bevel == -1


def test_time_passes_by_commands_and_waits():
    phantom = Phantom(Truth(PHANTOM, 0.0, 0.0), 1)
    phantom.apply(AHEAD, 0.2)
    phantom.wait(0.025)
    assert phantom.now() == pytest.approx(0.225)


def test_tip_is_told_at_any_time_of_the_last_command():
    phantom = Phantom(Truth(PHANTOM, 0.0, 0.0), 1)
    tips = [phantom.state.tip[:2]]
    for _ in range(2):
        phantom.apply((0.5, 0.0, 0.0, 0.25, -1), 0.2)
        tips.append(phantom.state.tip[:2])
    np.testing.assert_allclose(phantom.tip_at(0.2), tips[1], atol=1e-12)
    np.testing.assert_allclose(phantom.tip_at(0.4), tips[2], atol=1e-12)
    middle = phantom.tip_at(0.3)  # between the two parts of the command
    assert middle[0] == pytest.approx((tips[1][0] + tips[2][0]) / 2, abs=1e-3)
    quarter = phantom.tip_at(0.25)
    np.testing.assert_allclose(quarter, (np.array(phantom.tip_at(0.2)) + middle) / 2, atol=1e-12)
    assert tips[1][0] < quarter[0] < middle[0] < tips[2][0]


def test_while_it_waits_the_tip_stays():
    phantom = Phantom(Truth(PHANTOM, 0.0, 0.0), 1)
    phantom.apply(AHEAD, 0.2)
    before = phantom.state
    phantom.wait(0.5)
    for time in (0.2, 0.45, 0.7):
        np.testing.assert_allclose(phantom.tip_at(time), before.tip[:2], atol=1e-12)
    assert phantom.state == before


def test_a_clamp_that_is_off_by_more_than_the_base_may_travel_is_drawn_all_the_same():
    tight = PHANTOM.with_values({"setup.max_base_travel_mm": 0.1})
    phantom = Phantom(Truth(tight, 0.4, 0.001), 1)
    phantom.apply(AHEAD, 0.2)
    np.testing.assert_allclose(phantom.state.base[1:], [0.4, 0.001])


def test_a_strong_bevel_is_drawn_within_the_rules():
    """12 mm × 1.5 would break b < 0.7 h = 14: drawn from the part of the range that doesn't, evenly."""
    strong = PHANTOM.with_values({"needle.bevel.offset_mm": 12.0})
    offsets = [drawn(seed, strong).scenario.needle.bevel.offset_mm for seed in range(300)]
    assert 0.5 * 12.0 <= min(offsets) < 6.2
    assert 13.7 < max(offsets) < 14.0
    assert np.mean(offsets) == pytest.approx(10.0, abs=0.5)
    symmetric = PHANTOM.with_values({"needle.bevel.offset_mm": 0.0})
    assert drawn(0, symmetric).scenario.needle.bevel.offset_mm == 0.0


def test_a_command_beyond_a_step_is_refused_before_it_is_divided():
    phantom = Phantom(draw(PHANTOM, np.random.default_rng(3)), 1)
    with pytest.raises(CommandError, match=r"db_x = 2: must be at most 1 mm"):
        phantom.apply((2.0, 0.0, 0.0, 0.0, -1), 0.4)
    assert phantom.now() == 0.0
