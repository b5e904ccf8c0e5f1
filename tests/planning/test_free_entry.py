"""Free entries that limits hold: the slope on each axis, and the lateral travel to the target."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import flexneedle
from flexneedle.errors import ScenarioError
from flexneedle.planning.entry import entry_bounds, read_entry
from flexneedle.planning.problem import make_problem
from flexneedle.scenario.sections.apparatus import Entry
from flexneedle.simulator.control import Limits

FEW = {"plan.samples": 32, "plan.max_iterations": 15, "needle.nodes": 31, "setup.tip_to_skin_mm": 6.0}
SHORT = {
    "plan.samples": 16,
    "plan.iterations": 3,
    "plan.max_iterations": 3,
}  # legal from the first iteration on
PLANE, SPACE = (flexneedle.load_scenario(name).with_values(FEW) for name in ("phantom", "phantom3d"))
DEPTH = 40.0
STEEP = {"entry.slope_mrad": 190.0, "entry.free_slope_mrad": 100.0}
CORNER = {**STEEP, "entry.slope_z_mrad": -190.0}
LATERAL = {"entry.lateral_mm": 14.0, "entry.free_radius_mm": 5.0}
NEAR = {"entry.free_radius_mm": 5.0}
BOTH = {"entry.free_radius_mm": 5.0, "entry.free_slope_mrad": 100.0}
CASES = [
    (PLANE, STEEP, (8.0,)), (PLANE, STEEP, (20.0,)), (PLANE, LATERAL, (5.0,)), (PLANE, LATERAL, (-5.5,)),
    (PLANE, NEAR, (20.0,)), (PLANE, NEAR, (19.0,)), (SPACE, CORNER, (20.0, -9.0)), (SPACE, LATERAL, (-5.0, 3.0)),
    (SPACE, NEAR, (18.0, 18.0)), (SPACE, BOTH, (19.0, -19.0)), (SPACE, BOTH, (1.0, 2.0)),
]  # fmt: skip


def aimed(scenario, entry, off):
    keys = ("target.lateral_mm", "target.lateral_z_mm")
    return scenario.with_values({"target.depth_mm": DEPTH, **entry, **dict(zip(keys, off, strict=False))})


@pytest.mark.parametrize("strategy", ["manipulation", "steering"])
@pytest.mark.parametrize(("scenario", "entry", "off"), CASES)
def test_the_entry_of_a_plan_is_legal(scenario, entry, off, strategy):
    """The plan's scenario has been checked; its controls keep their limits."""
    free = aimed(scenario.with_values(SHORT), entry, off)
    plan = flexneedle.plan(free, strategy=strategy, threads=1)
    chosen = plan.scenario.entry
    assert abs(chosen.lateral(0.0) - free.entry.lateral(0.0)) <= free.entry.free_radius_mm + 1e-9
    assert abs(chosen.slope - free.entry.slope) <= 1e-3 * free.entry.free_slope_mrad + 1e-9
    assert max(abs(chosen.slope_mrad), abs(chosen.slope_z_mrad)) <= 200.0
    left = complex(*plan.target[1:]) - chosen.lateral(DEPTH)
    assert max(abs(left.real), abs(left.imag)) <= free.setup.max_guide_travel_mm + 1e-6
    Limits.of(plan.scenario).check(np.zeros(7), plan.controls, plan.roll)


@given(which=st.integers(0, len(CASES) - 1), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_every_sample_of_the_entry_is_legal(which, seed):
    """Random samples are moved into the limits."""
    free = aimed(*CASES[which])
    problem = make_problem(free, free.target.position, "steering")
    bounds = entry_bounds(problem)
    z = np.random.default_rng(seed).uniform(-1.0, 1.0, (64, bounds.size)) * bounds
    point, slope = read_entry(problem, z)
    assert (np.abs(point) <= problem.entry[0] + 1e-9).all()
    assert (np.abs(slope) <= problem.entry[1] + 1e-9).all()
    steep, left = free.entry.slope + slope, problem.across - point - slope * DEPTH
    assert max(np.abs(steep.real).max(), np.abs(steep.imag).max()) <= 0.2 + 1e-12
    assert max(np.abs(left.real).max(), np.abs(left.imag).max()) <= free.setup.max_guide_travel_mm + 1e-6


def test_with_the_bevel_alone_a_limit_of_the_slope_turns_the_bevel_to_what_is_left():
    """The slope may leave 1 mm along −z; the bevel turns there, not from the present axis to the target."""
    plan = flexneedle.plan(aimed(SPACE, CORNER, (8.0, -9.0)), strategy="steering", threads=1)
    assert plan.scenario.entry.slope_z_mrad == pytest.approx(-200.0)
    assert math.degrees(plan.roll) % 180.0 == pytest.approx(90.0)


def test_a_target_that_no_free_entry_brings_into_reach_is_refused():
    """19 mm on each axis: 4 mm too far on both, 5.7 mm together; and a slope that has 10 mrad left to one side."""
    with pytest.raises(ScenarioError, match=r"target\.lateral_z_mm both within 15"):
        aimed(SPACE, NEAR, (19.0, 19.0))
    with pytest.raises(ScenarioError, match=r"from -11\.4 to 23"):
        aimed(PLANE, STEEP, (23.1,))


@given(
    off=st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0)), radius=st.floats(0.0, 10.0),
    slope=st.floats(0.0, 200.0), now=st.tuples(st.floats(-200.0, 200.0), st.floats(-200.0, 200.0)),
)  # fmt: skip
@settings(max_examples=100)
def test_the_nearest_entry_is_as_near_as_any(off, radius, slope, now):
    """It is compared with a few hundred other permitted entries."""
    entry = Entry(slope_mrad=now[0], slope_z_mrad=now[1], free_radius_mm=radius, free_slope_mrad=slope)
    place, most = complex(*off), 5.0

    def beyond(point, change):
        left = place - point - change * DEPTH
        return np.hypot(*(np.maximum(np.abs(part) - most, 0.0) for part in (left.real, left.imag)))

    rng = np.random.default_rng(0)
    points, changes = (
        size * np.sqrt(rng.uniform(size=300)) * np.exp(2j * np.pi * rng.uniform(size=300))
        for size in (radius, 1e-3 * slope)
    )
    legal = np.array([entry.steepening(one) for one in changes])
    point, change = entry.nearest(place, DEPTH, most)
    assert abs(point) <= radius + 1e-9
    assert abs(change) <= 1e-3 * slope + 1e-9
    assert beyond(point, change) <= beyond(points, legal).min() + 0.01
