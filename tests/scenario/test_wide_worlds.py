"""Wide worlds: stiffness from soft organs to stiff gel, and bevels by the radius of their path."""

import hashlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import Simulator, load_scenario
from flexneedle.errors import ScenarioError
from flexneedle.scenario.plausible import find_doubts
from flexneedle.scenario.world_draws import bevel_of_radius
from flexneedle.scenario.worlds import LARGEST_WORLD, RIGS, WIDE, has_rig, world
from flexneedle.types import Control

PRESET = load_scenario("phantom").values()
DRAWN = ("name", "needle", "setup", "tissue", "target")
NUMBERS = st.integers(0, LARGEST_WORLD)
many_worlds = hypothesis_settings(max_examples=40)


def wide(number, *kind):
    return world(number, *kind, kind=WIDE)


def stiffest(scenario):
    """Initial stiffness k₀ (MPa) of the stiffest layer."""
    return max(
        layer.modulus * layer.engaged_width_mm / layer.compression_length_mm for layer in scenario.tissue
    )


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (0, "5cad526ead6fb453"),
        (3, "7358f6f02e4302af"),
        (500, "6058a29b9467176c"),
        (100000, "9fd05cb89247e7b2"),
        (100199, "7f1beaef0181addb"),
    ],
)
def test_a_number_gives_the_same_bytes_forever(number, expected):
    values = wide(number).values()
    text = json.dumps({name: values[name] for name in DRAWN}, sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == expected


@given(number=NUMBERS)
@many_worlds
def test_a_wide_world_differs_from_the_preset_only_in_what_is_drawn(number):
    values = wide(number).values()
    kept = [name for name in PRESET if name not in DRAWN]
    assert {name: values[name] for name in kept} == {name: PRESET[name] for name in kept}
    assert 25.0 <= values["target"]["depth_mm"] <= 95.0


@given(number=NUMBERS)
@many_worlds
def test_layers_are_within_a_factor_two_of_one_level_and_a_skin_up_to_ten_above_it(number):
    scenario = wide(number)
    skin = [layer for layer in scenario.tissue if layer.name == "skin"]
    moduli = [layer.shear_modulus_kpa for layer in scenario.tissue[len(skin) :]]
    assert skin in ([], list(scenario.tissue[:1]))
    assert 0.4 <= min(moduli) <= max(moduli) <= 1200.0
    assert max(moduli) <= 4.0 * min(moduli) + 0.01
    for layer in skin:
        assert 1.0 <= layer.thickness_mm <= 3.0
        # The level is at most twice the softest layer and at least half of the stiffest one.
        assert 0.5 * 2.0 * max(moduli) - 0.01 <= layer.shear_modulus_kpa <= 2.0 * 10.0 * min(moduli) + 0.01
    assert all(layer.thickness_mm >= 1.0 - 5e-3 for layer in scenario.tissue[:-1])


@given(number=NUMBERS)
@many_worlds
def test_the_free_radius_in_the_stiffest_layer_is_in_its_range_or_the_bevel_has_its_largest_offset(number):
    scenario = wide(number)
    bevel, stiffness = scenario.needle.bevel, scenario.needle.bending_stiffness
    tightest = bevel_of_radius(150.0, stiffness, stiffest(scenario), bevel.length_mm)
    straightest = bevel_of_radius(2000.0, stiffness, stiffest(scenario), bevel.length_mm)
    assert min(5.0, straightest) * 0.999 <= bevel.offset_mm <= min(5.0, tightest) * 1.001


@pytest.mark.parametrize(("stiffness", "shear_kpa"), [(640.0, 200.0), (4000.0, 40.0), (900.0, 2.4)])
def test_a_needle_with_the_bevel_of_a_radius_follows_this_radius(stiffness, shear_kpa):
    """Deep in one layer and at small strain the slope of the path grows by 1/R per mm."""
    radius, foundation = 50_000.0, 3e-3 * shear_kpa * 0.26
    decay = (4.0 * stiffness / foundation) ** 0.25
    depth = round(8.0 * decay + 60.0)
    diameter = (stiffness * 64.0 / (np.pi * 200e3)) ** 0.25
    tissue = {**PRESET["tissue"][0], "shear_modulus_kpa": shear_kpa}
    offset = bevel_of_radius(radius, stiffness, foundation, 3.0)
    scenario = load_scenario("phantom").with_values(
        {
            "tissue": [tissue],
            "needle": {
                "outer_diameter_mm": diameter,
                "length_mm": depth + 20.0,
                "bevel": {"offset_mm": offset},
            },
            "setup": {"tip_to_skin_mm": 1.0, "stroke_mm": depth + 2.0},
            "target.lateral_mm": 0.0,
        }
    )
    simulator = Simulator(scenario, threads=1)
    state, path = simulator.start(0.0), []
    for _ in range(depth):
        state = simulator.step(state, Control(db_x=1.0))
        path.append(state.tip[[0, 3]])
    x, slope = np.array(path[-40:]).T
    assert 1.0 / np.polyfit(x, slope, 1)[0] == pytest.approx(radius, rel=0.02)


def structure(number):
    return wide(number, "structure").phantom.structure


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (0, {"spring_back_mm": 0.442}),
        (3, {"compression_length_factor": 0.945}),
        (7, {"spring_back_mm": 0.911}),
        (100001, {"modulus_drift": -0.239}),
        (100002, {"yield_mm": 0.95}),
        (100004, {"compression_length_factor": 1.052}),
    ],
)
def test_a_number_gives_the_same_structural_mismatch_forever(number, expected):
    assert structure(number).model_dump(exclude_defaults=True) == expected


@given(number=NUMBERS)
@many_worlds
def test_a_wide_world_has_one_kind_of_structural_mismatch_in_its_range(number):
    scenario = wide(number)
    if not scenario.setup.has_guide:
        with pytest.raises(ScenarioError, match=r"^wide world .* has no guide"):
            wide(number, "structure")
        return
    found, plain = structure(number), scenario.phantom.structure
    values = found.model_dump()
    assert sum(value != plain.model_dump()[key] for key, value in values.items()) <= 1
    assert 0.3 <= (found.yield_mm or 0.3) <= 1.0
    assert 0.04 <= (found.spring_back_mm or 0.04) <= 1.0
    assert abs(found.modulus_drift) <= 0.25
    if (hidden := found.hidden_layer) and hidden.top_mm == 0.0:
        assert 0.5 <= hidden.thickness_mm <= 3.0
        assert 3.0 <= hidden.modulus_factor <= 10.0
        assert scenario.tissue[0].name != "skin"


@pytest.mark.long
def test_each_kind_of_structural_mismatch_is_as_likely():
    """Of 1000 worlds 800 have a guide; with a hidden skin in the seven tenths without a skin."""
    kinds = [
        "skin" if (hidden := found.get("hidden_layer")) and hidden["top_mm"] == 0.0 else next(iter(found))
        for number in range(1000)
        if wide(number).setup.has_guide and (found := structure(number).model_dump(exclude_defaults=True))
    ]
    names, counts = np.unique(kinds, return_counts=True)
    assert len(names) == 9
    expected = [62 if name == "skin" else 92 for name in names]
    np.testing.assert_allclose(counts, expected, atol=32)


@pytest.mark.long
def test_wide_worlds_have_the_documented_shares():
    """Shares of a thousand: skin 30 %, guide 80 %, levels evenly over the logarithm, largest bevel offset 32 %."""
    worlds = [wide(number) for number in range(1000)]
    assert sum(found.tissue[0].name == "skin" for found in worlds) == pytest.approx(300, abs=45)
    assert sum(found.setup.has_guide for found in worlds) == pytest.approx(800, abs=40)
    assert sum(found.needle.bevel.offset_mm == 5.0 for found in worlds) == pytest.approx(320, abs=45)
    middle = [np.exp(np.mean([np.log(layer.shear_modulus_kpa) for layer in w.tissue])) for w in worlds]
    counts, _ = np.histogram(np.log(middle), 3, (np.log(0.8), np.log(600.0)))
    np.testing.assert_allclose(counts, 333, atol=50)


def test_the_two_kinds_of_worlds_share_no_draws():
    """The seeds of the two differ, in the direction of a target in space as well."""
    for number in range(20):
        assert wide(number).target != world(number).target
        if has_rig(wide(number), "two-axes") and has_rig(world(number), "two-axes"):
            tilts = [
                each.target.lateral_z_mm / each.target.lateral_mm
                for each in (world(number, "real", "two-axes"), wide(number, "real", "two-axes"))
            ]
            assert abs(tilts[0] - tilts[1]) > 1e-6


@given(number=NUMBERS, case=st.sampled_from(["perfect", "real"]), rig=st.sampled_from(RIGS))
@many_worlds
def test_a_wide_world_is_found_by_its_name(number, case, rig):
    if has_rig(wide(number), rig):
        assert load_scenario(f"wide:{number}:{case}:{rig}") == wide(number, case, rig)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wide:", "must be wide:NUMBER, with :CASE, :RIG or :CASE:RIG"),
        ("wide:7:ideal", "must be wide:NUMBER"),
        ("wide:1000000001", "must be a whole number from 0 to 1000000000"),
    ],
)
def test_a_name_of_no_wide_world_is_refused_in_one_line(name, message):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(name)
    (line,) = caught.value.problems
    assert message in line


def test_an_unknown_kind_is_refused_with_the_known_ones():
    with pytest.raises(ScenarioError, match="world_kind = 'odd': must be one of world, wide"):
        world(3, kind="odd")


def test_only_moduli_beyond_recorded_gel_are_in_doubt():
    """Half an order of magnitude above the stiffest organ, 210 kPa: in about a tenth of the worlds."""
    doubts = [find_doubts(wide(number)) for number in range(100)]
    stiff = [any(layer.shear_modulus_kpa > 210.0 * 10**0.5 for layer in wide(n).tissue) for n in range(100)]
    assert [bool(lines) for lines in doubts] == stiff
    assert all("shear_modulus_kpa" in line for lines in doubts for line in lines)
    assert sum(stiff) < 20
