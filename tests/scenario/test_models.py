"""Valid scenarios: values, defaults, inner units, copies, text."""

import math
import pickle
import tomllib

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from pydantic import ValidationError

from flexneedle.control.bang_bang import BevelRule
from flexneedle.control.controllers import check_tables
from flexneedle.errors import ScenarioError
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.library import PRESETS
from flexneedle.scenario.model import Scenario, check_target
from flexneedle.scenario.sections.needle import GAUGES
from flexneedle.scenario.world_draws import bevel_of_radius

PHANTOM = load_scenario("phantom")


def test_the_preset_is_the_two_layer_phantom():
    assert PRESETS.names() == ["gel", "phantom", "phantom3d"]
    assert PHANTOM.name == "Two-layer tissue phantom"
    assert [layer.shear_modulus_kpa for layer in PHANTOM.tissue] == [1.82, 3.63]
    assert PHANTOM.setup.guide_to_skin_mm == 41.0
    assert PHANTOM.target.position == (40.0, 5.0, 0.0)
    assert PHANTOM.phantom.shear_modulus_factor == (0.6, 1.6)


def test_the_phantom_in_space_is_the_same_with_two_axes_and_a_target_off_both():
    changes = {
        "name": "Two-layer tissue phantom in space",
        "setup.axes": 2,
        "target.lateral_mm": 4.0,
        "target.lateral_z_mm": 3.0,
    }
    assert check_tables(load_scenario("phantom3d")) == check_tables(PHANTOM).with_values(changes)


def test_the_gel_is_as_recorded_with_the_rig_and_errors_of_the_phantom():
    """Foundation as of 160 to 680 kPa; the free path of its bevel has a radius of 2 m."""
    gel = load_scenario("gel")
    (layer,) = gel.tissue
    foundation = layer.modulus * layer.engaged_width_mm / layer.compression_length_mm
    assert 3e-3 * 160.0 * 0.26 < foundation < 3e-3 * 680.0 * 0.26
    needle, guide = gel.needle, gel.setup.guide_to_skin_mm
    offset = bevel_of_radius(2000.0, needle.bending_stiffness, foundation, needle.bevel.length_mm)
    assert needle.bevel.offset_mm == pytest.approx(offset, rel=1e-3)
    assert (needle.gauge, guide) == ("18G", 20.0)
    for section in ("contact", "plan", "control", "tracker", "phantom"):
        assert getattr(check_tables(gel), section) == getattr(check_tables(PHANTOM), section)


def test_a_minimal_file_takes_its_settings_from_the_phantom(minimal_text, scenario_file):
    scenario = load_scenario(scenario_file(minimal_text))
    for section in ("contact", "target", "plan", "control", "tracker", "phantom"):
        assert getattr(check_tables(scenario), section) == getattr(check_tables(PHANTOM), section)
    assert scenario.needle.bevel == PHANTOM.needle.bevel
    assert scenario.needle.length_mm == 150.0
    assert not scenario.setup.has_guide
    assert scenario.setup.guide_x is None


def test_inner_units_are_mm_newton_megapascal_radian_second():
    assert PHANTOM.needle.youngs_modulus == 200e3
    assert PHANTOM.tissue[0].shear_modulus == pytest.approx(1.82e-3)
    assert PHANTOM.setup.max_base_turn_step == pytest.approx(5e-3)
    assert BevelRule(curvature_per_m=0.7).curvature == pytest.approx(7e-4)
    assert PHANTOM.tracker.period == 0.025
    assert PHANTOM.phantom.start_angle_sd == pytest.approx(3e-3)
    assert PHANTOM.with_values({"plan.base_turn_sigma_mrad": 2.0}).plan.base_turn_sigma == pytest.approx(2e-3)


def test_jitter_of_one_axis_gives_the_jitter_of_the_3d_vector():
    assert math.sqrt(3 * PHANTOM.tracker.jitter_per_axis**2) == pytest.approx(PHANTOM.tracker.jitter_mm)


def test_bending_stiffness_of_a_round_rod():
    radius = 0.819 / 2
    assert PHANTOM.needle.second_moment == pytest.approx(math.pi * radius**4 / 4)
    assert PHANTOM.needle.bending_stiffness == pytest.approx(4416.9, rel=1e-4)


def test_places_at_the_start():
    assert PHANTOM.setup.guide_x == -41.0
    assert PHANTOM.setup.start_tip_x == -28.5
    assert PHANTOM.start_base_x == -178.5
    assert PHANTOM.setup.max_depth == 81.5
    assert PHANTOM.layer_tops == (0.0, 20.0)


def test_a_gauge_gives_the_diameters_of_a_regular_wall_needle():
    for gauge, outer, inner in (("17G", 1.473, 1.067), ("21G", 0.819, 0.514), ("27G", 0.413, 0.21)):
        needle = _with_gauge(gauge).needle
        assert (needle.outer_diameter, needle.inner_diameter) == (outer, inner)
    outer = [diameters[0] for diameters in GAUGES.values()]
    assert list(GAUGES) == [f"{number}G" for number in range(17, 28)]
    assert outer == sorted(outer, reverse=True)
    assert all(inside < outside for outside, inside in GAUGES.values())


def test_a_stylet_makes_the_21_gauge_tube_the_rod_of_the_phantom():
    needle = _with_gauge("21G", stylet=True).needle
    assert needle.bending_stiffness == PHANTOM.needle.bending_stiffness
    assert _with_gauge("21G").needle.bending_stiffness < 0.9 * needle.bending_stiffness


def test_a_scenario_is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        PHANTOM.needle.length_mm = 1.0


def test_changes_by_dotted_key_leave_the_original_unchanged():
    changed = PHANTOM.with_values(
        {"needle.bevel.offset_mm": 0.0, "tissue.0.alpha": 5, "tissue[1].alpha": 6.0}
    )
    assert changed.needle.bevel.offset_mm == 0.0
    assert [layer.alpha for layer in changed.tissue] == [5.0, 6.0]
    assert [layer.alpha for layer in PHANTOM.tissue] == [8.74, 8.74]
    layers = PHANTOM.values()["tissue"]
    assert len(PHANTOM.with_values({"tissue": [layers[0], *layers]}).tissue) == 3
    assert not PHANTOM.with_values({"setup.guide_to_skin_mm": None}).setup.has_guide
    assert PHANTOM.with_values({"tissue.1.thickness_mm": 5.0}).layer_tops == PHANTOM.layer_tops


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"needle.bevel.offset_mm": -1.0}, "needle.bevel.offset_mm = -1.0: must be at least 0"),
        ({"tissue.2.alpha": 1.0}, "tissue.2.alpha: no such key: the list has items 0 to 1"),
        ({"tissue.2.youngs_modulus_kpa": 5.0}, "tissue.2.youngs_modulus_kpa: no such key"),
        ({2: 1.0}, "2: must be a dotted key in quotes"),
        ({"tissue.alpha": 1.0}, "tissue.alpha: no such key: the list has items 0 to 1"),
        ({"name.first": "a"}, "name.first: no such key: the value above it is not a table"),
        ({"needle.colour": "red"}, 'needle.colour = "red": unknown key'),
    ],
)
def test_a_change_is_checked(change, message):
    with pytest.raises(ScenarioError) as caught:
        PHANTOM.with_values(change)
    assert str(caught.value).startswith(message)


def test_flat_values_round_trip_through_changes():
    flat = PHANTOM.flat()
    assert flat["tissue.1.shear_modulus_kpa"] == 3.63
    assert flat["phantom.bevel_factor"] == [0.5, 1.5]
    assert PHANTOM.with_values(flat) == PHANTOM


def test_the_first_difference_is_named_as_in_the_file():
    assert PHANTOM.first_difference(load_scenario("phantom"), ("tissue", "plan")) is None
    changed = PHANTOM.with_values({"tissue.1.alpha": 2.0, "plan.samples": 10, "plan.elite_fraction": 0.5})
    assert PHANTOM.first_difference(changed, ("plan", "tissue")) == ("tissue[1].alpha", 8.74, 2.0)
    no_guide, guide = PHANTOM.with_values({"setup.guide_to_skin_mm": None}), PHANTOM.setup.guide_to_skin_mm
    assert PHANTOM.first_difference(no_guide, ["setup"]) == ("setup.guide_to_skin_mm", guide, "none")
    assert no_guide.first_difference(PHANTOM, ["setup"]) == ("setup.guide_to_skin_mm", "none", guide)


@given(
    name=st.text(st.characters(codec="utf-8"), min_size=1, max_size=20).filter(
        lambda text: text.isprintable() and text.strip()
    ),
    offset=st.floats(0, 13.9),
    mu=st.floats(1e-6, 1e6),
    alpha=st.floats(0.01, 100) | st.floats(-100, -0.01),
    guide=st.none() | st.floats(28.6, 60),
    nodes=st.integers(2, 10_000),
    factors=st.tuples(st.floats(0.1, 1), st.floats(1, 10)),
)
@hypothesis_settings(max_examples=30)
def test_text_loads_back_equal(name, offset, mu, alpha, guide, nodes, factors):
    scenario = PHANTOM.with_values(
        {
            "name": name,
            "needle.bevel.offset_mm": offset,
            "needle.nodes": nodes,
            "tissue.0.shear_modulus_kpa": mu,
            "tissue.1.alpha": alpha,
            "setup.guide_to_skin_mm": guide,
            "phantom.bevel_factor": factors,
        }
    )
    again = Scenario.from_values(tomllib.loads(dump_scenario(scenario)))
    assert again == scenario
    assert hash(again) == hash(scenario)
    assert pickle.loads(pickle.dumps(scenario)) == scenario


def test_a_scenario_is_its_own_source():
    assert load_scenario(PHANTOM) is PHANTOM


SPACE = {"setup.axes": 2, "target.lateral_z_mm": -15.0}
NO_GUIDE = {"setup.guide_to_skin_mm": None, "setup.max_base_travel_mm": 6.0}


@pytest.mark.parametrize(
    ("values", "target", "rule"),
    [
        *(({}, target, None) for target in ((25, -5), (81.5, 15), (1e-3, 0))),
        ({}, (0, 0), "target.depth_mm = 0.0: must be above 0"),
        ({}, (math.nan, 0), "target.depth_mm = nan: must be a finite number"),
        ({}, (81.6, 0), "target.depth_mm = 81.6: beyond the stroke: must be at most 81.5"),
        (
            {},
            (40, -15.1),
            "target.lateral_mm = -15.1: must be at most 15 in size, the lateral travel of the guide",
        ),
        ({}, (40, math.inf), "target.lateral_mm = inf: must be a finite number"),
        ({}, (40, 0, -3.0), "target.lateral_z_mm = -3.0: must be 0 with setup.axes = 1"),
        (SPACE, (40, 7, -15), None),
        (SPACE, (40, 7, -15.1), "target.lateral_z_mm = -15.1: must be at most 15 in size"),
        (
            NO_GUIDE,
            (40, 7),
            "target.lateral_mm = 7.0: must be at most 6 in size, the lateral travel of the base",
        ),
    ],
)
def test_a_target_out_of_reach_is_refused(values, target, rule):
    scenario = PHANTOM.with_values(values)
    if rule is None:
        assert check_target(scenario, *target) is None
        return
    with pytest.raises(ScenarioError) as caught:
        check_target(scenario, *target)
    assert str(caught.value).startswith(rule)


def _with_gauge(gauge, *, stylet=False):
    no_diameters = {"needle.outer_diameter_mm": None, "needle.inner_diameter_mm": None}
    return PHANTOM.with_values({"needle.gauge": gauge, "needle.stylet": stylet, **no_diameters})
