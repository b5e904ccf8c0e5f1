"""Plans that avoid zones: unchanged where nothing conflicts, clear by two models, refused with reasons otherwise."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.planning import planner
from flexneedle.planning.avoidance import make_room
from flexneedle.planning.carry_out import make_rollout
from flexneedle.planning.primitives import make_controls
from flexneedle.planning.problem import make_problem
from flexneedle.planning.second_opinion import exact_clearances
from flexneedle.planning.ways import Responses, rate
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import zones_of
from flexneedle.types import DG_Y, X, Y, across

FREE = {"entry.free_radius_mm": 15.0, "entry.free_slope_mrad": 200.0}


def sphere(center, radius, name="artery"):
    return {"shape": "sphere", "name": name, "center_mm": list(center), "radius_mm": radius}


def with_zones(*zones, preset="phantom", **values):
    return load_scenario(preset).with_values({"zone": list(zones), **values})


def in_the_way(preset, **values):
    """A zone in the middle of the path of the plan without zones."""
    plan = flexneedle.plan(load_scenario(preset).with_values(FREE | values))
    at = plan.tips[np.searchsorted(plan.tips[:, X], 20.0), :3]
    return with_zones(sphere(at.tolist(), 0.7), preset=preset, **FREE, **values)


@pytest.mark.parametrize("values", [{}, FREE], ids=["fixed", "free"])
def test_a_plan_that_keeps_all_margins_is_the_same_to_the_bit(values):
    free = flexneedle.plan(load_scenario("phantom").with_values(values))
    plan = flexneedle.plan(with_zones(sphere((20.0, 15.0, 0.0), 3.0), **values))
    np.testing.assert_array_equal(plan.controls, free.controls)
    assert plan.cost == free.cost
    assert plan.history == free.history
    assert plan.intrusion_mm == 0.0
    assert 5.0 < plan.least_clearance_mm < 12.0
    assert math.isinf(free.least_clearance_mm)


@pytest.mark.parametrize("preset", ["phantom", pytest.param("phantom3d", marks=pytest.mark.long)])
def test_a_zone_in_the_way_is_passed_at_its_margin_by_both_models(preset):
    scenario = in_the_way(preset)
    plan = flexneedle.plan(scenario)
    zones = zones_of(scenario)
    assert plan.hit
    assert plan.error_mm < 0.1
    assert plan.least_clearance_mm >= 2.0
    assert zones.shape_clearances(plan.shapes).min() == pytest.approx(plan.least_clearance_mm, abs=0.3)
    exact = exact_clearances(plan.scenario, zones, plan.controls, plan.roll)
    assert exact.min() >= 2.0
    assert plan.least_clearance_mm <= exact.min() + 1e-9
    assert flexneedle.plan(scenario).controls.tobytes() == plan.controls.tobytes()


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_a_plan_past_a_zone_leaves_room_to_correct(preset):
    """The target is in the inner half of the bevel's reach from the entry, and the zone is farther than its margin."""
    plan = flexneedle.plan(in_the_way(preset))
    depth = plan.target[0]
    least, greatest = planner.bevel_reach(
        plan.scenario.with_values({"target.lateral_mm": 0.0, "target.lateral_z_mm": 0.0}), depth
    )
    off = abs(complex(*plan.target[1:]) - plan.scenario.entry.lateral(depth))
    assert off <= 0.5 * 0.5 * (greatest - least) + 0.02
    assert plan.least_clearance_mm >= 2.8


def test_margins_of_zones_count_each_by_itself():
    scenario = in_the_way("phantom")
    wide = flexneedle.plan(scenario.with_values({"zone.0.margin_mm": 2.8}))
    assert wide.intrusion_mm == 0.0
    assert wide.least_clearance_mm >= 2.8


def test_a_bound_of_the_error_of_the_registration_is_added():
    scenario = in_the_way("phantom").with_values({"image.sd_mm": 0.4})
    plan = flexneedle.plan(scenario)
    known = zones_of(scenario.with_values({"image.sd_mm": 0.0}))
    assert zones_of(scenario).added - known.added == pytest.approx([2.33 * 0.4])
    assert plan.intrusion_mm == 0.0
    assert known.shape_clearances(plan.shapes).min() >= 2.7


def test_without_a_way_the_plan_names_zone_distance_and_what_would_help():
    (x, y, z) = in_the_way("phantom").zone[0].center_mm
    plan = flexneedle.plan(with_zones(sphere((x, y, z), 1.3)))
    assert plan.intrusion_mm > 0.0
    assert not plan.reached
    assert "zone artery (margin 2 mm)" in plan.refusal
    assert plan.limit.startswith("zone artery; ")
    assert "entry.free_" in plan.limit
    with pytest.raises(flexneedle.FlexneedleError, match="artery"):
        flexneedle.insert(plan.scenario, plan)


def test_the_bevel_alone_avoids_zones_from_a_free_entry():
    scenario = in_the_way("phantom")
    plan = flexneedle.plan(scenario, strategy="steering")
    assert plan.intrusion_mm == 0.0
    assert plan.error_mm < 0.5
    assert not plan.controls[:, DG_Y].any()


def test_a_sketch_goes_round_zones():
    found = planner.sketch(in_the_way("phantom"))
    assert found.reached
    assert found.intrusion_mm == 0.0


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_superposed_paths_are_near_the_paths_of_rollouts(preset):
    """The effect of an entry to within a tenth of it, of the guide to within a third."""
    scenario = with_zones(sphere((20.0, 5.0, 0.0), 3.0), preset=preset, **FREE)
    simulator = Simulator(scenario)
    problem = make_problem(scenario, scenario.target.position, "manipulation")
    rollout = make_rollout(simulator, (), at_end=("shapes",))
    responses = Responses.of(rollout, problem)
    ways = responses.at_entries()
    moved = responses.with_guide(ways, np.zeros(len(ways.z)), np.random.default_rng(0))
    gentle = np.abs(moved.z[:, responses.columns]).max(axis=1) < 0.1
    for found, most in ((ways, 1.0), (moved.take(np.flatnonzero(gentle)), 2.0)):
        some = found.take(slice(0, None, max(1, len(found.z) // 20)))
        tips = rollout(make_controls(problem, some.z)[0]).tips
        for row, line in zip(tips, some.paths, strict=True):
            inside = row[:, X] > 1.0
            expected = np.interp(row[inside, X], some.depths, line.real)
            assert np.abs(across(row[inside], Y).real - expected).max() < most


def test_ways_end_at_the_target_and_are_rated_by_their_intrusion():
    scenario = with_zones(sphere((20.0, 2.0, 0.0), 3.0), **FREE)
    zones = zones_of(scenario)
    problem = replace(make_problem(scenario, scenario.target.position, "manipulation"), clear=zones.margin)
    rollout = make_rollout(Simulator(scenario), (), at_end=("shapes",))
    ways = Responses.of(rollout, problem).at_entries()
    assert np.abs(ways.paths[:, -1] - scenario.target.lateral_mm).max() < 1e-9
    costs = rate(problem, ways, make_room(scenario, zones))
    points = np.stack(
        [np.broadcast_to(ways.depths, ways.paths.shape), ways.paths.real, ways.paths.imag], axis=-1
    )
    distance = np.linalg.norm(points - [20.0, 2.0, 0.0], axis=-1).min(axis=1) - 3.0 - zones.radius
    best = int(costs.argmin())
    assert distance[best] > 2.0
    assert (costs[distance < 0.0] > 2.0).all()
