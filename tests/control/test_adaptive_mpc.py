"""The default controller: the paths that it finds on its estimated model, its limits and its memory."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from adaptive import ADAPTIVE, BARE, PHANTOM, QUICK, decide, decided, estimate_of, rolls_at, unrolled
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.interface import travel_left
from flexneedle.control.path import path_of_plan
from flexneedle.costs.weighted_sum import TIPS_ONLY, evaluate_cost, outputs_of
from flexneedle.estimation.moves import Move
from flexneedle.mechanics.model import Adaptation
from flexneedle.scenario.worlds import world
from flexneedle.simulator.control import controls as controls_of
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DG_Y, ROLL, STILL, THETA, Control, Measurement, Motion, X, Y
from tasks import stretched, task_of

ENERGIES = [f"{part}_energy_weight_mm" for part in ("end", "mean", "peak")]
ACCURATE = PHANTOM.with_values(
    {f"control.adaptive_mpc.{key}": 0.0 for key in (*ENERGIES, "travel_weight", "slope_weight_mm")}
)
FORWARD = Control(db_x=1.0)
ROLLING = BARE.with_values(
    {f"control.adaptive_mpc.{key}": 0.0 for key in (*ENERGIES, "roll_weight_mm", "late_roll_weight")}
)


def carried_out(plan, scenario, plant=None, steps=100, seed=0):
    """Decisions of a whole insertion into a plant whose tip is measured at the end of each, and both states then."""
    task, plant = task_of(Simulator(scenario, threads=1), plan), plant or Simulator(scenario, threads=1)
    estimate, rng = ADAPTIVE.observer.begin(task), np.random.default_rng(seed)
    truth, memory, decisions = plant.start(plan.roll), ADAPTIVE.begin(task), []
    for k in range(steps):
        decision, memory = ADAPTIVE.decide(task, memory, estimate, rng)
        decisions.append(decision)
        command = STILL if decision.rest > 0.0 else decision.command
        truth = plant.step(truth, command)
        x, y = truth.tip[:2].tolist()
        estimate = estimate.move(Motion(command, k, k + 1.0)).observe([Measurement(k + 1.0, x, y)])
        if ADAPTIVE.arrived(task, memory, estimate):
            break
    return decisions, truth, estimate


# ---- what it finds


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("rolled", [False, True])
def test_without_a_guide_it_rolls_the_bevel_to_a_target_on_either_side(quick_plan, side, rolled):
    """The target is where the bevel alone leads, rolled now or not; the path rolls only if a roll leads there."""
    simulator = Simulator(ROLLING, threads=1)
    state = simulator.start()
    for k in range(35):
        state = simulator.step(state, Control(db_x=1.0, flip=rolled and k == 0))
    way = controls_of(2, 30, db_x=1.0)
    way[0, 0, ROLL] = np.pi
    ends = [simulator.replay(state, rows)[0].tip for rows in way]
    goal, other = sorted(ends, key=lambda tip: -side * tip[Y])
    plan = replace(quick_plan, target=(float(goal[X]), float(goal[Y]), 0.0))
    decision, memory = decided(plan, estimate_of(state, ROLLING), path=unrolled(path_of_plan(plan)))
    rolled = (decision.command.roll > 0.0) + len(memory.path.rolls)
    assert abs(goal[Y] - other[Y]) > 1.0
    assert abs(decision.miss) < 0.25 * abs(goal[Y] - other[Y])
    assert rolled > 0 or side == state.bevel.real


@pytest.mark.parametrize("offset", [-1.0, 1.0])
def test_off_the_plan_it_finds_a_path_that_ends_nearer_the_target(quick_plan, along, offset):
    """The base clamp is off, so that the planned guide would miss."""
    estimate = estimate_of(along(quick_plan, 20, base=(offset,)), ACCURATE)
    ahead = adaptive_mpc.Ahead.of(
        task_of(estimate.nominal, quick_plan), estimate.state, path_of_plan(quick_plan)
    )
    kept = (
        adaptive_mpc.rollout_as_measured(estimate, ahead.controls(ahead.current[None])[0]).tips[0, -1, Y]
        - 5.0
    )
    assert abs(kept) > 0.3
    assert abs(decide(quick_plan, estimate).miss) < 0.3 * abs(kept)


def test_it_rests_four_two_and_one_steps_before_the_target(short_plan):
    """It rests for the delay of a reading and a control step; the command waits."""
    decisions, _, _ = carried_out(short_plan, short_plan.scenario)
    rests = [k for k, decision in enumerate(decisions) if decision.rest > 0.0]
    left = [sum(decision.command.db_x for decision in decisions[k:] if not decision.rest) for k in rests]
    np.testing.assert_allclose(left, [4.0, 2.0, 1.0], atol=1.0)
    assert len(rests) == 3
    assert all(decisions[k].rest >= 0.2 for k in rests)


def test_it_rests_once_after_a_step_that_the_fit_does_not_explain(quick_plan, along):
    """Four standard deviations off, to either side; in air, and where the needle has just rested, it moves.

    A needle that was measured at rest for as long already, since the decision came late, does not rest any more.
    """

    def rest(state, sd, command=FORWARD, measured=0.9):
        estimate = estimate_of(state)
        off = sd * np.sqrt(estimate.reading_variance)
        move = Move(Motion(command, 0.0, 1.0), (Measurement(measured, *state.tip[:2].tolist()),))
        tips = np.array([state.tip, state.tip])
        estimate = replace(estimate, innovation=(0.0, off, 0.0), moves=(move,), tips=tips)
        return decide(quick_plan, estimate).rest

    inside = along(quick_plan, 40)
    assert rest(inside, 4.1) > 0.0
    assert rest(inside, -4.1) > 0.0
    assert rest(inside, 3.9) == 0.0
    assert rest(inside, 4.1, STILL) == 0.0
    assert rest(along(quick_plan, 3), 4.1) == 0.0
    assert rest(inside, 4.1) == pytest.approx(0.3)
    assert rest(inside, 4.1, measured=1.1) == pytest.approx(0.1)
    assert rest(inside, 4.1, measured=1.3) == 0.0


def test_the_current_path_is_never_replaced_by_a_worse_one(quick_plan, along):
    """The cost found is at most the current path's, for any rolls and guide."""
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    task = task_of(estimate.nominal, quick_plan)
    _, begun = decided(quick_plan, estimate)
    for rolls in ((), (20.0,), (15.0, 18.0)):
        path = replace(path_of_plan(quick_plan), rolls=rolls_at(*rolls))
        memory = replace(begun, path=path, roll=estimate.state.roll)
        ahead = adaptive_mpc.Ahead.of(task, estimate.state, path)
        kept = ahead.controls(ahead.current[None])[0]
        ends = adaptive_mpc.find_ends(task, estimate, ahead)
        listed = adaptive_mpc.cost_terms(task, estimate, memory, ahead, ends)
        found = adaptive_mpc.rollout_as_measured(estimate, kept, outputs_of(listed))
        current = float(evaluate_cost(listed, found)[0])
        decision, _ = ADAPTIVE.decide(task, memory, estimate, np.random.default_rng(0))
        assert decision.cost <= current + 1e-9


@pytest.mark.parametrize("carried_out", [False, True])
def test_a_roll_stays_planned_until_the_needle_has_rolled(quick_plan, along, carried_out):
    """A period that is held leaves the bevel where it is: the roll that was due in it is still planned."""
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    task, x = task_of(estimate.nominal, quick_plan), float(estimate.state.tip[0])
    path = replace(path_of_plan(quick_plan), rolls=rolls_at(x))
    memory = replace(ADAPTIVE.begin(task), path=path, rolled=unrolled(path), roll=estimate.state.roll)
    if carried_out:
        estimate = replace(estimate, state=estimate.simulator.step(estimate.state, Control(flip=True)))
    rolls = []
    search = adaptive_mpc.search_path

    def spied(task, fitted, ahead, *rest):
        rolls.append(ahead.path.rolls[:, 0].tolist())
        return search(task, fitted, ahead, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adaptive_mpc, "search_path", spied)
        ADAPTIVE.decide(task, memory, estimate, np.random.default_rng(0))
    assert rolls[0] == ([] if carried_out else [x])


def test_the_predicted_miss_is_the_miss_of_the_path_found(quick_plan, along):
    """The path is carried out on the estimated model, whose rollouts have longer steps."""
    estimate = estimate_of(along(quick_plan, 45))
    decision, memory = decided(quick_plan, estimate)
    task, state, path = task_of(estimate.nominal, quick_plan), estimate.state, memory.path
    state = estimate.simulator.step(state, decision.command)
    while travel_left(PHANTOM, quick_plan, state) > 1e-9:
        command, path = adaptive_mpc.Ahead.of(task, state, path).first_command(path)
        state = estimate.simulator.step(state, command)
    assert state.tip[Y] - 5.0 == pytest.approx(decision.miss, abs=0.02)
    assert decision.miss_sd > 0.0
    assert f"{decision.miss:+.3f} ± {decision.miss_sd:.3f} mm" in decision.why


def test_an_offset_of_the_axis_shifts_the_target(quick_plan, along):
    """If the measured tip and the target are 0.2 mm off, the command is the same."""
    state = along(quick_plan, 45)
    here = decide(quick_plan, estimate_of(state))
    beside = replace(quick_plan, target=(quick_plan.target[0], quick_plan.target[1] + 0.2, 0.0))
    left = estimate_of(state, residual=0.2)
    assert decide(beside, left).command == pytest.approx(here.command, abs=1e-6)
    assert decide(quick_plan, left).command.dg_y != pytest.approx(here.command.dg_y, abs=1e-3)


def test_a_roll_takes_the_run_out_to_the_other_side(quick_plan, along):
    """The tips of a rollout are those that the tracker will measure."""
    estimate = estimate_of(along(quick_plan, 45))
    parameters = estimate.parameters.copy()
    parameters[estimate.slots.run_out] = 0.5
    controls = controls_of(1, 4, db_x=1.0, roll=[0.0, np.pi, 0.0, 0.0])
    plain = adaptive_mpc.rollout_as_measured(estimate, controls).tips
    tips = adaptive_mpc.rollout_as_measured(replace(estimate, parameters=parameters), controls).tips
    side = estimate.state.bevel.real * np.array([1.0, -1.0, -1.0, -1.0])
    np.testing.assert_allclose(tips[0, :, Y] - plain[0, :, Y], 0.5 * side, atol=1e-12)
    np.testing.assert_array_equal(np.delete(tips, Y, axis=-1), np.delete(plain, Y, axis=-1))


def test_the_fitted_model_is_the_one_that_predicts(quick_plan, along):
    """In tissue three times as stiff the guide step differs from the same state."""
    estimate = estimate_of(along(quick_plan, 55, base=(0.3,)))
    model = estimate.nominal.adapt(Adaptation(np.zeros(1), np.full(2, 3.0)))
    stiff = replace(estimate, simulator=estimate.nominal.with_model(model))
    assert decide(quick_plan, stiff).cost != decide(quick_plan, estimate).cost
    assert decide(quick_plan, stiff).command.dg_y != decide(quick_plan, estimate).command.dg_y


def test_a_longer_search_is_made_where_no_path_is_found(quick_plan, along, monkeypatch):
    """A longer search is made at the start, and where the miss is likely to exceed the limit."""
    efforts, search = [], adaptive_mpc.search_path

    def spied(*args):
        efforts.append(args[4])
        return search(*args)

    monkeypatch.setattr(adaptive_mpc, "search_path", spied)
    estimate = estimate_of(along(quick_plan, 55))
    _, memory = decided(quick_plan, estimate)
    task = task_of(estimate.nominal, quick_plan)
    ADAPTIVE.decide(task, memory, estimate, np.random.default_rng(0))
    assert efforts == [1, task.settings.effort, 1]
    far = replace(quick_plan, target=(40.0, 14.0, 0.0))
    decision, _ = ADAPTIVE.decide(task_of(estimate.nominal, far), memory, estimate, np.random.default_rng(0))
    assert efforts[3:] == [1, task.settings.effort]
    assert decision.miss < -2.0


# ---- limits


@given(
    step=st.floats(0.01, 0.5), reach=st.floats(0.02, 6.0), advance=st.floats(0.3, 2.0),
    stretch=st.floats(-3.0, 3.0), seed=st.integers(0, 99),
)  # fmt: skip
@hypothesis_settings(max_examples=5)
def test_limits_are_kept_whatever_the_plan(quick_plan, step, reach, advance, stretch, seed):
    """The simulator raises CommandError for a step or place out of range; the plan is one of a larger setup."""
    scenario = QUICK.with_values(
        {
            "setup.max_guide_step_mm": step, "setup.max_guide_travel_mm": reach,
            "setup.max_advance_mm": advance, "target.lateral_mm": 0.0,
        }
    )  # fmt: skip
    wide = replace(
        quick_plan, tips=stretched(quick_plan.tips, stretch, Y, THETA), target=(40.0, 5.0 * stretch, 0.0),
        guide=quick_plan.guide * stretch, controls=stretched(quick_plan.controls, stretch, DG_Y),
    )  # fmt: skip
    simulator, rng = Simulator(scenario, threads=1), np.random.default_rng(seed)
    task = task_of(simulator, wide)
    estimate, places, memory = ADAPTIVE.observer.begin(task), [0.0], ADAPTIVE.begin(task)
    for k in range(8):
        decision, memory = ADAPTIVE.decide(task, memory, estimate, rng)
        simulator.check(estimate.state, decision.command)
        estimate = estimate.move(Motion(decision.command, k, k + 1.0))
        x, y = estimate.tip[:2]
        estimate = estimate.observe([Measurement(k + 1.0, float(x), float(y) + rng.normal(0.0, 0.5))])
        places.append(estimate.state.guide[0])
        assert 0.0 < decision.command.db_x <= advance + 1e-12
    assert np.abs(np.diff(places)).max() <= step + 1e-12
    assert np.abs(places).max() <= reach + 1e-12


@pytest.mark.parametrize("axial", [1.5, -1.5])
def test_the_stroke_is_what_was_commanded_wherever_the_base_began(quick_plan, along, axial):
    """An estimate of the base further along the axis neither uses up travel nor adds any."""
    advanced = float(quick_plan.controls[:50, 0].sum())
    short = PHANTOM.with_values({"setup.stroke_mm": advanced + 0.4, "target.depth_mm": 10.0})
    state = along(quick_plan, 50, short)
    state = state.with_estimate(base_x=float(state.base[0]) + axial)
    assert travel_left(short, quick_plan, state) == pytest.approx(0.4)
    assert decide(quick_plan, estimate_of(state, short)).command.db_x == pytest.approx(0.4)


def test_a_target_above_the_first_contact_point_is_decided_on_too(quick_plan):
    """No tissue is displaced there."""
    shallow = replace(quick_plan, target=(0.05, 0.1, 0.0))
    decision = decide(shallow, estimate_of(Simulator(PHANTOM, 1).start()))
    assert np.isfinite([*decision.command, decision.cost, decision.miss, decision.miss_sd]).all()


# ---- whole insertions


@pytest.mark.long
def test_a_whole_insertion_into_another_tissue_ends_at_the_target(quick_plan):
    """Stiffer tissue, a weaker bevel and a bent needle, where the plan alone misses by far more, in the median of a few
    searches: a stiff deep layer shows late, and the path that is left then depends on the path before. The last 0.05 mm
    would cost more energy than they are worth by the default weights.
    """
    nominal = Simulator(PHANTOM, threads=1)
    own = Adaptation(np.zeros(1), np.array([2.0, 1.5]), bevel=0.5, bend=0.4)
    plant = nominal.with_model(nominal.adapt(own))
    state = plant.start(quick_plan.roll)
    for row in quick_plan.controls:
        state = plant.step(state, Control.of(row))
    blind = abs(state.tip[Y] - 5.0)
    assert blind > 0.3
    misses = []
    for seed in range(5):
        decisions, truth, estimate = carried_out(quick_plan, PHANTOM, plant, seed=seed)
        misses.append(abs(truth.tip[Y] - 5.0))
        assert 0.0 <= travel_left(PHANTOM, quick_plan, estimate.state) <= PHANTOM.control.depth_tolerance_mm
        assert truth.tip[0] == pytest.approx(40.0, abs=0.05)
        assert len(decisions) <= 1.1 * len(quick_plan.controls)
    assert np.median(misses) < 0.35 * blind


def test_on_the_exact_model_it_ends_at_the_target_and_stays_as_certain(short_plan):
    """The readings are the model's: corrections to come were counted on from the start."""
    decisions, truth, _ = carried_out(short_plan, short_plan.scenario)
    assert abs(truth.tip[Y] - short_plan.target[1]) < 0.1
    last = [decision for decision in decisions if np.isfinite(decision.miss)][-1]
    assert abs(last.miss) < 0.1
    sds = np.array([decision.miss_sd for decision in decisions])
    assert (sds > 0.0).all()
    assert sds[-10:].mean() < 1.1 * sds[:10].mean()


@pytest.mark.long
@pytest.mark.parametrize("number", [31, pytest.param(68, marks=pytest.mark.slow)])
def test_a_soft_needle_is_steered_where_its_tip_bends_off_below_the_skin(number):
    """The tip moves by millimetres within a step, so that a reading is not on the chord of its move."""
    scenario = world(number, "perfect")
    plan = flexneedle.plan(scenario, seed=0)
    assert (
        flexneedle.insert(scenario, plan, seed=number, rig=flexneedle.VirtualRig("model")).true_error_mm < 0.2
    )


def test_where_no_path_converges_it_rests_and_reports_it(quick_plan, along, monkeypatch):
    """The current path is kept, and nothing is predicted."""
    estimate = estimate_of(along(quick_plan, 20), QUICK)
    task = task_of(estimate.nominal, quick_plan)
    memory, rollout = ADAPTIVE.begin(task), adaptive_mpc.rollout_as_measured

    def lost(fitted, controls, wanted=TIPS_ONLY):
        trajectories = rollout(fitted, controls, wanted)
        return replace(trajectories, converged=np.zeros_like(trajectories.converged))

    monkeypatch.setattr(adaptive_mpc, "rollout_as_measured", lost)
    decision, after = ADAPTIVE.decide(task, memory, estimate, np.random.default_rng(0))
    assert decision.command == STILL
    assert decision.why == "no path converges on the fitted model"
    assert np.isnan(decision.miss)
    assert decision.cost == np.inf
    assert after is memory
