"""The current path, what may replace it, and its first step: within the limits, and the current path is never lost."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from adaptive import corrected, rolls_at
from flexneedle.control.path import KNOTS, LEAST_SLOTS, Ahead, GuidePath, path_of_plan
from flexneedle.control.samples import propose_samples
from flexneedle.simulator.control import controls as controls_of
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, DG_Z, ROLL, X, Y
from tasks import task_of

PHANTOM = flexneedle.load_scenario("phantom")
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
STEP, REACH = PHANTOM.setup.max_guide_step_mm, PHANTOM.setup.max_guide_travel_mm


def ahead_of(plan, state, path=None, scenario=PHANTOM):
    """The way ahead of a state, by default on the plan's path."""
    simulator = Simulator(scenario, threads=1)
    return Ahead.of(task_of(simulator, plan), replace(state, scenario=scenario), path or path_of_plan(plan))


def level(*rolls, guide=0.0):
    """A path with the guide at one place (mm)."""
    return GuidePath(np.array([-28.5, 40.0]), np.array([[guide, 0.0]] * 2), rolls_at(*rolls))


def depths(path):
    """Depths of a path's rolls."""
    return path.rolls[:, 0].tolist()


def started(x, guide=0.0, simulator=None):
    """A needle pushed to x (mm) with its guide at a place (mm)."""
    simulator = simulator or Simulator(PHANTOM, threads=1)
    state = simulator.start()
    for _ in range(3):
        rows = controls_of(1, db_x=x - state.tip[X], dg_y=guide - state.guide[0])
        state = simulator.replay(state, rows)[0]
    return state


# ---- the plan's path


def test_the_first_path_is_the_plans(quick_plan):
    """It has the guide's position at every depth, and the plan's rolls."""
    controls = quick_plan.controls.copy()
    controls[:, ROLL] = 0.0
    controls[[12, 40, 60], ROLL] = np.pi
    path = path_of_plan(replace(quick_plan, controls=controls))
    for axis in range(2):
        there = np.interp(quick_plan.tips[:, X], path.depth, path.guide[:, axis])
        np.testing.assert_array_equal(there, quick_plan.guide[:, axis])
    assert depths(path) == quick_plan.tips[[12, 40, 60], X].tolist()
    np.testing.assert_allclose(path.rolls[:, 1], [np.pi, 2.0 * np.pi, 3.0 * np.pi])


def test_no_roll_of_the_plan_is_lost(quick_plan):
    """However many there are: all are in the path, in the sample that corrects nothing, and in its controls."""
    controls = quick_plan.controls.copy()
    controls[:, ROLL] = 0.0
    controls[35:70:5, ROLL] = np.pi
    plan = replace(quick_plan, controls=controls)
    path = path_of_plan(plan)
    assert depths(path) == quick_plan.tips[35:70:5, X].tolist()
    ahead = ahead_of(plan, started(0.0), path)
    controls, depth = ahead.controls(ahead.current[None])
    assert depth[0, :-1][controls[0, :, ROLL] > 0.0].tolist() == depths(path)
    z = propose_samples(ahead, 24, np.random.default_rng(0))
    np.testing.assert_array_equal(z[0], ahead.current)


def test_depths_ascend_where_a_plan_stands_still(quick_plan):
    """The plan has steps without an advance, in which only the guide moves."""
    tips, guide = quick_plan.tips.copy(), quick_plan.guide
    tips[5:8, 0] = tips[4, 0]
    path = path_of_plan(replace(quick_plan, tips=tips))
    assert (np.diff(path.depth) > 0.0).all()
    assert len(path.guide) == len(guide) - 3


# ---- the first sample


def test_corrections_of_the_guide_are_linear_between_the_knots(quick_plan):
    """They begin with 0 at the tip and are small enough to stay within the limits."""
    state = started(-10.0)
    corrections = 0.4 * np.cos(np.arange(1.0, KNOTS.size + 1))
    ahead = ahead_of(quick_plan, state, level())
    z = np.concatenate([corrections, np.full(ahead.slots, ahead.unused)])
    controls, depth = ahead.controls(z[None])
    share = (depth[0] - depth[0, 0]) / (40.0 - depth[0, 0])
    expected = np.interp(share, np.append(0.0, KNOTS), np.append(0.0, corrections))
    np.testing.assert_allclose(np.cumsum(controls[0, :, DG_Y]), expected[1:], atol=1e-12)


def test_the_path_found_is_the_current_path_of_the_next_period(quick_plan, along):
    """Any sample that becomes the current path is the sample that corrects nothing."""
    state = along(quick_plan, 30)
    ahead = ahead_of(quick_plan, state)
    for z in propose_samples(ahead, 48, np.random.default_rng(2)):
        after = ahead_of(quick_plan, state, corrected(ahead, z))
        np.testing.assert_allclose(
            after.controls(after.current[None])[0][:, :, [DB_X, DG_Y, DG_Z]].sum(axis=1),
            ahead.controls(z[None])[0][:, :, [DB_X, DG_Y, DG_Z]].sum(axis=1), atol=1e-9,
        )  # fmt: skip
        flips = [
            np.flatnonzero(each.controls(one[None])[0][0, :, ROLL] > 0.0)
            for each, one in ((after, after.current), (ahead, z))
        ]
        np.testing.assert_array_equal(*flips)


# ---- samples


@pytest.mark.parametrize("guide", [0.0, 1.5])
def test_the_end_is_continuous_in_the_depth_of_a_roll(quick_plan, guide):
    """There is no jump where the roll moves from one step of the rollout to the next."""
    simulator = Simulator(PHANTOM, threads=1)
    state = started(12.0, guide)
    ahead = ahead_of(quick_plan, state, level(guide=guide))
    places = np.arange(12.6, 39.0, 0.02)
    z = np.tile(ahead.current, (places.size, 1))
    z[:, KNOTS.size] = places
    ends = simulator.rollout(state, ahead.controls(z)[0], limits=False).tips[:, -1, Y]
    assert np.ptp(ends) > 1.0
    assert np.abs(np.diff(ends)).max() < 0.01 * np.ptp(ends)


def test_two_rolls_at_one_place_cancel(quick_plan):
    """Rolls before and after them stay."""
    for rolls, left in [((20.0, 20.0), []), ((10.0, 20.0, 20.0, 30.0), [10.0, 30.0]), ((20.0,) * 3, [20.0])]:
        ahead = ahead_of(quick_plan, started(9.0), level(*rolls))
        assert depths(corrected(ahead, ahead.current)) == left


@given(rolls=st.lists(st.floats(9.2, 30.0), max_size=4))
@hypothesis_settings(max_examples=100)
def test_rolls_near_each_other_are_all_made(quick_plan, rolls):
    """In order and in place, except for rolls within a twentieth of a control step of each other."""
    rolls = sorted(rolls)
    assume((np.diff(rolls) > 0.051).all())
    ahead = ahead_of(quick_plan, started(9.0), level(*rolls))
    depth = ahead.controls(ahead.current[None])[1]
    assert (np.diff(depth) >= 0.0).all()
    assert depth[0, -1] == ahead.depth[-1]
    assert depths(corrected(ahead, ahead.current)) == pytest.approx(rolls, abs=0.5)
    assert depths(corrected(ahead, ahead.current))[1:] == rolls[1:]


def test_a_guide_that_may_not_move_is_not_moved(quick_plan):
    """There is no guide, or the plan is for steering."""
    for plan, scenario in ((quick_plan, BARE), (replace(quick_plan, strategy="steering"), PHANTOM)):
        state = started(10.0, simulator=Simulator(scenario, threads=1))
        ahead = ahead_of(plan, state, scenario=scenario)
        controls, _ = ahead.controls(propose_samples(ahead, 60, np.random.default_rng(0)))
        np.testing.assert_array_equal(controls[:, :, [DG_Y, DG_Z]], 0.0)
        assert ahead.first_command(ahead.path)[0].dg_y == 0.0


def test_base_motion_of_the_plan_is_followed(quick_plan):
    """The base follows the plan over the depth, in the samples and in the command."""
    moving = quick_plan.controls.copy()
    moving[:60, [DB_Y, DB_THETA]] = 0.02, 1e-4
    plan, state = replace(quick_plan, controls=moving), started(float(quick_plan.tips[30, 0]))
    simulator = Simulator(PHANTOM, threads=1)
    state = simulator.replay(state, controls_of(1, db_y=0.6, db_theta=30e-4))[0]
    ahead = ahead_of(plan, state)
    first, planned = ahead.first_command(ahead.path)[0], np.diff(quick_plan.tips[30:32, 0])[0]
    assert np.divide([first.db_y, first.db_theta], first.db_x) == pytest.approx(
        np.array([0.02, 1e-4]) / planned, rel=0.02
    )
    controls, _ = ahead.controls(ahead.current[None])
    total = controls[0, :, [DB_Y, DB_THETA]].sum(axis=1)
    np.testing.assert_allclose(total, [30 * 0.02, 30 * 1e-4], rtol=1e-6)


# ---- proposals


@pytest.mark.parametrize("rolls", [(), (20.0,), (15.0, 20.0, 25.0, 30.0)])
@pytest.mark.parametrize("scenario", [PHANTOM, BARE], ids=["guide", "bare"])
def test_proposals_are_around_the_current_path_which_is_the_first(quick_plan, rolls, scenario):
    state = started(10.0, simulator=Simulator(scenario, threads=1))
    ahead = ahead_of(quick_plan, state, level(*rolls), scenario)
    z = propose_samples(ahead, 96, np.random.default_rng(1))
    lower, upper = ahead.bounds
    assert z.shape == (96, KNOTS.size + ahead.slots)
    np.testing.assert_array_equal(z[0], ahead.current)
    assert ((z >= lower) & (z <= upper)).all()
    moved = np.abs(z - ahead.current) > 0.0
    guide, bevel = moved[:, : KNOTS.size].any(axis=1), moved[:, KNOTS.size :].any(axis=1)
    if scenario is PHANTOM:
        assert (guide & ~bevel).any()
        assert not rolls or (guide & bevel).any()
    assert bevel.any()
    new_pair = (z[:, KNOTS.size :] < 40.0).sum(axis=1) >= len(rolls) + 2
    assert new_pair.any() is (np.True_ if len(rolls) + 2 <= LEAST_SLOTS else np.False_)
    np.testing.assert_array_equal(z, propose_samples(ahead, 96, np.random.default_rng(1)))


# ---- the first step


def carried_out(plan, path, state, simulator):
    """Depths of the rolls, advances, and the state at the target, of the path carried out on the model."""
    rolls, advances, task = [], [], task_of(simulator, plan)
    for _ in range(200):
        ahead = Ahead.of(task, state, path)
        if ahead.left <= 1e-9:
            return rolls, advances, state, path
        command, path = ahead.first_command(path)
        if command.roll > 0.0:
            rolls.append(float(state.tip[0]))
        advances.append(command.db_x)
        state = simulator.step(state, command)
    raise AssertionError("it never gets there")


@pytest.mark.parametrize(
    "rolls", [(), (20.0,), (10.0001,), (12.03, 12.4, 12.9), (10.5, 17.77, 31.0, 39.5), (-20.0, 15.0)]
)
def test_rolls_are_executed_once_at_their_depth(quick_plan, rolls):
    """They are made within a tenth of a control step; a roll that the tip has passed is made at once."""
    simulator = Simulator(PHANTOM, threads=1)
    made, _, end, left = carried_out(quick_plan, level(*rolls), started(10.0), simulator)
    assert made == pytest.approx(np.maximum(rolls, 10.0).tolist(), abs=0.1 * PHANTOM.setup.max_advance_mm)
    assert depths(left) == []
    assert end.bevel.real == (-1) ** len(rolls)


def test_the_advance_ends_where_the_next_roll_is_due(quick_plan):
    for roll, advance in ((10.6, 0.6), (10.3, 0.3), (11.0, 1.0), (11.4, 1.0), (39.0, 1.0)):
        ahead = ahead_of(quick_plan, started(10.0), level(roll))
        command, after = ahead.first_command(ahead.path)
        assert command.db_x == pytest.approx(advance, abs=1e-6)
        assert (command.roll, depths(after)) == (0.0, [roll])


@pytest.mark.parametrize("left", [0.7, 0.02, 1e-6])
def test_the_last_advance_ends_at_the_target_depth(quick_plan, left):
    state = started(20.0)
    near = replace(quick_plan, target=(float(state.tip[0]) + left, 5.0, 0.0))
    ahead = ahead_of(near, state, level())
    assert ahead.first_command(ahead.path)[0].db_x == pytest.approx(left, rel=1e-6)


def test_at_the_depth_nothing_moves(quick_plan):
    state = started(20.0)
    past = replace(quick_plan, target=(float(state.tip[0]) - 0.1, 9.0, 0.0))
    ahead = ahead_of(past, state, level())
    controls, _ = ahead.controls(propose_samples(ahead, 24, np.random.default_rng(0)))
    np.testing.assert_allclose(controls[:, :, :ROLL], 0.0, atol=1e-12)
    assert ahead.first_command(ahead.path)[0][:ROLL] == pytest.approx((0.0,) * ROLL, abs=1e-12)


def test_the_stroke_ends_the_advance(quick_plan):
    short = PHANTOM.with_values({"setup.stroke_mm": 48.9, "target.depth_mm": 10.0})
    state = started(20.0)
    ahead = ahead_of(quick_plan, state, level(), short)
    assert ahead.first_command(ahead.path)[0].db_x == pytest.approx(48.9 - float(state.travel[0]), abs=1e-9)


@pytest.mark.parametrize("wanted", [4.0, -4.0])
def test_a_guide_far_from_its_path_comes_back_as_fast_as_it_may(quick_plan, wanted):
    ahead = ahead_of(quick_plan, started(10.0), level(guide=wanted))
    assert ahead.first_command(ahead.path)[0].dg_y == pytest.approx(np.sign(wanted) * STEP)
    controls, _ = ahead.controls(ahead.current[None])
    assert np.abs(np.cumsum(controls[0, :, DG_Y])).max() == pytest.approx(min(abs(wanted), REACH))
