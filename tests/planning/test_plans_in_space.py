"""Plans in space: targets in any direction, the rig's axes and rotation, and a free entry."""

import math

import numpy as np
import pytest

import flexneedle
from flexneedle.planning.entry import entry_bounds, mount_needle
from flexneedle.planning.planner import bevel_reach
from flexneedle.planning.problem import PlanProblem
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_PSI, DB_THETA, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, across

PHANTOM = flexneedle.load_scenario("phantom").with_values(
    {
        "setup.axes": 2, "target.depth_mm": 25.0, "plan.samples": 48, "plan.max_iterations": 25,
        "needle.nodes": 31, "setup.tip_to_skin_mm": 6.0,
    }
)  # fmt: skip


def planned(direction=0.0, off=3.0, strategy="manipulation", **changes):
    values = {
        "target.lateral_mm": off * math.cos(direction),
        "target.lateral_z_mm": off * math.sin(direction),
        **{key.replace("__", "."): value for key, value in changes.items()},
    }
    return flexneedle.plan(PHANTOM.with_values(values), strategy=strategy, threads=1)


@pytest.mark.parametrize("strategy", ["manipulation", "steering"])
def test_a_target_in_another_direction_has_the_same_plan_turned(strategy):
    """With a guide on two axes and any roll, only the limits of a step prefer a direction."""
    first, turn = planned(0.3, strategy=strategy), 1.9
    second = planned(0.3 + turn, strategy=strategy)
    assert second.cost == pytest.approx(first.cost, rel=1e-3)
    by = np.exp(1j * turn)
    np.testing.assert_allclose(across(second.tips, 1), across(first.tips, 1) * by, atol=0.01)
    np.testing.assert_allclose(across(second.guide, 0), across(first.guide, 0) * by, atol=0.03)
    turned = np.exp(1j * (second.roll - first.roll))
    assert turned == pytest.approx(by, abs=1e-3)


def test_a_plan_in_the_plane_is_one_in_space():
    """The same steps in space: z is 0, tips and energy are the same within the solve's tolerance."""
    plane = flexneedle.plan(PHANTOM.with_values({"setup.axes": 1}), (25.0, 3.0), threads=1)
    simulator = Simulator(PHANTOM, threads=1)
    replayed = simulator.rollout(simulator.start(plane.roll), plane.controls[None], outputs=("energy",))
    np.testing.assert_allclose(replayed.tips[0], plane.tips[1:], atol=3e-6)
    assert (replayed.tips[0][:, [2, 4]] == 0.0).all()
    np.testing.assert_allclose(replayed.energy[0], plane.strain_energy[1:], rtol=1e-5, atol=1e-9)


def test_a_guide_on_one_axis_leaves_the_other_to_the_bevel():
    plan = planned(0.9, off=1.2, setup__guide_axes=1)
    assert (plan.controls[:, DG_Z] == 0.0).all()
    assert (plan.guide[:, 1] == 0.0).all()
    assert plan.error_mm < 0.1


def test_a_driver_of_half_turns_has_no_other_rolls():
    plan = planned(0.9, setup__rotation="half-turns")
    rolls = np.append(plan.controls[:, ROLL], plan.roll) / math.pi
    np.testing.assert_allclose(rolls, np.rint(rolls), atol=1e-12)
    assert plan.error_mm < 0.1


# ---- the entry


@pytest.mark.parametrize(
    ("strategy", "axes"),
    [
        *(("manipulation", 1), ("steering", 2)),
        *(pytest.param(*one, marks=pytest.mark.long) for one in (("manipulation", 2), ("steering", 1))),
    ],
)
def test_a_free_entry_is_chosen_within_its_bounds(strategy, axes):
    """The plan's scenario has the chosen entry, and the needle starts on it."""
    values = {"entry__free_radius_mm": 4.0, "entry__free_slope_mrad": 40.0, "setup__axes": axes}
    plan = planned(0.0 if axes == 1 else 0.8, off=4.0, strategy=strategy, **values)
    entry = plan.scenario.entry
    assert not entry.free
    assert abs(entry.lateral(0.0)) <= 4.0 + 1e-9
    assert abs(entry.slope) <= 0.04 + 1e-9
    assert abs(entry.lateral(25.0)) > 0.1  # not at the origin
    assert plan.error_mm < 0.2
    straight = plan.scenario.start_base_x, plan.scenario.setup.guide_x, plan.scenario.setup.start_tip_x
    base, guide = (entry.lateral(x) for x in straight[:2])
    first = Simulator(plan.scenario, threads=1).start(plan.roll)
    np.testing.assert_allclose(first.base[1:3], [base.real, base.imag], atol=1e-12)
    np.testing.assert_allclose(first.guide, [guide.real, guide.imag], atol=1e-12)
    np.testing.assert_allclose(first.travel, 0.0, atol=1e-12)
    np.testing.assert_array_equal(plan.tips[0], first.tip)


def test_with_the_bevel_alone_a_free_entry_leaves_it_room_to_correct():
    """The target is in the inner half of the bevel's reach, whose width an entry does not change."""
    plan = planned(0.8, off=4.0, strategy="steering", entry__free_radius_mm=6.0)
    least, greatest = bevel_reach(
        plan.scenario.with_values({"target.lateral_mm": 0.0, "target.lateral_z_mm": 0.0}), 25.0
    )
    off = abs(complex(*plan.target[1:]) - plan.scenario.entry.lateral(25.0))
    assert off <= 0.5 * 0.5 * (greatest - least) + 0.02


@pytest.mark.parametrize("axes", [1, 2])
def test_a_sample_of_the_entry_is_a_line_within_its_disc(axes):
    """Base and guide are on the line; corners of the bounds are on the circle, in the frame's direction."""
    goal = (30.0, 0.0, 0.0)
    one = np.ones(7)
    problem = PlanProblem(
        goal, 60.0, 30.0, 1, one, one, np.ones(5 + 3 * axes), PlanSettings(), axes=axes,
        frame=1.0 if axes == 1 else 1.0j, entry=(2.0, 0.05), mounts=(-150.0, -40.0),
    )  # fmt: skip
    bounds = entry_bounds(problem)
    z = np.stack([0.0 * bounds, 0.5 * bounds, bounds])
    rows = controls(3, 4, db_x=1.0)
    rows[:, 0, ROLL] = 0.7
    all_rows = mount_needle(problem, rows, z)
    first = all_rows[:, 0]
    np.testing.assert_array_equal(all_rows[:, 1:, 0], 1.0)
    assert (first[:, 0] == 0.0).all()
    np.testing.assert_array_equal(first[:, ROLL], 0.7)
    assert (all_rows[:, 1:, ROLL] == 0.0).all()
    slope = across(first, DB_THETA)
    point = across(first, DB_Y) + 150.0 * slope
    np.testing.assert_allclose(across(first, DG_Y), point - 40.0 * slope, atol=1e-12)
    np.testing.assert_allclose(np.abs(point), [0.0, 1.0 if axes == 1 else math.sqrt(2.0), 2.0], atol=1e-12)
    np.testing.assert_allclose(
        np.abs(slope), [0.0, 0.025 if axes == 1 else 0.05 / math.sqrt(2.0), 0.05], atol=1e-12
    )
    if axes == 2:
        np.testing.assert_allclose(np.angle(point[1:]), 0.75 * math.pi)
    else:
        assert (first[:, [DB_Z, DB_PSI, DG_Z]] == 0.0).all()
