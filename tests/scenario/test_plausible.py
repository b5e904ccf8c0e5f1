"""Warnings of implausible values, with the usual range and its source."""

import pytest

from flexneedle.errors import InputError
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.library import PRESETS
from flexneedle.scenario.plausible import USUAL, find_doubts
from flexneedle.scenario.sections.needle import GAUGES
from flexneedle.scenario.worlds import PERFECT, STRUCTURE, world
from flexneedle.simulator.zones import zones_of

PHANTOM = load_scenario("phantom")


@pytest.mark.parametrize(
    ("key", "value", "doubt"),
    [
        ("target.depth_mm", 0.07, "57.1 times below the smallest usual value, 4 to 200 ("),
        ("needle.outer_diameter_mm", 22.0, "6.47 times the largest usual value, 0.18 to 3.4 ("),
        ("needle.youngs_modulus_gpa", 2000.0, "9.52 times the largest usual value, 3 to 210 ("),
        ("needle.youngs_modulus_gpa", 0.2, "15 times below"),
        ("needle.bevel.offset_mm", 0.0004, "25 times below"),
        ("needle.bevel.length_mm", 100.0, "5.26 times the largest"),
        ("tissue.0.shear_modulus_kpa", 0.002, "300 times below"),
        ("tissue.1.shear_modulus_kpa", 6000.0, "28.6 times the largest"),
        ("tissue.0.alpha", -0.3, "6.67 times below the smallest usual value, 2 to 40 (in size: "),
        ("tissue.0.compression_length_mm", 2000.0, "20 times the largest"),
        ("tissue.0.engaged_width_mm", 0.0052, "231 times below"),
        ("tissue.0.thickness_mm", 0.02, "3.75 times below"),
        ("tissue.1.thickness_mm", 20.0, "has no effect: the last layer has no end"),
        ("setup.guide_clearance_mm", 50.0, "167 times the largest usual value, 0.01 to 0.3 ("),
        ("setup.insertion_speed_mm_s", 5000.0, "17.9 times the largest"),
        ("setup.max_guide_travel_mm", 15000.0, "150 times the largest"),
        ("setup.max_base_travel_mm", 0.015, "66.7 times below"),
        ("tracker.jitter_mm", 0.00007, "143 times below"),
        ("phantom.friction_mn_per_mm", 0.005, "1000 times below"),
    ],
)
def test_an_implausible_value_is_one_line(key, value, doubt):
    (found,) = find_doubts(PHANTOM.with_values({key: value}))
    youngs = f" (youngs_modulus_kpa = {3 * value:g}, E = 3μ)" if "shear" in key else ""
    assert found.startswith(
        f"{key.replace('.0.', '[0].').replace('.1.', '[1].')} = {value:g}{youngs}: {doubt}"
    )
    assert found.isprintable()


def test_a_displacement_from_which_nothing_tears_is_in_doubt():
    layer = PHANTOM.tissue[1].model_dump() | {"law": "tearing", "yield_mm": 14.0}
    (found,) = find_doubts(PHANTOM.with_values({"tissue": [layer]}))
    assert found.startswith("tissue[0].yield_mm = 14: 14 times the largest usual value, 0.3 to 1 (")


def test_readings_that_arrive_stale_are_in_doubt():
    (found,) = find_doubts(PHANTOM.with_values({"setup.insertion_speed_mm_s": 3.0}))
    assert found.startswith(
        "phantom.delay_periods = 1: readings arrive 0.333 s old, above control.stale_after_s"
    )


def test_the_file_of_a_zone_without_an_image_is_in_doubt(tmp_path):
    (tmp_path / "a.stl").touch()
    zone = {"name": "a", "shape": "file", "file": str(tmp_path / "a.stl")}
    scenario = PHANTOM.with_values({"zone": [zone]})
    (found,) = find_doubts(scenario)
    assert found.startswith("zone a: file in the image's frame")
    assert find_doubts(scenario.with_values({"image.sd_mm": 0.3})) == []


@pytest.mark.parametrize("known", [{}, {"sha256": 64 * "0"}], ids=["missing", "changed"])
def test_a_file_of_a_zone_that_a_plan_would_refuse_has_the_same_line(tmp_path, known):
    path = tmp_path / "a.stl"
    if known:
        path.touch()
    zone = {"name": "a", "shape": "file", "file": str(path), **known}
    scenario = PHANTOM.with_values({"zone": [zone], "image.sd_mm": 0.3})
    with pytest.raises(InputError) as refused:
        zones_of(scenario)
    assert find_doubts(scenario) == [str(refused.value)]


def test_every_value_that_is_off_has_its_line():
    off = {"target.depth_mm": 0.07, "needle.youngs_modulus_gpa": 2e5, "tissue.1.thickness_mm": 3.0}
    assert len(find_doubts(PHANTOM.with_values(off))) == 3


@pytest.mark.parametrize(("value", "ratio"), [(210.0, ""), (600.0, ""), (700.0, "3.33"), (7000.0, "33.3")])
def test_a_warning_begins_half_an_order_of_magnitude_beyond_the_range(value, ratio):
    """√10 times 210 GPa is 664 GPa."""
    lines = find_doubts(PHANTOM.with_values({"needle.youngs_modulus_gpa": value}))
    assert [f" {ratio} times the largest" in line for line in lines] == [True] * bool(ratio)


def test_scenarios_of_the_package_raise_no_doubt():
    worlds = [world(number) for number in range(60)]
    guided = [number for number, each in enumerate(worlds) if each.setup.has_guide]
    cases = (*(world(n, PERFECT) for n in range(0, 60, 10)), *(world(n, STRUCTURE) for n in guided))
    for scenario in (*map(load_scenario, PRESETS.names()), *worlds, *cases):
        assert find_doubts(scenario) == []
    for gauge in GAUGES:
        named = {"needle.outer_diameter_mm": None, "needle.inner_diameter_mm": None, "needle.gauge": gauge}
        assert find_doubts(PHANTOM.with_values(named)) == []


def test_every_range_names_its_source_and_a_key_of_scenarios():
    more = {"needle.inner_diameter_mm": 0.5, "phantom.structure.alpha": 3.0, "setup.guide_clearance_mm": 0.05}
    tube = PHANTOM.with_values(more | {"tissue.0.law": "tearing", "tissue.0.yield_mm": 0.5})
    keys = {key.replace("tissue.0", "tissue.*") for key in tube.flat()}
    assert set(USUAL) <= keys
    assert all(usual.low < usual.high and usual.source for usual in USUAL.values())
