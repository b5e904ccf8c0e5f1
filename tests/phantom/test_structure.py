"""Structural mismatch: the effects of `[phantom.structure]` on the true phantom, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.errors import ScenarioError
from flexneedle.phantom.draw import draw
from flexneedle.phantom.phantom import Phantom
from phantoms import AHEAD, COARSE, both_plants, driven
from reference.rods import IDEAL

PHANTOM = load_scenario("phantom")
NO_GUIDE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
HIDDEN = {"top_mm": 18.0, "thickness_mm": 4.0, "modulus_factor": 5.0}
SHORTER = {f"tissue.{k}.compression_length_mm": pytest.approx(14.0) for k in (0, 1)}
KINDS = [
    ({"alpha": 3.5}, {"tissue.0.alpha": 3.5, "tissue.1.alpha": 3.5}),
    ({"compression_length_factor": 0.7}, SHORTER),
    ({"bevel_length_factor": 2.0}, {"needle.bevel.length_mm": 6.0}),
    ({"guide_shift_mm": 3.0}, {"setup.guide_to_skin_mm": 38.0}),
    ({"guide_shift_mm": -2.5}, {"setup.guide_to_skin_mm": 43.5}),
]


def structured(scenario=PHANTOM, **values):
    return scenario.with_values({f"phantom.structure.{key}": value for key, value in values.items()})


def truth_of(scenario, seed=0):
    return draw(scenario, np.random.default_rng(seed))


def modulus_at(scenario, depth):
    return scenario.tissue[np.searchsorted(scenario.layer_tops, depth, side="right") - 1].shear_modulus_kpa


@pytest.mark.parametrize(("structure", "expected"), KINDS)
def test_a_structural_change_does_not_change_other_draws(structure, expected):
    for seed in range(3):
        plain, changed = truth_of(PHANTOM, seed), truth_of(structured(**structure), seed)
        before, after = plain.scenario.flat(), changed.scenario.flat()
        assert {key: value for key, value in after.items() if before[key] != value} == expected
        assert changed.variation == plain.variation


@pytest.mark.parametrize(
    ("key", "field"),
    [("yield_mm", "yield_mm"), ("spring_back_mm", "spring_back"), ("modulus_drift", "modulus_drift")],
)
def test_a_change_of_the_plant_is_in_the_truth_beside_its_scenario(key, field):
    plain, changed = truth_of(PHANTOM), truth_of(structured(**{key: 0.4}))
    assert changed == replace(plain, **{field: 0.4})
    assert changed.scenario.phantom.structure == PHANTOM.phantom.structure


@given(
    top=st.floats(0.0, 60.0),
    thickness=st.floats(0.01, 30.0),
    factor=st.floats(0.1, 10.0),
    seed=st.integers(0, 50),
)
@hypothesis_settings(max_examples=40)
def test_a_hidden_layer_multiplies_the_modulus_inside_and_nowhere_else(top, thickness, factor, seed):
    hidden = {"top_mm": top, "thickness_mm": thickness, "modulus_factor": factor}
    plain = truth_of(PHANTOM, seed).scenario
    found = truth_of(structured(hidden_layer=hidden), seed).scenario
    edges = np.array([top, top + thickness, *plain.layer_tops])
    for depth in np.linspace(0.05, 80.0, 200):
        if np.abs(edges - depth).min() > 2e-3:
            expected = modulus_at(plain, depth) * (factor if top < depth < top + thickness else 1.0)
            assert modulus_at(found, depth) == pytest.approx(expected)
    assert np.abs(np.subtract.outer(found.layer_tops, plain.layer_tops)).min(axis=0).max() < 1e-9


@both_plants
def test_each_structural_change_moves_the_tip_of_both_plants(kind):
    ends = []
    for structure in ({}, *(structure for structure, _ in KINDS), {"hidden_layer": HIDDEN}):
        truth = truth_of(structured(IDEAL, **structure).with_values(COARSE))
        condition = driven(Phantom(truth, 0.0, kind), AHEAD, times=50).condition()
        assert condition.converged
        ends.append(condition.tip[1])
    assert np.abs(np.subtract(ends[1:], ends[0])).min() > 1e-3


def test_shorter_compression_lengths_bound_the_bevel_that_is_drawn():
    """b < 0.7 h of the phantom: with h = 7 mm at most 4.9 mm, in a range up to 6 mm."""
    scenario = structured(compression_length_factor=0.35)
    offsets = [truth_of(scenario, seed).scenario.needle.bevel.offset_mm for seed in range(100)]
    assert 4.7 < max(offsets) < 4.9


def test_the_start_error_is_at_most_half_of_the_distance_to_the_shifted_guide():
    scenario = structured(guide_shift_mm=11.5).with_values({"phantom.start_axial_sd_mm": 50.0})
    gaps = [truth_of(scenario, seed).scenario.setup.tip_to_skin_mm for seed in range(30)]
    assert max(gaps) == pytest.approx(28.5 + 0.5)


@pytest.mark.parametrize(
    ("scenario", "values", "problem"),
    [
        (PHANTOM, {"guide_shift_mm": 12.5}, "guide_shift_mm = 12.5: must be between -27.5 and 12.5"),
        (PHANTOM, {"guide_shift_mm": -27.5}, "guide_shift_mm = -27.5: must be between"),
        (PHANTOM, {"bevel_length_factor": 50.0}, "bevel_length_factor = 50.0: "),
        (PHANTOM, {"alpha": 0.0}, "alpha = 0.0: must not be 0"),
        (PHANTOM, {"yield_mm": 0.0}, "yield_mm = 0.0: must be above 0"),
        (PHANTOM, {"spring_back_mm": -0.1}, "spring_back_mm = -0.1: must be at least 0"),
        (PHANTOM, {"modulus_drift": -1.0}, "modulus_drift = -1.0: must be at least -0.9"),
        (PHANTOM, {"hidden_layer": {"top_mm": 3.0}}, "hidden_layer.thickness_mm: missing"),
        (PHANTOM, {"compression_factor": 2.0}, "compression_factor = 2.0: unknown key"),
        (NO_GUIDE, {"guide_shift_mm": 1.0}, "guide_shift_mm = 1.0: there is no guide"),
    ],
)
def test_an_invalid_structure_is_rejected(scenario, values, problem):
    with pytest.raises(ScenarioError) as caught:
        structured(scenario, **values)
    assert caught.value.problems[0].startswith(f"phantom.structure.{problem}")
