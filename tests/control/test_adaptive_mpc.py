"""The default controller: its bevel, its guide, its last step, and that what it learnt counts in what it decides."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from flexneedle.control import bang_bang, route
from flexneedle.control.adaptive_settings import AdaptiveMpc
from flexneedle.control.identification import RUN_OUT, Identification
from flexneedle.control.interface import travel_left
from flexneedle.control.methods import DEFAULT, METHODS, adaptive_mpc
from flexneedle.ports import Sample
from flexneedle.simulator import Control, Learnt, Simulator
from tasks import begun_with, task_of

PHANTOM = flexneedle.load_scenario("phantom")
FEW = {
    "control.adaptive_mpc.samples": 8, "control.adaptive_mpc.iterations": 1,
    "control.adaptive_mpc.route_samples": 8, "control.adaptive_mpc.route_iterations": 1,
}  # fmt: skip
QUICK = PHANTOM.with_values(FEW)
ACCURATE = PHANTOM.with_values({"control.adaptive_mpc.energy_weight_per_mj": 0.0})
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
ADAPTIVE = METHODS["adaptive-mpc"]
HORIZON = AdaptiveMpc().horizon


def belief_of(state, scenario=PHANTOM, **fields):
    """A belief that the needle is so."""
    begun = Identification().begin(begun_with(Simulator(scenario, threads=1), state.bevel))
    return replace(begun, state=replace(state, scenario=scenario), tips=state.tip[None], **fields)


def on_plan(plan, belief):
    """The plan's way, not to be found again, without the turns that were made."""
    return replace(route.of_plan(plan), renew_at=np.inf).after(float(belief.state.tip[0]))


def decided(plan, belief, seed=0, way=None):
    """Decision and the way after it."""
    return ADAPTIVE.decide(
        task_of(belief.nominal, plan), way or on_plan(plan, belief), belief, np.random.default_rng(seed)
    )


def decide(plan, belief, seed=0):
    """The decision of one who follows the plan's way."""
    return decided(plan, belief, seed)[0]


def aimed(plan, state, aside, ahead=20.0):
    """The plan with a target so far ahead of a tip, and aside of its line (mm)."""
    x, y, turn = state.tip
    return replace(plan, target=(float(x) + ahead, float(y + ahead * np.tan(turn) + aside)))


def carried_out(plan, scenario, plant=None, steps=100):
    """Commands of a whole insertion into a plant whose tip is seen at the end of each, and the states at the end."""
    task, plant = task_of(Simulator(scenario, threads=1), plan), plant or Simulator(scenario, threads=1)
    estimate, rng = ADAPTIVE.observer.begin(task), np.random.default_rng(0)
    truth, memory, commands = plant.start(plan.bevel), ADAPTIVE.begin(task), []
    for k in range(steps):
        decision, memory = ADAPTIVE.decide(task, memory, estimate, rng)
        commands.append(decision.command)
        truth = plant.step(truth, Control.from_row(decision.command))
        x, y = truth.tip[:2].tolist()
        estimate = estimate.move(decision.command, k, k + 1.0).observe([Sample(k + 1.0, x, y)])
        if ADAPTIVE.arrived(task, memory, estimate):
            break
    return np.array(commands), truth, estimate


def test_it_is_the_default():
    assert DEFAULT == "adaptive-mpc"
    assert ADAPTIVE.summary


# ---- bevel


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_bevel_follows_the_rule_if_the_model_agrees_and_in_air_it_stays(quick_plan, along, side, turned):
    """Wherever the target is: the cheaper of both predictions."""
    for steps, in_air in ((50, False), (5, True)):
        state = Simulator(PHANTOM).step(along(quick_plan, steps), Control(flip=turned))
        away, belief = aimed(quick_plan, state, 2.0 * side), belief_of(state)
        task = task_of(belief.nominal, away)
        flip, why = bang_bang.decide(task, belief, AdaptiveMpc())
        assert flip is (side != state.bevel and not in_air)
        decision, rng = decide(away, belief), np.random.default_rng(0)
        expected = [
            adaptive_mpc._search(task, belief, on_plan(away, belief), rng, flip=way, why=why)
            for way in ((True, False) if flip else (False,))
        ]
        best = min(expected, key=lambda choice: choice.cost)
        assert decision.command == best.command
        assert decision.cost == best.cost
        assert decision.why == (f"{why}; the model keeps it" if flip and best.command[4] < 0 else why)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_rule_that_turns_the_bevel_is_followed_only_where_the_model_comes_nearer(
    quick_plan, monkeypatch, side
):
    """A rule that always turns; without a guide the model's answer can be had from two rollouts."""
    simulator = Simulator(BARE, threads=1)
    state = simulator.start()
    for _ in range(50):
        state = simulator.step(state, Control(db_x=1.0))
    monkeypatch.setattr(bang_bang, "decide", lambda *_: (True, "bevel turned"))
    ends = [
        rolled(simulator, state, HORIZON - 1, flip).tip[1] for flip in (False, True)
    ]  # with the bevel kept, and turned
    assert ends[0] > ends[1] + 0.01
    goal = (float(state.tip[0]) + HORIZON - 1, ends[0] if side > 0 else ends[1])
    decision = decide(straight(quick_plan, goal), belief_of(state, BARE))
    assert decision.command[4] == (-1 if side > 0 else 1)
    assert ("the model keeps it" in decision.why) is (side > 0)


def test_a_turn_takes_the_run_out_over_to_the_other_side(quick_plan, monkeypatch):
    """Seen 0.5 mm to the bevel's side: after the turn, what is wanted 0.5 mm to the other side costs the same."""
    simulator = Simulator(BARE, threads=1)
    state = rolled(simulator, simulator.start(), 50, False)
    monkeypatch.setattr(bang_bang, "decide", lambda *_: (True, "bevel turned"))
    x, y, _ = rolled(simulator, state, HORIZON - 1, True).tip
    belief = belief_of(state, BARE)
    parameters = belief.parameters.copy()
    parameters[RUN_OUT] = 0.5
    plain = decide(straight(quick_plan, (float(x), float(y))), belief)
    seen = decide(straight(quick_plan, (float(x), float(y) - 0.5)), replace(belief, parameters=parameters))
    assert (plain.command[4], seen.command[4]) == (1, 1)
    assert seen.cost == pytest.approx(plain.cost, rel=1e-6)


def test_the_rule_has_its_own_settings(quick_plan, along):
    """Its dead band is that of this controller, not that of `control`."""
    state = along(quick_plan, 50)
    away = aimed(quick_plan, state, -0.6 * state.bevel)
    for band, wanted in ((0.0, True), (1.0, False)):
        keys = {"curvature_per_m": 4.0, "flip_dead_band": band}
        scenario = QUICK.with_values({f"control.adaptive_mpc.{key}": value for key, value in keys.items()})
        why = decide(away, belief_of(state, scenario)).why
        assert why.startswith("bevel turned" if wanted else "bevel kept")


def test_a_rule_that_keeps_the_bevel_is_not_asked_again(quick_plan, along, monkeypatch):
    monkeypatch.setattr(bang_bang, "decide", lambda *_: (False, "bevel kept"))
    state = along(quick_plan, 66)
    assert decide(aimed(quick_plan, state, -2.0 * state.bevel, ahead=4.0), belief_of(state)).command[4] == -1


def rolled(simulator, state, steps, flip):
    for k in range(steps):
        state = simulator.step(state, Control(db_x=1.0, flip=flip and k == 0))
    return state


def straight(plan, goal):
    """The plan with a path level with the goal, and no guide."""
    tips = plan.tips * [1.0, 0.0, 0.0] + [0.0, goal[1], 0.0]
    return replace(plan, target=goal, tips=tips, guide=0.0 * plan.guide)


# ---- guide


@given(
    step=st.floats(0.01, 0.5), reach=st.floats(0.02, 6.0), advance=st.floats(0.3, 2.0),
    stretch=st.floats(-3.0, 3.0), seed=st.integers(0, 99),
)  # fmt: skip
@hypothesis_settings(deadline=None, derandomize=True, max_examples=25)
def test_limits_are_kept_whatever_the_plan(quick_plan, step, reach, advance, stretch, seed):
    """The simulator raises CommandError for a step or place out of range; the plan is one of a larger setup."""
    scenario = QUICK.with_values(
        {
            "setup.max_guide_step_mm": step, "setup.max_guide_travel_mm": reach,
            "setup.max_advance_mm": advance, "target.lateral_mm": 0.0,
        }
    )  # fmt: skip
    wide = replace(
        quick_plan, tips=quick_plan.tips * [1.0, stretch, stretch], target=(40.0, 5.0 * stretch),
        guide=quick_plan.guide * stretch, controls=quick_plan.controls * [1.0, 1.0, 1.0, stretch, 1.0],
    )  # fmt: skip
    simulator, rng = Simulator(scenario, threads=1), np.random.default_rng(seed)
    task = task_of(simulator, wide)
    estimate, places, memory = Identification().begin(begun_with(simulator, 1)), [0.0], ADAPTIVE.begin(task)
    if seed % 2:  # the way is looked for in air already
        memory = replace(memory, renew_at=-np.inf)
    for k in range(12):
        decision, memory = ADAPTIVE.decide(task, memory, estimate, rng)
        simulator.check(estimate.state, Control.from_row(decision.command))
        estimate = estimate.move(decision.command, k, k + 1.0)
        x, y = estimate.tip[:2]
        estimate = estimate.observe([Sample(k + 1.0, float(x), float(y) + rng.normal(0.0, 0.5))])
        places.append(estimate.state.guide)
        assert 0.0 < decision.command[0] <= advance + 1e-12
    assert np.abs(np.diff(places)).max() <= step + 1e-12
    assert np.abs(places).max() <= reach + 1e-12


@pytest.mark.parametrize("offset", [-1.0, 1.0])
def test_off_the_plan_the_guide_takes_the_tip_back_to_it(quick_plan, along, offset):
    on_plan, off = along(quick_plan, 15), along(quick_plan, 15, base_y=offset)
    back = decide(quick_plan, belief_of(off)).command[3] - decide(quick_plan, belief_of(on_plan)).command[3]
    assert np.sign(back) == -np.sign(off.tip[1] - on_plan.tip[1])


def test_what_the_axis_is_off_shifts_the_wanted_path(quick_plan, along):
    """A tip seen 0.2 mm aside of the model's, and all that is wanted 0.2 mm aside: the same command."""
    state = along(quick_plan, 45, ACCURATE)
    here = decide(quick_plan, belief_of(state, ACCURATE))
    aside = replace(
        quick_plan,
        tips=np.add(quick_plan.tips, [0.0, 0.2, 0.0]),
        target=tuple(np.add(quick_plan.target, (0.0, 0.2))),
    )
    left = belief_of(state, ACCURATE, residual=0.2)
    assert decide(aside, left).command == pytest.approx(here.command, abs=1e-9)
    parameters = left.parameters.copy()
    parameters[RUN_OUT] = 0.2 * state.bevel
    assert decide(aside, belief_of(state, ACCURATE, parameters=parameters)).command == pytest.approx(
        here.command, abs=1e-9
    )
    assert decide(quick_plan, left).command[3] < here.command[3] - 0.01


def test_the_learnt_model_is_the_one_that_predicts(quick_plan, along):
    """Tissue thrice as stiff asks for another guide step, from the same state."""
    state = along(quick_plan, 55, base_y=0.3)
    belief = belief_of(state)
    stiff = replace(belief, simulator=belief.nominal.adapted(Learnt(np.zeros(1), np.full(2, 3.0))))
    assert decide(quick_plan, stiff).cost != decide(quick_plan, belief).cost
    assert decide(quick_plan, stiff).command[3] != decide(quick_plan, belief).command[3]


@pytest.mark.parametrize("left", [30.0, 0.8])
def test_cost_is_that_of_the_chosen_step(quick_plan, along, left):
    """With a horizon of one step it can be computed again; at the target its place is what counts."""
    weights = {"horizon": 1, "orientation_weight_mm": 40.0, "guide_weight": 3.0, "energy_weight_per_mj": 2.0}
    scenario = PHANTOM.with_values({f"control.adaptive_mpc.{key}": value for key, value in weights.items()})
    state = along(quick_plan, 40, scenario, base_y=1.0)
    goal = replace(quick_plan, target=(float(state.tip[0]) + left, 2.0))
    decision = decide(goal, belief_of(state, scenario))
    after = Simulator(scenario, 1).step(state, Control.from_row(decision.command))
    depth = state.tip[0] + min(1.0, left)
    y, turn = (np.interp(depth, goal.tips[:, 0], goal.tips[:, k]) for k in (1, 2))
    near = left < 1.0
    weight = AdaptiveMpc().target_weight if near else 1.0
    off = (after.tip[1] - (2.0 if near else y)) ** 2 + (40.0 * (after.tip[2] - turn)) ** 2
    planned = np.diff(np.interp([state.tip[0], depth], goal.tips[:, 0], goal.guide))[0]
    expected = weight * off + 3.0 * (decision.command[3] - planned) ** 2 + 2.0 * after.strain_energy
    assert decision.cost == pytest.approx(expected, rel=1e-9)


def test_on_the_plan_it_goes_on_with_the_plan(quick_plan, along):
    """If tissue need not be spared more than the plan does."""
    for steps in (10, 40, 60):
        decision = decide(quick_plan, belief_of(along(quick_plan, steps, ACCURATE), ACCURATE))
        assert decision.command[3] == pytest.approx(quick_plan.controls[steps, 3], abs=0.06)
        assert decision.command[4] == -1


# ---- advance, base, and the end


@pytest.mark.parametrize("left", [0.7, 0.02, 1e-6])
def test_the_last_advance_ends_at_the_target_depth(quick_plan, along, left):
    state = along(quick_plan, 60)
    near = replace(quick_plan, target=(float(state.tip[0]) + left, 5.0))
    assert decide(near, belief_of(state)).command[0] == pytest.approx(left, rel=1e-6)


def test_otherwise_it_advances_at_full_step(quick_plan, along):
    for steps in (0, 30, 50):
        assert decide(quick_plan, belief_of(along(quick_plan, steps))).command[0] == 1.0


def test_at_the_depth_nothing_moves_any_more(quick_plan, along):
    state = along(quick_plan, 60)
    past = replace(quick_plan, target=(float(state.tip[0]) - 0.1, 9.0))
    command = decide(past, belief_of(state)).command
    assert command[:4] == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-12)


def test_the_stroke_ends_the_advance(quick_plan, along):
    advanced = float(quick_plan.controls[:50, 0].sum())
    short = PHANTOM.with_values({"setup.stroke_mm": advanced + 0.4, "target.depth_mm": 10.0})
    state = along(quick_plan, 50, short)
    assert decide(quick_plan, belief_of(state, short)).command[0] == pytest.approx(0.4)


def test_base_motion_of_the_plan_is_followed(quick_plan):
    """By steps of the base as they are planned for the depth, and in the prediction too."""
    moving = quick_plan.controls.copy()
    moving[:60, 1:3] = 0.02, 1e-4
    simulator = Simulator(PHANTOM, threads=1)
    states = [simulator.start(quick_plan.bevel)]
    for row in moving:
        states.append(simulator.step(states[-1], Control.from_row(row.tolist())))
    tips = np.array([state.tip for state in states])
    plan = replace(quick_plan, controls=moving, tips=tips)
    decision = decide(plan, belief_of(states[30]))
    assert decision.command[1:3] == pytest.approx((0.02, 1e-4), rel=0.05)
    assert decision.command[3] == pytest.approx(moving[30, 3], abs=0.06)
    still = decide(replace(plan, controls=quick_plan.controls), belief_of(states[30]))
    assert decision.cost < 0.5 * still.cost


def test_a_whole_insertion_into_another_tissue_ends_at_the_target(quick_plan):
    """Stiffer tissue and a bent needle, where the plan alone misses by ten times as much. Sparing tissue costs."""
    plant = Simulator(ACCURATE, threads=1).adapted(
        Learnt(np.zeros(1), np.array([2.0, 1.5]), bevel=0.5, bend=0.4)
    )
    state = plant.start(quick_plan.bevel)
    for row in quick_plan.controls:
        state = plant.step(state, Control.from_row(row))
    blind = abs(state.tip[1] - 5.0)
    commands, truth, estimate = carried_out(quick_plan, ACCURATE, plant)
    assert blind > 0.2
    assert abs(truth.tip[1] - 5.0) < 0.1 * blind
    assert 0.0 <= travel_left(PHANTOM, quick_plan, estimate.state) <= PHANTOM.control.depth_tolerance_mm
    assert truth.tip[0] == pytest.approx(40.0, abs=0.05)
    assert len(commands) <= 1.1 * len(quick_plan.controls)


def test_without_a_guide_none_is_moved(quick_plan):
    scenario = BARE.with_values(FEW)
    commands, truth, _ = carried_out(quick_plan, scenario)
    np.testing.assert_array_equal(commands[:, 3], 0.0)
    assert truth.tip[0] == pytest.approx(40.0, abs=0.02)
    assert decide(quick_plan, belief_of(Simulator(scenario).start(), scenario)).spread == 0.0


# ---- the way


def counted(monkeypatch, way=None):
    """The depths at which a way is sought; the answer is the plan's, or `way`."""
    sought = []

    def renewed(task, belief, old, _rng):
        sought.append(float(belief.state.tip[0]))
        return way or replace(old, renew_at=sought[-1] + task.settings.route_mm)

    monkeypatch.setattr(adaptive_mpc, "renewed", renewed)
    return sought


def test_the_way_is_found_again_from_the_skin_on_every_few_millimetres_but_not_near_the_target(
    quick_plan, monkeypatch
):
    """Within the horizon before the target it is kept."""
    sought = counted(monkeypatch)
    carried_out(quick_plan, QUICK.with_values({"control.adaptive_mpc.route_mm": 6.0}))
    assert 0.0 <= sought[0] < 1.0
    steps = np.diff(sought)
    assert ((steps >= 6.0) & (steps < 7.0)).all()
    assert 40.0 - HORIZON - 6.5 < sought[-1] < 40.0 - HORIZON


@pytest.mark.parametrize(("left", "looked"), [(HORIZON + 0.2, 1), (HORIZON, 0), (HORIZON - 3.0, 0), (0.4, 0)])
def test_no_way_is_sought_within_the_horizon(quick_plan, along, monkeypatch, left, looked):
    sought, state = counted(monkeypatch), along(quick_plan, 50)
    near = replace(quick_plan, target=(float(state.tip[0]) + left, 5.0))
    overdue = replace(on_plan(near, belief_of(state)), renew_at=-np.inf)
    decided(near, belief_of(state), way=overdue)
    assert len(sought) == looked


def test_a_way_that_was_found_is_the_one_that_is_followed(quick_plan, along, monkeypatch):
    """Its places, angles and guide, not the plan's."""
    state = along(quick_plan, 40)
    shifted = replace(on_plan(quick_plan, belief_of(state)), tips=np.add(quick_plan.tips[:, 1:], [0.3, 0.0]))
    sought = counted(monkeypatch, shifted)
    overdue = replace(on_plan(quick_plan, belief_of(state)), renew_at=0.0)
    decision, after = decided(quick_plan, belief_of(state), way=overdue)
    assert len(sought) == 1
    np.testing.assert_array_equal(after.tips, shifted.tips)
    other = replace(quick_plan, tips=np.add(quick_plan.tips, [0.0, 0.3, 0.0]))
    assert decision.command == pytest.approx(decide(other, belief_of(state)).command, abs=1e-12)
    assert decision.command[3] > decide(quick_plan, belief_of(state)).command[3] + 0.01


def test_turns_on_the_way_are_made_once_at_their_depth(quick_plan, along, monkeypatch):
    """Within half a step, whatever the rule and the target say; then the way goes on without them."""
    monkeypatch.setattr(bang_bang, "decide", lambda *_: (False, "bevel kept"))
    simulator, state = Simulator(QUICK, threads=1), along(quick_plan, 32, QUICK)
    way = replace(on_plan(quick_plan, belief_of(state, QUICK)), turns=(6.3, 7.9, 15.6, 30.0))
    depths, whys = [], []
    for _ in range(20):
        belief = belief_of(state, QUICK)
        decision, way = decided(quick_plan, belief, way=way)
        if decision.command[4] > 0:
            depths.append(float(state.tip[0]))
            whys.append(decision.why)
        state = simulator.step(state, Control.from_row(decision.command))
    assert way.turns == (30.0,)
    np.testing.assert_allclose(depths, [6.3, 7.9, 15.6], atol=0.5 + 1e-6)
    assert whys == ["bevel turned: on the way"] * 3


def test_two_turns_within_a_step_are_none(quick_plan, along, monkeypatch):
    """They would bring the bevel back to its side, and both are over."""
    monkeypatch.setattr(bang_bang, "decide", lambda *_: (False, "bevel kept"))
    belief = belief_of(along(quick_plan, 32, QUICK), QUICK)
    depth = float(belief.state.tip[0])
    way = replace(on_plan(quick_plan, belief), turns=(depth + 0.1, depth + 0.3, depth + 20.0))
    decision, after = decided(quick_plan, belief, way=way)
    assert decision.command[4] < 0.0
    assert after.turns == (depth + 20.0,)


def test_turns_of_the_plan_in_air_are_made_as_planned(quick_plan):
    """Each once, and where the plan makes them."""
    turning = quick_plan.controls.copy()
    turning[:, 4] = -1.0
    turning[[12, 20], 4] = 1.0
    commands, truth, _ = carried_out(replace(quick_plan, controls=turning), QUICK, steps=28)
    depth = PHANTOM.setup.start_tip_x + np.append(0.0, np.cumsum(commands[:, 0]))
    made = depth[:-1][commands[:, 4] > 0]
    np.testing.assert_allclose(made, quick_plan.tips[[12, 20], 0], atol=0.5 + 1e-6)
    assert truth.bevel == quick_plan.bevel


def test_on_the_exact_model_it_ends_at_the_target_with_few_turns(quick_plan):
    """As shipped, ways and all, where nothing but the plan's own miss is to be corrected."""
    commands, truth, _ = carried_out(quick_plan, PHANTOM)
    assert abs(truth.tip[1] - 5.0) < 0.1
    assert (commands[:, 4] > 0).sum() <= (quick_plan.controls[:, 4] > 0).sum() + 2


# ---- decisions as values


def test_the_same_random_numbers_lead_to_the_same_decision(quick_plan, along):
    belief = belief_of(along(quick_plan, 45, base_y=0.5))
    one, again, other = (decide(quick_plan, belief, seed) for seed in (5, 5, 6))
    assert one == again
    assert other.command[3] != one.command[3]
    many = replace(belief, simulator=Simulator(PHANTOM, threads=3))
    assert decide(quick_plan, many, 5) == one


def test_deciding_changes_nothing_of_belief_and_plan(quick_plan, along):
    belief = belief_of(along(quick_plan, 45), residual=0.1)
    before = [
        array.copy()
        for array in (belief.parameters, belief.tips, belief.state.scalars, quick_plan.tips, quick_plan.guide)
    ]
    decide(quick_plan, belief)
    now = (belief.parameters, belief.tips, belief.state.scalars, quick_plan.tips, quick_plan.guide)
    for kept, there in zip(before, now, strict=True):
        np.testing.assert_array_equal(kept, there)
