"""Plans for drivers with a limited range of rotation, and what keeps a plan in space from its target."""

import cmath
import math
from functools import cache

import numpy as np
import pytest

import flexneedle
from flexneedle.planning import planner, steering
from flexneedle.planning.planner import bevel_reach
from flexneedle.planning.primitives import make_controls
from flexneedle.planning.problem import PlanProblem, make_problem
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import Limits
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import ROLL

DEPTH = 25.0
SPACE = flexneedle.load_scenario("phantom3d").with_values(
    {
        "target.depth_mm": DEPTH, "plan.samples": 32, "plan.iterations": 12, "plan.max_iterations": 12,
        "needle.nodes": 31, "setup.tip_to_skin_mm": 6.0,
    }
)  # fmt: skip
STEER, MOVE = "steering", "manipulation"


@cache
def reach():
    """Distance (mm) from the axis that the bevel reaches at the target's depth."""
    return bevel_reach(SPACE, DEPTH, threads=1)[1]


def planned(off, strategy=STEER, seed=0, **changes):
    """A plan to a target at y + iz (mm)."""
    scenario = SPACE.with_values({key.replace("__", "."): value for key, value in changes.items()})
    return flexneedle.plan(scenario, (DEPTH, off.real, off.imag), strategy, seed, threads=1)


def assert_legal(plan):
    """Assert that the start roll and every step keep the simulator's limits."""
    limits = Limits.of(plan.scenario)
    start = np.zeros((1, 9))
    start[0, ROLL] = plan.roll
    limits.check(np.zeros(7), start)
    limits.check(np.zeros(7), plan.controls, plan.roll)


def inside(most, direction, share):
    """A place (mm) at a share of the way from the middle of the reach to its edge: a disc cut by a chord."""
    chord = math.cos(math.radians(min(most, 180.0)))
    middle, way = 0.5 * (1.0 + chord), cmath.rect(1.0, math.radians(direction))
    sizes = np.linspace(0.0, 2.0, 4001)
    at = middle + sizes * way
    edge = sizes[(np.abs(at) <= 1.0) & (at.real >= chord)].max()
    return reach() * (middle + share * edge * way)


@pytest.mark.parametrize(
    ("most", "direction"),
    [
        (45.0, 135.0), (90.0, 180.0), (120.0, 270.0), (135.0, 180.0), (270.0, 180.0),
        *(pytest.param(*one, marks=pytest.mark.long) for one in (
            (45.0, 0.0), (90.0, 270.0), (120.0, 0.0), (135.0, 135.0), (180.0, 0.0), (180.0, 135.0), (270.0, 270.0),
        )),
    ],
)  # fmt: skip
def test_every_target_in_reach_of_the_range_is_reached_within_it(most, direction):
    plan = planned(inside(most, direction, 0.9), setup__max_rotation_deg=most)
    assert_legal(plan)
    assert plan.error_mm < 0.05
    assert plan.limit == ""


@pytest.mark.parametrize("strategy", [STEER, MOVE])
def test_a_target_behind_the_range_is_aimed_at_from_within_it(strategy):
    plan = planned(-2.0 + 0.5j, strategy, setup__max_rotation_deg=90.0, setup__guide_axes=1)
    assert_legal(plan)


def test_where_half_a_turn_is_in_the_range_a_free_driver_has_the_same_plan():
    """The angles are the same; rolls go to and fro."""
    free, limited = (
        planned(-0.4 + 0.3j, setup__max_rotation_deg=most, plan__roll_weight_mm=0.0) for most in (None, 180.0)
    )
    assert limited.roll == free.roll
    assert limited.cost == pytest.approx(free.cost, rel=1e-6)
    np.testing.assert_allclose(limited.tips, free.tips, atol=1e-6)


def test_beyond_the_hull_the_range_is_named_and_beyond_the_disc_the_bevel():
    """The messages state the reach, and the reach times cos 60°, the least towards angle 0."""
    near, side, far = (
        planned(off, setup__max_rotation_deg=60.0, plan__iterations=2, plan__max_iterations=2).limit
        for off in (0.3 * reach() + 0j, 0.8j * reach(), 2.0 * reach() + 0j)
    )
    assert near.startswith("setup.max_rotation_deg = 60")
    assert f"{0.5 * reach():.3f} to {reach():.3f} mm" in near
    assert side.startswith("setup.max_rotation_deg = 60")
    assert "nothing" in side
    assert far.startswith(f"needle.bevel.offset_mm = {SPACE.needle.bevel.offset_mm:g}")
    assert f"at most {reach():.3f} mm" in far


@pytest.mark.parametrize(
    ("most", "angle", "least", "greatest"),
    [
        (None, 70.0, -1.0, 1.0), (200.0, 70.0, -1.0, 1.0), (135.0, 0.0, math.cos(math.radians(135.0)), 1.0),
        (135.0, 180.0, -1.0, -math.cos(math.radians(135.0))), (90.0, 90.0, -1.0, 1.0), (90.0, 180.0, -1.0, 0.0),
        (60.0, 30.0, 0.5 / math.cos(math.radians(30.0)), 1.0), (60.0, 90.0, math.inf, -math.inf),
    ],
)  # fmt: skip
def test_reach_in_a_direction_is_what_the_hull_of_the_arc_leaves_of_a_line(most, angle, least, greatest):
    """The axis is lateral and steep."""
    scenario = SPACE.with_values(
        {"setup.max_rotation_deg": most, "entry.lateral_mm": 3.0, "entry.slope_z_mrad": 50.0}
    )
    goal = scenario.entry.lateral(DEPTH) + cmath.rect(1.0, math.radians(angle))
    problem = make_problem(scenario, (DEPTH, goal.real, goal.imag), STEER)
    rollout = planner.make_rollout(Simulator(scenario, threads=1), ())
    expected = [reach() * least, reach() * greatest]
    np.testing.assert_allclose(steering.reach(rollout, problem), expected, rtol=0.02, atol=1e-6)
    assert problem.lateral == pytest.approx(1.0)


# ---- wrapped directions


@pytest.mark.parametrize(
    ("most", "wanted", "expected"),
    [
        (90.0, [170.0, -170.0, 20.0], [90.0, -90.0, 20.0]),
        (180.0, [170.0, -170.0, 20.0], [170.0, -170.0, 20.0]),
        (270.0, [170.0, -170.0, 20.0], [170.0, 190.0, 20.0]),
        (270.0, [170.0, -100.0, -60.0], [170.0, 260.0, -60.0]),
        (270.0, [-150.0, 100.0, 80.0], [-150.0, -260.0, 80.0]),
        (90.0, [20.0, 22.0, 60.0], [20.0, 60.0]),  # a roll below 0.1 rad is not made
    ],
)
def test_rolls_take_the_shortest_way_that_the_range_has(most, wanted, expected):
    ones = np.ones(7)
    problem = PlanProblem(
        (30.0, 0.0, 0.0), 60.0, 30.0, 3, ones, ones, np.ones(9), PlanSettings(), axes=2,
        half_turns=False, rotation=math.radians(most),
    )  # fmt: skip
    z = np.zeros((1, 3, problem.coordinates))
    z[0, :, 0] = 1.0
    z[0, :, problem.bevel] = np.stack([np.cos(np.radians(wanted)), np.sin(np.radians(wanted))], axis=1)
    rows, _ = make_controls(problem, z.reshape(1, -1))
    angles = np.degrees(np.cumsum(rows[0, :, ROLL]))[rows[0, :, ROLL] != 0.0]
    np.testing.assert_allclose(angles, expected)


# ---- axis and limits


@pytest.mark.parametrize("axes", [1, 2])
def test_reach_is_about_the_axis_of_the_entry(axes):
    entry = {"setup.axes": axes, "entry.lateral_mm": 3.0, "entry.slope_mrad": 50.0}
    least, greatest = bevel_reach(SPACE.with_values({**entry, "target.lateral_z_mm": 0.0}), DEPTH, threads=1)
    middle = 3.0 + 0.05 * DEPTH
    assert (least, greatest) == pytest.approx((middle - reach(), middle + reach()), abs=0.02)


@pytest.mark.parametrize("off", [-3.0 + 0.0j, 2.0 - 4.0j])
def test_beyond_the_bevel_the_distance_from_the_axis_is_reported(off):
    """The axis is at y = 5.5, z = 1."""
    entry = {"entry__lateral_mm": 3.0, "entry__slope_mrad": 100.0, "entry__lateral_z_mm": 1.0}
    plan = planned(5.5 + 1.0j + off, **entry)
    opening, rest = plan.limit.split(" (")
    assert opening.startswith("needle.bevel.offset_mm")
    numbers = [float(word) for word in rest.split() if word.lstrip("-").replace(".", "").isdigit()]
    assert numbers == pytest.approx([-reach(), reach(), abs(off)], abs=0.03)
    assert plan.error_mm == pytest.approx(abs(off) - reach(), abs=0.05)


@pytest.mark.parametrize(
    ("off", "strategy", "changes", "limit"),
    [
        (1.0 + 6.0j, MOVE, {"guide_axes": 1}, "setup.guide_axes = 1 (along z only the bevel steers, by up to"),
        (1.0 + 6.0j, MOVE, {"guide_axes": 1, "max_rotation_deg": 20.0}, "setup.guide_axes = 1 (along z only"),
        (1.0 + 6.0j, MOVE, {"guide_axes": 1, "rotation": "half-turns"}, "setup.guide_axes = 1 (nothing else"),
        (0.1 + 6.0j, STEER, {"rotation": "half-turns"}, 'setup.rotation = "half-turns" (nothing steers along z'),
        (1.0 + 9.0j, MOVE, {"max_guide_step_mm": 1e-3}, "setup.max_guide_step_mm = 0.001"),
        (0.0 + 9.0j, MOVE, {"max_guide_travel_mm": 9.0, "max_guide_step_mm": 1e-3}, "setup.max_guide_step_mm"),
    ],
)  # fmt: skip
def test_the_limit_of_a_rig_is_named(off, strategy, changes, limit):
    plan = planned(off, strategy, **{f"setup__{key}": value for key, value in changes.items()})
    assert plan.error_mm > 1.0
    assert plan.limit.startswith(limit)


def test_a_range_that_keeps_the_bevel_from_z_is_named():
    """At this depth the bevel would reach 1.6 mm along z; with angles up to 10° it reaches 0.3 mm."""
    scenario = SPACE.with_values({"setup.guide_axes": 1, "setup.max_rotation_deg": 10.0})
    plan = flexneedle.plan(scenario, (40.0, 1.0, 1.6), MOVE, threads=1)
    assert plan.error_mm > 1.0
    assert plan.limit.startswith("setup.max_rotation_deg = 10")
    assert "0.312 mm" in plan.limit


@pytest.mark.parametrize(
    ("changes", "limit"),
    [
        ({"setup.max_base_travel_mm": 9.0, "setup.max_base_step_mm": 1e-3}, "setup.max_base_step_mm = 0.001"),
        ({"plan.base_sigma_mm": 0.0, "plan.base_turn_sigma_mrad": 1.0, "setup.max_base_turn_step_mrad": 0.01},
         "setup.max_base_turn_step_mrad = 0.01"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("off", [8.0, 8.0j])
def test_limits_of_the_base_are_named_where_it_moves(changes, limit, off):
    values = {"setup.guide_to_skin_mm": None, "plan.base_sigma_mm": 0.2, **changes}
    scenario = SPACE.with_values({"target.lateral_mm": 0.0, "target.lateral_z_mm": 0.0, **values})
    plan = flexneedle.plan(scenario, (DEPTH, complex(off).real, complex(off).imag), MOVE, threads=1)
    assert not plan.reached
    assert plan.limit == limit
