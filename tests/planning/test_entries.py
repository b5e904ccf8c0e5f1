"""Maps of entries, against rollouts of single entries and by geometry."""

from dataclasses import fields

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.planning.entries import map_entries
from flexneedle.planning.second_opinion import exact_clearances
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import zones_of
from flexneedle.types import ROLL, X

FREE = {"entry.free_radius_mm": 10.0, "entry.free_slope_mrad": 200.0, "needle.nodes": 31}
SPHERE = {"name": "vessel", "shape": "sphere", "center_mm": [15.0, 3.0, 0.0], "radius_mm": 1.5}
WALL = {"name": "bone", "shape": "half-space", "point_mm": [0.0, -9.0, 0.0], "normal": [0.0, 1.0, 0.0]}
BEHIND = {"name": "organ", "shape": "box", "center_mm": [47.0, 0.0, 0.0], "size_mm": [4.0, 30.0, 30.0]}
ZONES = {"zone": [SPHERE, {**WALL, "margin_mm": 3.0}, BEHIND]}
TARGET = {"target.depth_mm": 40.0, "target.lateral_mm": 2.0}
SCENARIOS = {
    name: flexneedle.load_scenario(name).with_values({**FREE, **ZONES, **TARGET})
    for name in ("phantom", "phantom3d")
}


@pytest.fixture(scope="module", params=SCENARIOS)
def found(request):
    return map_entries(SCENARIOS[request.param])


def test_entries_cover_the_disc_and_many_are_clear(found):
    distance = np.linalg.norm(found.points, axis=1)
    assert distance.max() <= 10.0
    assert distance.max() > 9.5
    assert 0.1 < found.clear.mean() < 0.9
    assert not (found.clear & ~found.reached).any()


def test_numbers_are_those_of_the_insertion_from_the_fixed_entry(found):
    """Of every tenth entry: error, energy, clearance from contacts and from a fine needle, slope within its limits."""
    zones = zones_of(found.scenario)
    for k in range(0, len(found.points), max(1, len(found.points) // 12)):
        simulator = Simulator(found.scenario_at(k), threads=1)
        rows = found.controls[k][found.controls[k, :, X] > 0.0]
        start = simulator.start(found.rolls[k])
        done = simulator.rollout(start, rows[None], outputs=("energy", "shapes"), limits=False)
        exact = simulator.with_zones(zones.exact).rollout(
            start, rows[None], outputs="clearance", limits=False
        )
        error = np.linalg.norm(done.tips[0, -1, :3] - found.scenario.target.position)
        np.testing.assert_allclose(found.error_mm[k], error, atol=1e-6)
        np.testing.assert_allclose(found.peak_energy_uj[k], 1e3 * done.energy.max(), rtol=1e-5)
        clearance = exact.clearance[done.tips[:, :, X] > 0.0].min()
        if k not in found.best(10):
            np.testing.assert_allclose(found.clearance_mm[k], clearance, atol=1e-5)
        if clearance >= zones.margin:  # the bound is for this distance, or a larger one
            assert zones.clearances(done.shapes[0, ..., :3]).min() + zones.added.max() >= clearance
        assert np.hypot(*found.slopes[k]) <= 0.2 + 1e-9


@pytest.mark.parametrize("name", SCENARIOS)
def test_without_zones_the_gentlest_rolls_are_taken(name):
    """Along the energy, neighbours hardly differ, and a roll on the way would be a multiple of the least."""
    found = map_entries(SCENARIOS[name].with_values({"zone": []}))
    energy = found.peak_energy_uj[found.clear]
    assert found.clear.sum() > 50
    middle = np.abs(found.points[found.clear] - [2.0, 0.0]).max(axis=1) < 5.0
    assert energy[middle].max() < 1.2 * energy.min()
    for k in np.flatnonzero(found.clear)[::40]:
        simulator = Simulator(found.scenario_at(k), threads=1)
        rows = found.controls[k][found.controls[k, :, X] > 0.0]
        rolled = rows.copy()
        rolled[len(rows) // 2, ROLL] += np.pi
        peaks = [
            simulator.rollout(
                simulator.start(found.rolls[k]), each[None], outputs=("energy",), limits=False
            ).energy.max()
            for each in (rows, rolled)
        ]
        np.testing.assert_allclose(found.peak_energy_uj[k], 1e3 * peaks[0], rtol=1e-5)
        assert peaks[0] < peaks[1]


def test_clear_entries_keep_the_margin_of_each_zone(found):
    zones = zones_of(found.scenario)
    for k in np.flatnonzero(found.clear)[::20]:
        simulator = Simulator(found.scenario_at(k), threads=1)
        rows = found.controls[k][None]
        shapes = simulator.rollout(
            simulator.start(found.rolls[k]), rows, outputs="shapes", limits=False
        ).shapes
        least = zones.clearances(shapes[..., :3]).reshape(3, -1).min(axis=1)
        assert (least + zones.added >= zones.margins).all()
        assert (
            found.zone[k] == (least - zones.margins).argmin()
            or np.ptp(np.sort(least - zones.margins)[:2]) < 0.1
        )


def test_the_best_are_judged_by_the_exact_rod(found):
    zones = zones_of(found.scenario)
    for k in found.best(10)[::3]:
        rows = found.controls[k][found.controls[k, :, X] > 0.0]
        exact = exact_clearances(found.scenario_at(k), zones, rows, found.rolls[k]).min(axis=1)
        assert (exact >= zones.margins).all()
        assert found.clearance_mm[k] <= exact.min()


def test_displaced_and_turned_insertions_within_the_tolerance_are_clear(found):
    """The needle at the end, of the recommended and other entries, in random directions."""
    rng, zones = np.random.default_rng(0), zones_of(found.scenario)
    for k in [*found.best(3), *np.flatnonzero(found.clear)[::40]]:
        simulator = Simulator(found.scenario_at(k), threads=1)
        rows = found.controls[k][None]
        nodes = simulator.rollout(
            simulator.start(found.rolls[k]), rows, at_end=("shapes",), limits=False
        ).shapes[0, 0, :, :3]
        pivot = np.array([0.0, *found.points[k]])
        for side in rng.uniform(0.0, 2.0 * np.pi, 20) if found.scenario.setup.axes == 2 else (0.0, np.pi):
            across = np.array([0.0, np.cos(side), np.sin(side)])
            angle, arms = 1e-3 * found.angle_mrad[k], nodes - pivot
            along = arms @ across
            turned = arms + np.outer(arms[:, 0] * np.sin(angle) + along * (np.cos(angle) - 1.0), across)
            turned[:, 0] += arms[:, 0] * (np.cos(angle) - 1.0) - along * np.sin(angle)
            for points in (nodes + found.offset_mm[k] * across, pivot + turned):
                inside = points[nodes[:, 0] > 0.1]
                assert (zones.clearances(inside).min(axis=1) >= zones.margins - 0.02).all()


def test_the_recommended_entry_has_the_largest_tolerance(found):
    first, *others = found.best(4)
    assert found.room_mm[first] >= found.room_mm[found.clear].max() - 0.1
    apart = np.linalg.norm(found.points[others] - found.points[first], axis=1)
    assert (apart >= 2.5).all()


def test_the_same_map_with_any_number_of_threads():
    scenario = SCENARIOS["phantom"]
    one, two = map_entries(scenario, threads=1), map_entries(scenario, threads=2)
    for each in fields(one)[1:]:
        np.testing.assert_array_equal(getattr(one, each.name), getattr(two, each.name))


def test_entries_beyond_the_free_slope_are_marked():
    """A needle that hardly bends reaches the target only from entries within slope times depth of it."""
    few = {**FREE, **TARGET, "entry.free_slope_mrad": 50.0, "needle.bevel.offset_mm": 0.05}
    found = map_entries(flexneedle.load_scenario("phantom").with_values(few))
    away = np.abs(found.points[:, 0] - 2.0)
    assert found.reached[away < 1.5].all()
    assert not found.reached[away > 3.0].any()
    assert (found.error_mm[~found.reached] > 0.1).all()
    assert np.isinf(found.clearance_mm).all()
    assert (found.clear == found.reached).all()


def test_no_entry_is_clear_where_the_target_is_in_a_margin():
    near = {**SPHERE, "center_mm": [40.0, 5.0, 0.0]}
    found = map_entries(SCENARIOS["phantom"].with_values({"zone": [near]}))
    assert found.reached.any()
    assert not found.clear.any()
    assert found.best(3) == []
    assert not found.offset_mm.any()


def test_a_fixed_entry_has_no_map():
    for key in ("free_radius_mm", "free_slope_mrad"):
        with pytest.raises(InputError, match=f"^entry.{key} = 0: "):
            map_entries(SCENARIOS["phantom"].with_values({f"entry.{key}": 0.0}))
