"""The true phantom: drawn with a seed, each key of `[phantom]` independent of the others."""

import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.phantom.draw import Truth, draw
from flexneedle.scenario.worlds import world
from reference.rods import IDEAL

PHANTOM = load_scenario("phantom")
SPACE = PHANTOM.with_values({"setup.axes": 2})
MANY = 1000
PLANAR = ("base_y", "base_turn", "bend", "run_out", "bias", "variation")
OUT = ("base_z", "base_psi", "bend_angle", "run_out_angle")
# Keys of [phantom]: another value, and the values of the true phantom that may change.
CHANGED = {
    "tracker_drift_mm": (1.0, {"drift"}),
    "tracker_lost_mm": (10.0, set()),
    "shear_modulus_factor": ([1.2, 3.2], {"layers"}),
    "shear_modulus_variation": (0.4, {"variation"}),
    "variation_length_mm": (20.0, {"variation"}),
    "layer_shift_sd_mm": (3.0, {"boundaries"}),
    "bevel_factor": ([1.0, 3.0], {"bevel"}),
    "start_offset_sd_mm": (1.0, {"base_y"}),
    "start_angle_sd_mrad": (6.0, {"base_turn"}),
    "start_offset_z_sd_mm": (0.5, {"base_z"}),
    "start_angle_z_sd_mrad": (3.0, {"base_psi"}),
    "start_axial_sd_mm": (2.0, {"start"}),
    "youngs_modulus_variation": (0.1, {"modulus"}),
    "initial_bend_mm": (1.0, {"bend"}),
    "run_out_mm": (0.4, {"run_out"}),
    "direction_spread_deg": (90.0, {"bend_angle", "run_out_angle"}),
    "tracker_bias_mm": (0.3, {"bias"}),
    **{key: (value, set()) for key, value in (
        ("guide_clearance_mm", 0.1), ("friction_mn_per_mm", 10.0), ("rotation_friction_mn", 5.0),
        ("motor_resolution_mm", 0.02), ("delay_periods", 2.0), ("missing_fraction", 0.02),
        ("element_mm", 1.0), ("step_mm", 0.5),
    )},
}  # fmt: skip


def drawn(seed, scenario=PHANTOM):
    return draw(scenario, np.random.default_rng(seed))


def axial_error(truth, scenario=PHANTOM):
    """Return the axial start error (mm) of base and tip, relative to the scenario."""
    return scenario.setup.tip_to_skin_mm - truth.scenario.setup.tip_to_skin_mm


def entries(truth):
    """Return the drawn values by name; moduli and bevel as factors."""
    needle, layers = truth.scenario.needle, zip(truth.scenario.tissue, PHANTOM.tissue, strict=True)
    return {
        "layers": [true.shear_modulus_kpa / nominal.shear_modulus_kpa for true, nominal in layers],
        "boundaries": truth.scenario.layer_tops,
        "bevel": needle.bevel.offset_mm / PHANTOM.needle.bevel.offset_mm,
        "start": axial_error(truth),
        "modulus": needle.youngs_modulus_gpa / PHANTOM.needle.youngs_modulus_gpa,
        **{name: getattr(truth, name) for name in (*PLANAR, *OUT, "drift")},
    }


def changes(one, other):
    """Return the names of the values that differ between two phantoms."""
    one, other = entries(one), entries(other)
    return {name for name in one if one[name] != other[name]}


def assert_independent(values, atol):
    """Assert that columns (n, k) of draws are not correlated."""
    assert np.abs(np.corrcoef(np.transpose(values)) - np.eye(np.shape(values)[1])).max() < atol


@pytest.fixture(scope="module")
def many():
    """A thousand phantoms in the plane and in space, with a tracker bias of 0.3 mm."""
    biased = {"phantom.tracker_bias_mm": 0.3}
    return {
        axes: [drawn(seed, scenario.with_values(biased)) for seed in range(MANY)]
        for axes, scenario in ((1, PHANTOM), (2, SPACE))
    }


# ---- distributions


@given(seed=st.integers(0, 2**63))
@hypothesis_settings(max_examples=25)
def test_a_draw_is_within_its_ranges_and_leaves_other_values_unchanged(seed):
    truth = drawn(seed)
    found = entries(truth)
    assert all(0.6 <= factor <= 1.6 for factor in found["layers"])
    assert 0.5 <= found["bevel"] <= 1.5
    assert 0.95 <= found["modulus"] <= 1.05
    # The run-out is on either side of the axis: the tip moves by 0.2 mm when the bevel rolls.
    assert (abs(found["bend"]), abs(found["run_out"])) == (0.5, 0.1)
    assert found["bias"] == (0.0, 0.0, 0.0)
    assert [found[name] for name in OUT] == [0.0] * 4
    changed = {key for key, value in truth.scenario.flat().items() if PHANTOM.flat()[key] != value}
    expected = {f"tissue.{k}.shear_modulus_kpa" for k in (0, 1)} | {"tissue.0.thickness_mm"}
    expected |= {"needle.youngs_modulus_gpa", "setup.tip_to_skin_mm"}
    assert changed == expected | {"needle.bevel.offset_mm", "contact.spacing_mm"}
    assert truth.scenario.contact.spacing_mm == PHANTOM.phantom.contact_spacing_mm == 0.5


def test_factors_are_uniform(many):
    """Each layer, the bevel and the modulus (× 10), independently; mean, sd and range."""
    found = [entries(truth) for truth in many[1]]
    found = np.array([[*each["layers"], each["bevel"], 10.0 * each["modulus"]] for each in found])
    np.testing.assert_allclose(found.mean(axis=0), [1.1, 1.1, 1.0, 10.0], atol=0.03)
    np.testing.assert_allclose(found.std(axis=0), 1.0 / math.sqrt(12), rtol=0.06)
    np.testing.assert_allclose(found.min(axis=0), [0.6, 0.6, 0.5, 9.5], atol=0.01)
    np.testing.assert_allclose(found.max(axis=0), [1.6, 1.6, 1.5, 10.5], atol=0.01)
    assert_independent(found, 0.1)


def test_start_and_layer_boundary_are_normal_and_sides_even(many):
    """Means, standard deviations, and 68 % within one of them; independent of each other."""
    found = np.array(
        [(t.base_y, t.base_turn, axial_error(t), t.scenario.layer_tops[1] - 20.0) for t in many[1]]
    ) / [0.5, 0.003, 1.0, 1.5]
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(found.std(axis=0), 1.0, rtol=0.06)
    np.testing.assert_allclose((np.abs(found) < 1.0).mean(axis=0), 0.683, atol=0.05)
    sides = np.sign([(t.bend, t.run_out) for t in many[1]])
    np.testing.assert_allclose(sides.mean(axis=0), 0.0, atol=0.1)
    assert_independent(np.column_stack([found, sides]), 0.11)


def test_in_space_the_second_axis_is_like_the_first(many):
    """Position and slope as normal along z as along y, any direction of bend and run-out; all independent."""
    found = np.array([[getattr(truth, name) for name in (*OUT, "base_y", "base_turn")] for truth in many[2]])
    right = 0.5 * math.pi
    found /= [0.5, 0.003, right / math.sqrt(3.0), right / math.sqrt(3.0), 0.5, 0.003]
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(found.std(axis=0), 1.0, rtol=0.07)
    assert np.abs(found[:, 2:4]).max() == pytest.approx(math.sqrt(3.0), rel=0.01)
    assert_independent(found, 0.1)


def test_the_trackers_bias_has_its_length_and_any_direction(many):
    """On a circle in the plane and on a sphere in space."""
    for axes, truths in many.items():
        bias = np.array([truth.bias for truth in truths])[:, : 1 + axes]
        np.testing.assert_allclose(np.linalg.norm(bias, axis=1), 0.3)
        np.testing.assert_allclose(bias.mean(axis=0), 0.0, atol=0.03)
        np.testing.assert_allclose((bias**2).mean(axis=0), 0.09 / (1 + axes), rtol=0.1)
    assert not any(truth.bias[2] for truth in many[1])


def test_the_variation_of_stiffness_has_its_size_and_correlation(many):
    """Log-normal with mean 1 and sd 0.2; correlation e⁻¹ over 10 mm, e⁻² over 20 mm."""
    cell = many[1][0].cell_mm
    factor = np.array([truth.variation for truth in many[1]])
    assert cell == 0.25
    assert factor.shape[1] * cell >= PHANTOM.setup.max_depth
    assert factor.mean() == pytest.approx(1.0, abs=0.01)
    assert factor.std() == pytest.approx(0.2, rel=0.05)
    np.testing.assert_allclose(factor.mean(axis=0), 1.0, atol=0.03)  # at every depth, also at the skin
    np.testing.assert_allclose(factor.std(axis=0), 0.2, rtol=0.15)
    level = np.log(factor)
    assert abs(((level - level.mean()) ** 3).mean() / level.std() ** 3) < 0.06  # of the logarithm: not skewed
    for lag, expected in ((1.0, math.exp(-0.1)), (10.0, math.exp(-1.0)), (20.0, math.exp(-2.0))):
        k = round(lag / cell)
        found = np.corrcoef(level[:, :-k].ravel(), level[:, k:].ravel())[0, 1]
        assert found == pytest.approx(expected, abs=0.03)
    layers = [entries(truth)["layers"][0] for truth in many[1]]
    assert_independent(np.column_stack([layers, level.mean(axis=1)]), 0.1)
    short = PHANTOM.with_values({"setup.stroke_mm": 60.0, "target.depth_mm": 25.0})
    assert len(drawn(0, short).variation) * cell == pytest.approx(31.5 + 8 * cell)


# ---- independence of the keys


def test_a_draw_depends_only_on_the_seed():
    rng = np.random.default_rng(7)
    assert drawn(7) == draw(PHANTOM, rng)
    assert drawn(7) not in (drawn(8), draw(PHANTOM, rng))


def test_every_key_of_the_phantom_is_tested():
    assert {*CHANGED, "contact_spacing_mm", "structure"} == set(type(PHANTOM.phantom).model_fields)


@pytest.mark.parametrize("key", CHANGED)
def test_changing_one_key_does_not_change_the_other_draws(key):
    """So that each imperfection can be compared in pairs."""
    value, touched = CHANGED[key]
    changed = PHANTOM.with_values({f"phantom.{key}": value})
    for seed in range(3):
        assert changes(drawn(seed), drawn(seed, changed)) == touched


def test_a_second_axis_or_a_key_set_to_zero_changes_no_other_draw():
    none = {f"phantom.{key}": 0.0 for key in ("start_offset_z_sd_mm", "start_angle_z_sd_mrad")}
    none |= {"phantom.direction_spread_deg": 0.0}
    for seed in range(3):
        assert changes(drawn(seed), drawn(seed, SPACE)) == set(OUT)
        assert changes(drawn(seed), drawn(seed, SPACE.with_values(none))) == set()
        for key in ("layer_shift_sd_mm", "shear_modulus_variation"):
            without = PHANTOM.with_values({f"phantom.{key}": 0.0})
            assert changes(drawn(seed), drawn(seed, without)) == CHANGED[key][1]


def test_without_imperfections_the_true_scenario_is_the_scenario():
    """Except for the spacing of its contacts."""
    expected = IDEAL.with_values({"contact.spacing_mm": IDEAL.phantom.contact_spacing_mm})
    for seed in range(3):
        truth = drawn(seed, IDEAL)
        assert truth.scenario == expected
        assert set(truth.variation) == {1.0}
        assert replace(truth, variation=(1.0,)) == Truth(expected)


# ---- limits of the draws


def layered(*thickness):
    """Return the phantom with layers (mm) on a firmer one."""
    layer = {"shear_modulus_kpa": 2.0, "alpha": 8.0, "compression_length_mm": 20.0, "engaged_width_mm": 5.0}
    tissue = [{**layer, "thickness_mm": each} for each in thickness]
    return PHANTOM.with_values({"tissue": [*tissue, {**layer, "shear_modulus_kpa": 4.0}]})


@pytest.mark.parametrize("shift", [1.5, 8.0, 100.0])
def test_no_layer_vanishes(shift):
    """For any displacement of the boundaries, even past each other: at least 0.1 mm remains."""
    scenario = layered(5.0, 0.5, 12.0).with_values({"phantom.layer_shift_sd_mm": shift})
    tops = np.array([drawn(seed, scenario).scenario.layer_tops for seed in range(60)])
    assert np.diff(tops, axis=1).min() == pytest.approx(0.1)


def test_a_strong_bevel_is_drawn_within_its_limit():
    """12 mm × 1.5 would violate b < 0.7 h = 14 mm: drawn uniformly from the valid part of the range."""
    strong = PHANTOM.with_values({"needle.bevel.offset_mm": 12.0})
    offsets = [drawn(seed, strong).scenario.needle.bevel.offset_mm for seed in range(300)]
    assert 0.5 * 12.0 <= min(offsets) < 6.2
    assert 13.7 < max(offsets) < 14.0
    assert np.mean(offsets) == pytest.approx(10.0, abs=0.5)
    symmetric = PHANTOM.with_values({"needle.bevel.offset_mm": 0.0})
    assert drawn(0, symmetric).scenario.needle.bevel.offset_mm == 0.0


@pytest.mark.parametrize(
    ("changed", "low", "high"),
    [
        pytest.param(
            {"setup.tip_to_skin_mm": 1.0, "setup.stroke_mm": 60.0}, -20.0, 0.5, id="close to the skin"
        ),
        pytest.param(
            {"setup.tip_to_skin_mm": 40.0, "setup.stroke_mm": 90.0}, -0.5, 20.0, id="close to the guide"
        ),
        pytest.param({"needle.length_mm": 124.5}, -6.25, 1.0, id="base close to the guide"),
        pytest.param(
            {"setup.guide_to_skin_mm": None, "setup.stroke_mm": 60.0, "target.depth_mm": 31.5},
            -15.75,
            14.25,
            id="no guide",
        ),
    ],
)
def test_a_start_error_is_at_most_half_of_the_distance_to_skin_guide_and_stop(changed, low, high):
    """For any standard deviation the true scenario is valid for both plants."""
    scenario = PHANTOM.with_values({"phantom.start_axial_sd_mm": 50.0, **changed})
    errors = [axial_error(drawn(seed, scenario), scenario) for seed in range(60)]
    assert (min(errors), max(errors)) == pytest.approx((low, high))


def test_a_target_beyond_the_stroke_is_set_to_the_largest_depth_in_reach():
    scenario = PHANTOM.with_values({"target.depth_mm": PHANTOM.setup.max_depth})
    for seed in range(20):
        truth = drawn(seed, scenario).scenario
        assert truth.target.depth_mm == min(scenario.target.depth_mm, truth.setup.max_depth)


# ---- the published phantoms


def rounded(value):
    """Round to 12 digits: the last digits of exp and log differ between processors."""
    if isinstance(value, float):
        return float(f"{value:.12g}")
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    return list(map(rounded, value)) if isinstance(value, list | tuple) else value


def digest(truth):
    """Return the digest of all drawn values, without the keys that are younger than the published phantoms."""
    values = truth.scenario.values()
    values = {name: values[name] for name in ("needle", "setup", "tissue", "contact", "target")}
    for key in ("axes", "guide_axes", "rotation", "rotation_speed_deg_s"):
        del values["setup"][key]
    assert values["target"].pop("lateral_z_mm") == 0.0
    assert {layer.pop("law") for layer in values["tissue"]} == {"ogden"}
    rest = [getattr(truth, name) for name in (*PLANAR, "cell_mm")]
    rest[PLANAR.index("bias")] = rest[PLANAR.index("bias")][:2]
    return hashlib.sha256(json.dumps(rounded([values, *rest]), sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("scenario", "digests"),
    [
        (PHANTOM, ["858a94ebf9c32a91", "4675914ecd03cc17", "72f72a01a96d11b2"]),
        (world(3), ["06a58745625cfad1", "5f66c5499aa74278", "cd2f5fd461570bce"]),
        (world(15), ["f0d773d2e4f25312", "cc3203a4f0060a10", "105f39294b7cf02f"]),
    ],
)
def test_without_axial_error_and_modulus_variation_phantoms_are_the_published_ones(scenario, digests):
    """As drawn before these two keys existed: with a guide, and without (world 15)."""
    before = scenario.with_values({"phantom.start_axial_sd_mm": 0.0, "phantom.youngs_modulus_variation": 0.0})
    assert [digest(drawn(seed, before)) for seed in (0, 7, 100000)] == digests
