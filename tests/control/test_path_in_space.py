"""The path in space: guide on its axes, rolls to any angle, within the limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adaptive import corrected
from flexneedle.control.path import KNOTS, Ahead, GuidePath
from flexneedle.control.samples import propose_samples
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.control import Limits, controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DG_Y, DG_Z, ROLL, X

PHANTOM = load_scenario("phantom").with_values({"setup.axes": 2, "target.lateral_z_mm": 3.0})
RIGS = {
    "two axes": {},
    "one axis": {"setup.guide_axes": 1},
    "no guide": {"setup.guide_to_skin_mm": None},
    "half turns": {"setup.rotation": "half-turns"},
    "half a turn to either side": {"setup.max_rotation_deg": 180.0},
    "a quarter turn to either side": {"setup.max_rotation_deg": 90.0},
    "a sixth of a turn to either side": {"setup.max_rotation_deg": 60.0},
    "three quarters of a turn to either side": {"setup.max_rotation_deg": 270.0},
}
SAMPLES = st.integers(0, 2**32 - 1)


def ahead_of(rig, rolls=((20.0, 1.0), (30.0, -0.5)), left=30.0, roll=0.0):
    """The path from a needle 10 mm deep, with some rolls to come."""
    scenario = PHANTOM.with_values(RIGS[rig])
    simulator, setup = Simulator(scenario, threads=1), scenario.setup
    insert = controls(int(10 + setup.tip_to_skin_mm), db_x=1.0)
    state, _ = simulator.replay(simulator.start(roll), insert)
    x = float(state.tip[X])
    if setup.half_turns:
        rolls = [(depth, roll + math.pi * (k + 1)) for k, (depth, _) in enumerate(rolls)]
    grid = np.linspace(x, x + left, 20)
    guide = np.stack([0.05 * (grid - x), -0.03 * (grid - x)], axis=1)
    if setup.moved_guide_axes < 2:
        guide[:, 1] = 0.0
    path = GuidePath(
        grid, guide if setup.has_guide else 0.0 * guide, np.array(rolls, dtype=float).reshape(-1, 2)
    )
    depth = np.append(x + np.arange(3.0), x + np.arange(4.0, left + 0.5, 2.0))
    base = np.zeros((depth.size - 1, 4))
    step = setup.max_guide_step_mm if setup.has_guide else 0.0
    return Ahead(depth, base, state, path, setup, step, setup.moved_guide_axes or 1), scenario


def angles_of(ahead, rows):
    """The needle's angle after the roll of each step (…, m)."""
    return ahead.state.roll + np.cumsum(rows[..., ROLL], axis=-1)


@pytest.mark.parametrize("rig", RIGS)
@given(seed=SAMPLES)
@settings(max_examples=8)
def test_every_sample_is_within_the_limits_of_the_rig(rig, seed):
    """The guide moves on its axes only, the rotation stays in its range, and the depths increase to the target."""
    ahead, scenario = ahead_of(rig)
    rows, depth = ahead.controls(propose_samples(ahead, 24, np.random.default_rng(seed), 0.3 - 1.0j))
    limits = Limits.of(scenario)
    assert (np.diff(depth, axis=1) >= -1e-12).all()
    np.testing.assert_allclose(depth[:, -1], ahead.depth[-1])
    np.testing.assert_allclose(rows[:, :, DB_X], np.diff(depth, axis=1))
    travel = ahead.state.travel + np.cumsum(rows[:, :, :7], axis=1)
    assert (travel <= limits.travel[:, 1] + 1e-9).all()
    assert (travel >= limits.travel[:, 0] - 1e-9).all()
    per_step = np.maximum(rows[:, :, DB_X], 1e-12)[:, :, None] / scenario.setup.max_advance_mm
    assert (np.abs(rows[:, :, DG_Y : DG_Z + 1]) <= limits.step[DG_Y : DG_Z + 1] * per_step + 1e-9).all()
    angle = angles_of(ahead, rows)
    if scenario.setup.half_turns:
        np.testing.assert_allclose(np.abs(np.sin(angle)), 0.0, atol=1e-9)
    else:
        assert (np.abs(angle) <= scenario.setup.max_rotation + 1e-9).all()


@pytest.mark.parametrize("rig", RIGS)
def test_the_first_sample_is_the_current_path(rig):
    """Its guide, its rolls at their depths, and their angles."""
    ahead, scenario = ahead_of(rig)
    first = propose_samples(ahead, 24, np.random.default_rng(0))[0]
    np.testing.assert_array_equal(first, ahead.current)
    path = corrected(ahead, first)
    for axis in range(2):
        planned = np.interp(path.depth, ahead.path.depth, ahead.path.guide[:, axis])
        np.testing.assert_allclose(path.guide[:, axis], planned, atol=1e-12)
    np.testing.assert_allclose(path.rolls[:, 0], ahead.path.rolls[:, 0])
    wanted = np.clip(ahead.path.rolls[:, 1], -scenario.setup.max_rotation, scenario.setup.max_rotation)
    np.testing.assert_allclose(path.rolls[:, 1], wanted)


def test_a_knot_moves_the_guide_on_its_own_axis():
    """0.1 mm at the last knot of z change z alone, in proportion between the knots."""
    ahead, _ = ahead_of("two axes")
    z = ahead.current
    z[2 * KNOTS.size - 1] += 0.1
    before, after = corrected(ahead, ahead.current), corrected(ahead, z)
    np.testing.assert_allclose(after.guide[:, 0], before.guide[:, 0], atol=1e-12)
    share = (after.depth - after.depth[0]) / ahead.left
    wanted = 0.1 * np.interp(share, [KNOTS[-2], KNOTS[-1]], [0.0, 1.0])
    np.testing.assert_allclose(after.guide[:, 1] - before.guide[:, 1], wanted, atol=1e-9)


def test_a_roll_due_now_is_made_at_once_and_the_next_step_ends_at_the_following_one():
    ahead, _ = ahead_of("two axes")
    x = float(ahead.depth[0])
    path = replace(ahead.path, rolls=np.array([[x - 1.0, 2.0], [x + 0.01, 0.7], [x + 0.4, -1.0]]))
    command, rest = ahead.first_command(path)
    assert command.roll == pytest.approx(0.7 - ahead.state.roll)
    assert command.db_x == pytest.approx(0.4)
    np.testing.assert_array_equal(rest.rolls, [[x + 0.4, -1.0]])


def test_two_half_turns_that_are_due_cancel():
    ahead, _ = ahead_of("half turns")
    x = float(ahead.depth[0])
    two = np.array([[x - 1.0, math.pi], [x, 2.0 * math.pi]])
    assert ahead.first_command(replace(ahead.path, rolls=two))[0].roll == 0.0
    assert ahead.first_command(replace(ahead.path, rolls=two[:1]))[0].roll == math.pi


@given(seed=SAMPLES)
@settings(max_examples=15)
def test_the_needle_has_the_angle_of_the_last_roll_behind_it(seed):
    """The rolls are random, at different depths."""
    ahead, _ = ahead_of("two axes")
    rng = np.random.default_rng(seed)
    z = ahead.current
    depths = ahead.depth[0] + np.array([4.1, 11.3, 19.7, 26.2]) + rng.uniform(-1.0, 1.0, 4)
    angles = np.cumsum(rng.choice([-1.0, 1.0], 4) * rng.uniform(0.2, 1.5, 4))
    order = rng.permutation(4)
    z[ahead.depths], z[ahead.angles] = depths[order], angles[order]
    rows, depth = ahead.controls(z[None])
    np.testing.assert_allclose(corrected(ahead, z).rolls, np.stack([depths, angles], axis=1), atol=1e-9)
    middle, angle = 0.5 * (depth[0, 1:] + depth[0, :-1]), angles_of(ahead, rows)[0]
    behind = np.searchsorted(depths, middle)
    np.testing.assert_allclose(angle, np.append(ahead.state.roll, angles)[behind], atol=1e-9)


@given(seed=SAMPLES)
@example(seed=115)  # rolls that share the last step
@settings(max_examples=20)
def test_no_roll_goes_the_long_way_round(seed):
    """Samples may have any angle, and several rolls may be due at once."""
    ahead, _ = ahead_of("two axes", roll=2.0)
    rng = np.random.default_rng(seed)
    samples = propose_samples(ahead, 24, rng)
    samples[:, ahead.angles] += rng.uniform(-12.0, 12.0, samples[:, ahead.angles].shape)
    rows, _ = ahead.controls(samples)
    assert (np.abs(rows[..., ROLL]) <= math.pi + 1e-9).all()
    x = float(ahead.depth[0])
    now = GuidePath(ahead.path.depth, ahead.path.guide, np.array([[x, 5.0], [x, 7.9]]))
    command, _ = ahead.first_command(now)
    assert command.roll == pytest.approx(math.remainder(7.9 - 2.0, 2.0 * math.pi))


def test_of_two_rolls_at_one_depth_the_second_counts():
    ahead, _ = ahead_of("two axes", rolls=())
    z = ahead.current
    z[ahead.depths][:] = ahead.unused
    at = float(ahead.depth[5]) + 0.2
    z[ahead.depths.start : ahead.depths.start + 2] = at, at + 1e-3
    z[ahead.angles.start : ahead.angles.start + 2] = 1.0, -2.0
    np.testing.assert_allclose(corrected(ahead, z).rolls, [[at + 1e-3, -2.0]])


@pytest.mark.parametrize("rig", ["two axes", "no guide"])
def test_pairs_of_rolls_point_to_either_side_of_the_aim(rig):
    """Half of them roll now."""
    ahead, _ = ahead_of(rig, rolls=())
    z = propose_samples(ahead, 240, np.random.default_rng(3), 1.0j)
    pair = np.flatnonzero(z[:, ahead.depths.stop - 1] < ahead.depth[-1])
    assert pair.size >= 30
    one, two = z[pair, ahead.angles.stop - 2], z[pair, ahead.angles.stop - 1]
    np.testing.assert_allclose(0.5 * (one + two), math.pi / 2, atol=1e-9)
    now = z[pair, ahead.depths.stop - 2] == ahead.depth[0]
    assert 0.45 < now.mean() < 0.75  # some of the others are clipped to now


@pytest.mark.parametrize("rig", ["two axes", "half turns"])
def test_the_constant_samples_roll_by_half_a_turn_at_most_twice(rig):
    """The half turns are before the first step, after it, both or neither; the guide stays on the path."""
    ahead, _ = ahead_of(rig)
    rows = ahead.constant
    half = np.count_nonzero(rows[:, :, ROLL], axis=1)
    assert half.tolist() == [0, 1, 1, 2]
    np.testing.assert_allclose(rows[2:, 0, ROLL], math.pi)
    np.testing.assert_allclose(rows[1::2, 1, ROLL], math.pi)
    np.testing.assert_allclose(rows[:, :, DG_Y], np.tile(rows[0, :, DG_Y], (4, 1)))
