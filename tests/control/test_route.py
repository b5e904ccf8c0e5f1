"""The way to the target, found again with what was learnt: carried out, it leads there, within all limits."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from flexneedle.control import route
from flexneedle.control.adaptive_settings import AdaptiveMpc
from flexneedle.control.identification import RUN_OUT, Identification
from flexneedle.simulator import Control, Learnt, Simulator
from tasks import begun_with, task_of

PHANTOM = flexneedle.load_scenario("phantom")
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
OWN = AdaptiveMpc()


def belief_of(state, scenario=PHANTOM, **fields):
    """A belief that the needle is so."""
    begun = Identification().begin(begun_with(Simulator(scenario, threads=1), state.bevel))
    return replace(begun, state=replace(state, scenario=scenario), tips=state.tip[None], **fields)


def running_out(belief, run_out):
    """The same with a run-out (mm)."""
    parameters = belief.parameters.copy()
    parameters[RUN_OUT] = run_out
    return replace(belief, parameters=parameters)


def found(plan, belief, seed=0, old=None):
    """The way from where the needle is believed to be."""
    task = task_of(belief.nominal, plan)
    return route.renewed(task, belief, old or route.of_plan(plan), np.random.default_rng(seed))


def carried_out(way, belief, target_depth, plan=None):
    """The believed needle moved along the way, step by step as commands; raises if one is out of limits.

    The base goes where the plan has it, if one is given.
    """
    simulator, state = belief.simulator, belief.state
    turns, most = list(way.turns), belief.nominal.scenario.setup.max_advance_mm
    while (left := target_depth - float(state.tip[0])) > 1e-6:
        depth = float(state.tip[0])
        advance = min(left, most)
        guide = np.interp(depth + advance, way.depth, way.guide) - state.guide
        flip = bool(turns) and turns[0] <= depth + 0.25 * most
        turns = turns[1:] if flip else turns
        moved = base_at(plan, depth + advance) - state.travel[1:3] if plan else (0.0, 0.0)
        state = simulator.step(state, Control(advance, *moved, guide, flip))
    assert not turns
    return state


def base_at(plan, depth):
    """Where a plan has moved its base (y, turn) with its tip at a depth."""
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(plan.controls[:, 1:3], axis=0)])
    return np.array([np.interp(depth, plan.tips[:, 0], moved[:, k]) for k in (0, 1)])


# ---- the plan's way


def test_at_first_it_is_that_of_the_plan(quick_plan):
    turning = quick_plan.controls.copy()
    turning[:, 4] = -1.0
    turning[[0, 33, 50], 4] = 1.0
    way = route.of_plan(replace(quick_plan, controls=turning))
    np.testing.assert_array_equal(way.depth, quick_plan.tips[:, 0])
    np.testing.assert_array_equal(way.tips, quick_plan.tips[:, 1:])
    np.testing.assert_array_equal(way.guide, quick_plan.guide)
    assert way.turns == tuple(quick_plan.tips[[0, 33, 50], 0])
    assert way.renew_at == 0.0


def test_turns_that_were_made_are_left_out(quick_plan):
    way = replace(route.of_plan(quick_plan), turns=(1.0, 2.0, 3.0))
    assert way.after(2.0).turns == (3.0,)
    assert way.after(0.5).turns == (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(way.after(2.0).tips, way.tips)


# ---- found again


@pytest.mark.parametrize("steps", [29, 40, 52])
def test_it_begins_at_the_seen_tip_and_ends_at_the_target(quick_plan, along, steps):
    """By its own account, and when its guide and turns are carried out in steps of commands."""
    state = along(quick_plan, steps, base_y=0.4)
    belief = running_out(belief_of(state, residual=0.03), 0.12)
    way = found(quick_plan, belief)
    np.testing.assert_allclose([way.depth[0], *way.tips[0]], belief.tip, atol=1e-12)
    assert belief.tip[1] - state.tip[1] == pytest.approx(0.03 + 0.12 * state.bevel)
    assert way.guide[0] == state.guide
    assert way.depth[-1] == pytest.approx(40.0)
    assert way.tips[-1, 0] == pytest.approx(5.0, abs=0.1)
    end = carried_out(way, belief, 40.0)
    seen = end.tip[1] + 0.03 + 0.12 * end.bevel
    assert seen == pytest.approx(5.0, abs=0.1)
    assert seen == pytest.approx(way.tips[-1, 0], abs=0.05)
    assert way.renew_at == pytest.approx(float(state.tip[0]) + OWN.route_mm)


def test_it_is_that_of_the_learnt_model(quick_plan, along):
    """Other tissue, other bevel: the way that is found ends at the target with those, not with the scenario's."""
    state = along(quick_plan, 35)
    nominal = belief_of(state)
    learnt = Learnt(np.zeros(1), np.array([1.8, 0.6]), bevel=0.4, bend=0.3)
    belief = replace(nominal, simulator=nominal.nominal.adapted(learnt))
    way = found(quick_plan, belief)
    assert carried_out(way, belief, 40.0).tip[1] == pytest.approx(5.0, abs=0.1)
    assert abs(carried_out(way, nominal, 40.0).tip[1] - 5.0) > 0.2


def test_its_places_lie_on_the_way_of_the_needle(quick_plan, along):
    """Those of even steps of two millimetres; a turn is made before its step, at the depth that is told."""
    cheap = PHANTOM.with_values({"control.adaptive_mpc.route_turn_weight_mm": 0.0})
    belief = running_out(belief_of(along(quick_plan, 35), cheap, residual=-0.05), 0.2)
    turned = 0
    for seed, side in ((0, 10.0), (0, -10.0), (1, 5.0)):
        way = found(replace(quick_plan, target=(40.0, side)), belief, seed)
        state = belief.state
        for k, (y, turn) in enumerate(way.tips[1:]):
            flip = 1.0 if float(way.depth[k]) in way.turns else -1.0
            advance, guide = np.diff(way.depth)[k], np.diff(way.guide)[k]
            state, _ = belief.simulator.replay(state, [[advance, 0.0, 0.0, guide, flip]])
            assert (y, turn) == pytest.approx(
                (state.tip[1] + 0.2 * state.bevel - 0.05, state.tip[2]), abs=1e-9
            )
        turned += len(way.turns)
        assert np.diff(way.depth).max() <= 2.0 + 1e-9
        np.testing.assert_allclose(np.diff(way.depth), np.diff(way.depth)[0])
    assert turned > 0


@given(
    step=st.floats(0.01, 0.5), reach=st.floats(0.02, 6.0), advance=st.floats(0.5, 2.0),
    side=st.sampled_from([-1.0, 1.0]), seed=st.integers(0, 99),
)  # fmt: skip
@hypothesis_settings(deadline=None, derandomize=True, max_examples=20)
def test_the_guide_keeps_its_limits(quick_plan, step, reach, advance, side, seed):
    """Wherever the target is, and whatever the guide of the way before; commands along it are never refused."""
    scenario = PHANTOM.with_values(
        {
            "setup.max_guide_step_mm": step, "setup.max_guide_travel_mm": reach, "setup.max_advance_mm": advance,
            "target.lateral_mm": 0.0, "control.adaptive_mpc.route_samples": 8,
        }
    )  # fmt: skip
    simulator = Simulator(scenario, threads=1)
    belief = belief_of(simulator.replay(simulator.start(), [[30.0, 0.0, 0.0, 0.0, -1.0]])[0], scenario)
    plan = replace(quick_plan, target=(40.0, 14.0 * side), guide=5.0 * side * quick_plan.guide)
    way = found(plan, belief, seed)
    assert np.abs(way.guide).max() <= reach + 1e-12
    assert np.abs(np.diff(way.guide)).max() <= 2.0 * step + 1e-12


def test_without_a_guide_none_moves(quick_plan):
    simulator = Simulator(BARE, threads=1)
    state = simulator.replay(simulator.start(), [[30.0, 0.0, 0.0, 0.0, -1.0]])[0]
    way = found(replace(quick_plan, target=(40.0, 1.0)), belief_of(state, BARE))
    np.testing.assert_array_equal(way.guide, 0.0)
    assert np.isfinite(way.tips).all()


def test_the_base_goes_on_as_planned(quick_plan, along):
    """A plan that moves the base: the way reckons with it, and leads to the target only with it."""
    moving = quick_plan.controls.copy()
    moving[30:60, 1:3] = 0.03, 1e-4
    plan, state = replace(quick_plan, controls=moving), along(quick_plan, 38)
    belief = belief_of(state)
    way = found(plan, belief)
    end = carried_out(way, belief, 40.0, plan)
    assert end.travel[1:3] == pytest.approx((0.9, 3e-3), rel=0.05)
    assert end.tip[1] == pytest.approx(5.0, abs=0.1)
    assert abs(carried_out(way, belief, 40.0).tip[1] - end.tip[1]) > 0.1


# ---- bevel


@pytest.mark.parametrize("bevel", [1, -1])
def test_the_first_piece_keeps_the_bevel(quick_plan, along, bevel):
    """However much another side would be worth; a turn comes with a later piece."""
    state = along(quick_plan, 35)
    if state.bevel != bevel:
        state = Simulator(PHANTOM).step(state, Control(flip=True))
    cheap = PHANTOM.with_values({"control.adaptive_mpc.route_turn_weight_mm": 0.0})
    left, turned = 40.0 - float(state.tip[0]), 0
    for seed in range(4):
        for side in (10.0, -10.0):
            way = found(replace(quick_plan, target=(40.0, side)), belief_of(state, cheap), seed)
            assert all(turn >= float(state.tip[0]) + left / OWN.route_pieces - 2.0 for turn in way.turns)
            assert way.turns == tuple(sorted(set(way.turns)))
            turned += len(way.turns)
    assert turned > 0


def test_it_turns_where_the_sides_of_neighbouring_pieces_change(quick_plan, along):
    """The first is compared with the present side; a side of 0 or more is up."""
    state = along(quick_plan, 35)
    belief = belief_of(state)
    ahead = route._Ahead.of(task_of(belief.nominal, quick_plan), belief)
    pieces = int(ahead.piece[-1]) + 1
    assert pieces == OWN.route_pieces == 4
    firsts = np.searchsorted(ahead.piece, np.arange(pieces))
    for bevel, sides, turned in (
        (1, (0.3, 0.2, 2.0, 0.0), ()), (1, (1.0, -0.1, -2.0, -1.0), (1,)), (1, (1.0, -1.0, 1.0, -1.0), (1, 2, 3)),
        (-1, (-1.0, -0.5, -0.5, 0.5), (3,)), (-1, (0.5, 0.5, -0.5, -0.5), (0, 2)),
    ):  # fmt: skip
        held = state if state.bevel == bevel else Simulator(PHANTOM).step(state, Control(flip=True))
        controls = route._controls(ahead, belief_of(held), np.array([[*np.zeros(pieces), *sides]]))[0]
        assert np.flatnonzero(controls[:, 4] > 0).tolist() == firsts[list(turned)].tolist()
        assert set(controls[:, 4]) <= {-1.0, 1.0}


def test_a_turn_is_worth_its_weight(quick_plan, along):
    """Where bevel and guide both lead to the target, a dear turn is not made."""
    state = along(quick_plan, 35)
    dear = PHANTOM.with_values({"control.adaptive_mpc.route_turn_weight_mm": 1e3})
    for seed in range(3):
        assert found(quick_plan, belief_of(state, dear), seed).turns == ()


def test_cost_is_miss_tissue_energy_guide_and_turns(quick_plan, along):
    """Each in mm, computed again by steps; the miss is that at the target depth, as it will be seen."""
    weights = {"energy_weight_mm_per_mj": 3.0, "guide_weight_per_mm": 0.7, "turn_weight_mm": 0.2}
    scenario = PHANTOM.with_values(
        {f"control.adaptive_mpc.route_{key}": value for key, value in weights.items()}
    )
    belief = running_out(belief_of(along(quick_plan, 44), scenario, residual=0.04), 0.15)
    task = task_of(belief.nominal, replace(quick_plan, target=(40.0, 3.0)))
    ahead = route._Ahead.of(task, belief)
    z = np.array([[0.3, -0.1, 0.2, 0.1, 1.0, -1.0, -1.0, 1.0]]) * np.repeat(
        [1.0, float(belief.state.bevel)], 4
    )
    (cost,) = route._cost(task, belief, ahead, z)
    controls = route._controls(ahead, belief, z)[0]
    state, guide = belief.state, 0.0
    for row in controls:
        state, _ = belief.simulator.replay(state, [row])
        guide += row[3] ** 2
    seen = state.tip[1] + 0.15 * state.bevel + 0.04 + np.tan(state.tip[2]) * (40.0 - state.tip[0])
    assert state.bevel == belief.state.bevel
    assert guide > 0.1
    assert cost == pytest.approx(
        abs(seen - 3.0) + 3.0 * state.strain_energy + 0.7 * guide + 0.2 * 2, rel=1e-9
    )


# ---- a search


def test_the_same_random_numbers_lead_to_the_same_way(quick_plan, along):
    belief = belief_of(along(quick_plan, 40, base_y=0.5))
    one, again, other = (found(quick_plan, belief, seed) for seed in (3, 3, 4))
    many = found(quick_plan, replace(belief, simulator=Simulator(PHANTOM, threads=3)), 3)
    for same in (again, many):
        np.testing.assert_array_equal(one.tips, same.tips)
        np.testing.assert_array_equal(one.guide, same.guide)
        assert (one.turns, one.renew_at) == (same.turns, same.renew_at)
    assert not np.array_equal(one.guide, other.guide)


def test_it_is_no_worse_than_the_way_before(quick_plan, along):
    """By the cost that it is judged by: the search begins with the guide of the old way."""
    belief = belief_of(along(quick_plan, 40))
    task, old = task_of(belief.nominal, quick_plan), route.of_plan(quick_plan)
    ahead = route._Ahead.of(task, belief)
    sides = np.full(4, float(belief.state.bevel))
    before = route._cost(task, belief, ahead, np.concatenate([route._guide_steps(ahead, old), sides])[None])
    way = found(quick_plan, belief, old=old)
    z = np.interp(ahead.depth, way.depth, way.guide)
    assert z[0] == belief.state.guide
    end = carried_out(way, belief, 40.0)
    assert abs(end.tip[1] - 5.0) + OWN.route_energy_weight_mm_per_mj * end.strain_energy < before[0] + 0.02


class Failing(Simulator):
    """No step of it converges."""

    def rollout(self, state, controls, *, limits=True):
        done = super().rollout(state, controls, limits=limits)
        return done._replace(converged=np.zeros_like(done.converged))


def test_a_search_that_fails_keeps_the_old_way_until_the_next(quick_plan, along):
    state = along(quick_plan, 40)
    belief = replace(belief_of(state), simulator=Failing(PHANTOM, threads=1))
    old = route.of_plan(quick_plan)
    way = found(quick_plan, belief, old=old)
    assert way.tips is old.tips
    assert way.guide is old.guide
    assert way.depth is old.depth
    assert way.turns == old.turns
    assert way.renew_at == pytest.approx(float(state.tip[0]) + OWN.route_mm)


def test_finding_a_way_changes_nothing_of_belief_plan_and_old_way(quick_plan, along):
    belief, old = belief_of(along(quick_plan, 40), residual=0.1), route.of_plan(quick_plan)
    arrays = (
        belief.parameters,
        belief.state.scalars,
        belief.state.rest,
        old.tips,
        old.guide,
        quick_plan.controls,
    )
    before = [array.copy() for array in arrays]
    found(quick_plan, belief, old=old)
    for kept, now in zip(before, arrays, strict=True):
        np.testing.assert_array_equal(kept, now)


@pytest.mark.parametrize("left", [1.5, 0.3, 12.7])
def test_a_short_way_has_as_many_pieces_as_steps(quick_plan, along, left):
    state = along(quick_plan, 45)
    near = replace(quick_plan, target=(float(state.tip[0]) + left, float(state.tip[1])))
    way = found(near, belief_of(state))
    assert len(way.depth) == max(1, int(np.ceil(left / 2.0))) + 1
    assert way.depth[-1] == pytest.approx(float(state.tip[0]) + left)
