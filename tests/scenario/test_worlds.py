"""Worlds: random scenarios by number, their ranges, their cases, their names."""

import hashlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.errors import ScenarioError
from flexneedle.scenario.world_structures import draw_structure
from flexneedle.scenario.worlds import CASES, LARGEST_WORLD, PLANE, RIGS, world

PRESET = load_scenario("phantom").values()
NUMBERS = st.integers(0, LARGEST_WORLD)
DRAWN = ("name", "needle", "setup", "tissue", "target")
many_worlds = hypothesis_settings(max_examples=40)


def digest(number):
    values = world(number).values()
    for layer in values["tissue"]:
        assert layer.pop("law") == "ogden"  # keys that are not drawn, and younger than the published numbers
    younger = [values["setup"].pop(key) for key in ("axes", "guide_axes", "rotation", "rotation_speed_deg_s")]
    assert [*younger, values["target"].pop("lateral_z_mm")] == [1, 2, "free", 360.0, 0.0]
    text = json.dumps({name: values[name] for name in (*DRAWN, "contact")}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (0, "1ee9b20fd97fb886"),
        (3, "af92a6c2f66628a8"),
        (8, "6ab774a2d4cc558a"),
        (500, "941c08d0e4a42c8e"),
        (100000, "b210b5013f9003d8"),
        (100199, "677216abfd6dfce7"),
    ],
)
def test_a_number_gives_the_same_bytes_forever(number, expected):
    """Figures of worlds are published by number: a change of the distribution needs other numbers."""
    assert digest(number) == expected


@given(number=NUMBERS)
@many_worlds
def test_every_world_is_within_its_ranges_and_else_the_preset(number):
    scenario = world(number)
    needle, setup, target = scenario.needle, scenario.setup, scenario.target
    if needle.gauge is None:
        assert needle.youngs_modulus_gpa == 60.0
        assert 0.5 <= needle.outer_diameter <= 1.1
    else:
        assert needle.youngs_modulus_gpa == 200.0
        assert 18 <= int(needle.gauge[:2]) <= 25
    assert 1.0 <= needle.bevel.offset_mm <= 5.0
    assert 25.0 <= target.depth_mm <= 95.0
    assert abs(target.lateral_mm) <= 0.11 * target.depth_mm + 1e-3
    assert 1 <= len(scenario.tissue) <= 4
    assert all(0.8 <= layer.shear_modulus_kpa <= 12.0 for layer in scenario.tissue)
    assert all(thickness >= 4.0 - 2e-3 for thickness in np.diff(scenario.layer_tops))
    assert scenario.layer_tops[-1] <= target.depth_mm + 5.0 + 5e-3
    assert 5.0 - 1e-3 <= setup.max_depth - target.depth_mm <= 20.0 + 1e-3
    if setup.guide_to_skin_mm is None:
        assert 1.0 <= setup.tip_to_skin_mm <= 60.0
    else:
        assert 15.0 <= setup.guide_to_skin_mm <= 60.0
        assert 1.0 <= setup.tip_to_skin_mm <= 0.9 * setup.guide_to_skin_mm + 1e-3
    values = scenario.values()
    assert {name: values[name] for name in PRESET if name not in DRAWN} == {
        name: PRESET[name] for name in PRESET if name not in DRAWN
    }


@pytest.mark.long
def test_worlds_have_the_documented_shares():
    """Shares of a thousand: steel 70 %, stylet in half of it, guide 80 %, layers evenly."""
    worlds = [world(number) for number in range(1000)]
    steel = [found.needle for found in worlds if found.needle.gauge is not None]
    assert len(steel) == pytest.approx(700, abs=45)
    assert sum(needle.stylet for needle in steel) == pytest.approx(0.5 * len(steel), abs=45)
    assert sum(found.setup.has_guide for found in worlds) == pytest.approx(800, abs=40)
    layers = np.bincount([len(found.tissue) for found in worlds], minlength=5)[1:]
    np.testing.assert_allclose(layers, 250, atol=45)
    sides = np.sign([found.target.lateral_mm for found in worlds])
    assert abs(sides.mean()) < 0.1


def difference(number, case):
    """Return the values of a case that differ from the real world."""
    real, other = world(number).flat(), world(number, case).flat()
    return {key: other[key] for key in other if real.get(key) != other[key]}


@given(number=NUMBERS)
@many_worlds
def test_a_perfect_world_has_no_mismatch_and_the_same_mesh(number):
    changed = difference(number, "perfect")
    assert set(changed) == {
        key
        for key in world(number, "perfect").flat()
        if key.startswith("phantom.")
        and key not in ("phantom.variation_length_mm", "phantom.tracker_bias_mm", "phantom.tracker_drift_mm")
        and not key.endswith(("spacing_mm", "element_mm", "step_mm"))
        and ".structure." not in key
    }
    assert all(value in (0.0, [1.0, 1.0]) for value in changed.values())


@given(number=NUMBERS)
@many_worlds
def test_a_structural_world_has_one_kind_of_mismatch_more(number):
    scenario = world(number)
    if not scenario.setup.has_guide:
        with pytest.raises(ScenarioError, match="has no guide"):
            world(number, "structure")
        return
    found = world(number, "structure").phantom.structure
    changed = {key.split(".")[2] for key in difference(number, "structure")}
    assert len(changed) == 1
    room = 0.5 * (scenario.setup.guide_to_skin_mm - scenario.setup.tip_to_skin_mm)
    assert 3.0 <= (found.alpha or 3.0) <= 20.0
    assert 0.7 <= found.compression_length_factor <= 1.5
    assert 0.5 <= found.bevel_length_factor <= 2.0
    assert -3.0 <= found.guide_shift_mm <= min(3.0, room) + 1e-3
    if hidden := found.hidden_layer:
        assert 1.0 <= hidden.thickness_mm <= 4.0
        assert 3.0 <= hidden.modulus_factor <= 6.0
        assert hidden.top_mm + hidden.thickness_mm <= scenario.target.depth_mm + 1e-3


@pytest.mark.long
def test_each_kind_of_structural_mismatch_is_as_likely():
    guided = [(number, found) for number in range(1000) if (found := world(number)).setup.has_guide]
    kinds = [next(iter(draw_structure(number, found))) for number, found in guided]
    _, count = np.unique(kinds, return_counts=True)
    np.testing.assert_allclose(count, len(guided) / 5, atol=35)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *(
            (f"world:{end}", "must be world:NUMBER, with :CASE, :RIG or :CASE:RIG")
            for end in ("", "-1", "1.5", "7:")
        ),
        *((f"world:{end}", "must be world:NUMBER") for end in ("7\n", "7:ideal", "7:two-axes:real")),
        ("world:1000000001", "must be a whole number from 0 to 1000000000"),
        (
            "world:7:no-guide",
            "world 7 has a guide: its rigs are plane, two-axes, two-axes-half-turns, one-axis",
        ),
        (
            "world:15:perfect:one-axis",
            "world 15 has no guide: its rigs are plane, no-guide, no-guide-half-turns",
        ),
    ],
)
def test_a_name_of_no_world_is_refused_in_one_line(name, message):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(name)
    (line,) = caught.value.problems
    assert message in line


def rigs(number):
    """The rigs in space that a world can have."""
    if world(number).setup.has_guide:
        return ("two-axes", "two-axes-half-turns", "one-axis", "one-axis-half-turns")
    return ("no-guide", "no-guide-half-turns")


@pytest.mark.slow
@given(number=NUMBERS, case=st.sampled_from(CASES[:2]))
@many_worlds
def test_a_world_in_space_differs_in_driver_and_direction_of_its_target(number, case):
    """The offset has the same size as in the plane, except for rounding."""
    flat = world(number, case)
    for rig in rigs(number):
        found = world(number, case, rig)
        changed = {key for key, value in found.flat().items() if flat.flat().get(key) != value}
        assert changed <= {
            *("setup.axes", "setup.guide_axes", "setup.rotation"),
            *("target.lateral_mm", "target.lateral_z_mm"),
        }
        assert found.setup.axes == 2
        assert found.setup.half_turns == rig.endswith("half-turns")
        assert found.setup.moved_guide_axes == {"two": 2, "one": 1, "no-": 0}[rig[:3]]
        size = np.hypot(found.target.lateral_mm, found.target.lateral_z_mm)
        assert size == pytest.approx(abs(flat.target.lateral_mm), abs=1e-3)


@given(number=NUMBERS)
@many_worlds
def test_where_nothing_steers_along_z_the_target_is_in_the_plane_of_the_bevel(number):
    for rig in ("one-axis-half-turns", "no-guide-half-turns"):
        if rig in rigs(number):
            assert world(number, "real", rig).target == world(number).target


def test_every_driver_has_the_same_target_and_directions_are_uniform():
    angles = []
    for number in range(120):
        *free, _ = (world(number, "real", rig) for rig in rigs(number))
        targets = {found.target.position for found in free}
        assert len(targets) == 1
        _, y, z = targets.pop()
        angles.append(np.arctan2(z, y))
    counts, _ = np.histogram(angles, 4, (-np.pi, np.pi))
    np.testing.assert_allclose(counts, 30, atol=16)


@given(number=NUMBERS, case=st.sampled_from(CASES[:2]))
@many_worlds
def test_a_world_is_found_by_its_name(number, case):
    for rig in (PLANE, *rigs(number)):
        assert load_scenario(f"world:{number}:{case}:{rig}") == world(number, case, rig)


def test_the_name_of_a_real_world_needs_no_case_and_in_the_plane_no_rig():
    assert load_scenario("world:3:one-axis") == world(3, "real", "one-axis")
    assert load_scenario("world:3") == load_scenario("world:3:plane") == world(3, "real", PLANE) == world(3)
    assert RIGS[0] == PLANE
    with pytest.raises(ScenarioError, match="world_rig = 'three-axes': must be one of plane, two-axes"):
        world(3, "real", "three-axes")
