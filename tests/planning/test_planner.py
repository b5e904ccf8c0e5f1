"""Plans on the phantom: they reach the target's depth, or name the limit that keeps them from the target."""

from functools import cache

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError, ScenarioError
from flexneedle.planning import planner
from flexneedle.scenario.worlds import world
from flexneedle.simulator.excess import bending_strain
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, Control

PHANTOM = flexneedle.load_scenario("phantom")
TARGETS = [(depth, lateral) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for lateral in (-5.0, 0.0, 5.0)]
LATERAL = (40.0, 5.0)
DAILY = ((25.0, -5.0), LATERAL)
HELD = {"setup.max_guide_travel_mm": 0.05, "target.lateral_mm": 0.0, "plan.roll_weight_mm": 5e3}
GENTLE = {"plan.peak_energy_weight_mm": 1e5}
# For tests in which the quality of the plan doesn't matter.
COARSE = {"plan.samples": 32, "plan.iterations": 4, "plan.max_iterations": 4}


NEAR = (40.0, 1.5)  # within the reach of the bevel alone, where fewer samples are enough


@cache
def planned(target, strategy):
    scenario = PHANTOM.with_values({"plan.samples": 64}) if target == NEAR else PHANTOM
    return flexneedle.plan(scenario, target, strategy, seed=1)


def coarse(changes=None, target=LATERAL, **options):
    """A quick plan under a changed scenario."""
    return flexneedle.plan(PHANTOM.with_values({**COARSE, **(changes or {})}), target, **options)


def states_of(plan, scenario=PHANTOM):
    """The plan carried out step by step, the start first."""
    simulator = Simulator(scenario)
    states = [simulator.start(plan.roll)]
    for row in plan.controls:
        states.append(simulator.step(states[-1], Control.of(row.tolist())))
    return states


EACH = [pytest.param(one, marks=[] if one in DAILY else pytest.mark.long) for one in TARGETS]


@pytest.mark.parametrize("target", EACH)
def test_each_target_of_the_paper_is_reached_within_the_limits_of_the_scenario(target):
    plan, setup = planned(target, "manipulation"), PHANTOM.setup
    assert plan.error_mm <= 0.05
    assert plan.reached
    assert plan.limit == ""
    assert plan.tip_mm[0] == pytest.approx(target[0], abs=1e-5)
    assert np.abs(plan.guide).max() < 5.0
    assert plan.flips <= 3
    assert plan.converged
    controls = plan.controls
    assert (controls[:, DB_X] > 0.0).all()
    assert controls[:, DB_X].max() <= setup.max_advance_mm + 1e-9
    assert np.abs(controls[:, DG_Y]).max() <= setup.max_guide_step_mm + 1e-9
    assert (controls[:, DB_Y:DG_Y] == 0.0).all()
    assert controls[0, ROLL] == 0.0


@pytest.mark.parametrize(("target", "strategy"), [(LATERAL, "manipulation"), (NEAR, "steering")])
def test_record_is_what_the_simulator_does_with_its_controls(target, strategy):
    """It does on the scenario's needle, also where only the bevel steers."""
    plan = planned(target, strategy)
    states = states_of(plan)
    np.testing.assert_array_equal(plan.tips, [state.tip for state in states])
    np.testing.assert_allclose(plan.guide, [state.guide for state in states], atol=1e-12)
    np.testing.assert_array_equal(plan.strain_energy, [state.strain_energy for state in states])
    np.testing.assert_array_equal(plan.shapes[-1], states[-1].nodes)
    assert (plan.target, plan.strategy, plan.seed) == ((*target, 0.0), strategy, 1)
    assert plan.iterations == len(plan.history)
    # The search's sequences end with steps of no length, in which the tip is solved again, to 1e-6 mm.
    assert plan.cost == pytest.approx(sum(plan.terms.values()), abs=1e-4)
    assert plan.seconds > 0.0


def test_the_cost_is_the_plans_up_to_the_last_step():
    """Recomputed from the record; only the last, shortened step may differ a little."""
    plan, settings = planned(LATERAL, "manipulation"), PHANTOM.plan
    inside = plan.tips[1:, 0] > 0.0
    advance, guide = plan.controls[:, DB_X], plan.controls[:, DG_Y]
    slope = settings.slope_weight * 40.0 * (guide**2 / advance).sum() / advance.sum()
    assert plan.terms["guide"] == pytest.approx(slope, rel=0.02)
    load = plan.invasiveness
    for energy, weight in (("end", 0.05), ("mean", 0.1), ("peak", 0.1)):
        stored = 1e-3 * getattr(load, f"{energy}_energy_uj") / PHANTOM.energy_scale(40.0)
        assert getattr(settings, f"{energy}_energy_weight_mm") == weight
        assert plan.terms[f"{energy} energy"] == pytest.approx(weight * stored, rel=0.1)
    shapes = plan.shapes[1:][inside]
    squares = np.trapezoid(shapes[:, :, 1] ** 2, axis=1) / (shapes.shape[1] - 1)
    mean_square = (squares * advance[inside]).sum() / advance[inside].sum()
    assert plan.terms["deflection"] == pytest.approx(settings.bend_weight * mean_square / 40.0, rel=0.06)
    assert plan.terms["rolls"] == pytest.approx(settings.roll_weight_mm * plan.flips)
    assert plan.terms["limits"] == 0.0
    assert plan.terms["miss"] == pytest.approx(plan.error_mm + plan.error_mm**2 / 0.1, abs=0.005)


def test_same_seed_same_bytes_whatever_the_threads(monkeypatch):
    one = coarse(seed=3)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})
    again, other = coarse(seed=3), coarse(seed=4)
    for name in ("controls", "tips", "shapes", "strain_energy"):
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()
    assert one.history == again.history
    two = coarse(seed=3, threads=2)
    assert two.controls.tobytes() == one.controls.tobytes()
    assert one.controls.tobytes() != other.controls.tobytes()


@pytest.mark.parametrize(
    ("strategy", "changes"),
    [
        ("manipulation", {}),
        ("steering", {"entry.free_radius_mm": 3.0, "entry.free_slope_mrad": 50.0}),
        *(
            pytest.param(strategy, changes, marks=pytest.mark.long)
            for strategy, changes in (("steering", {}), ("manipulation", {"entry.free_radius_mm": 3.0}))
        ),
    ],
)
def test_a_sketch_is_the_plan_of_one_search(monkeypatch, strategy, changes):
    """The search has one roll where only the bevel steers."""
    given = {"plan.samples": 48, "plan.iterations": 8, "plan.max_iterations": 8, "target.lateral_mm": 1.0}
    given |= {"needle.nodes": 31, "setup.tip_to_skin_mm": 6.0}
    scenario, search = PHANTOM.with_values(given | changes), planner.search_rolls
    sketch = planner.sketch(scenario, strategy, 3)
    monkeypatch.setattr(planner, "search_rolls", lambda *args: search(*args[:5], 1))
    plan = flexneedle.plan(scenario, strategy=strategy, seed=3)
    assert plan.reached  # after one search
    np.testing.assert_allclose(sketch.tips, plan.tips, atol=1e-9)
    np.testing.assert_allclose(sketch.needle, plan.shapes[-1], atol=1e-9)
    assert (sketch.roll, sketch.reached) == (plan.roll, True)
    assert sketch.error_mm == pytest.approx(plan.error_mm, abs=1e-9)


def test_a_sketch_of_the_bevel_alone_reaches_with_one_roll_the_targets_of_several():
    scenario = PHANTOM.with_values({**COARSE, "plan.roll_weight_mm": 0.0, "target.lateral_mm": 0.5})
    assert flexneedle.plan(scenario, strategy="steering").flips > 1
    assert planner.sketch(scenario, "steering").reached


@pytest.mark.parametrize(
    ("target", "least", "most"),
    [
        (LATERAL, 0.01, 0.2),
        ((25.0, -5.0), -0.2, -0.01),
        pytest.param((40.0, 0.0), -0.012, 0.012, marks=pytest.mark.long),
    ],
)
def test_manipulation_enters_at_an_angle_towards_the_target(target, least, most):
    """The slope at the skin is to the target's side; towards a target straight ahead it is 0."""
    assert least < planned(target, "manipulation").entry_angle < most


def test_steering_reaches_the_target_with_the_guide_still():
    plan = planned(NEAR, "steering")
    assert plan.error_mm <= 0.01
    assert plan.converged
    assert (plan.controls[:, DB_Y:ROLL] == 0.0).all()
    assert (plan.guide == 0.0).all()
    assert plan.cost > planned(NEAR, "manipulation").cost  # which may move the guide as well
    assert abs(plan.entry_angle) < abs(planned(LATERAL, "manipulation").entry_angle)


def test_without_guide_and_base_both_strategies_are_the_same_search():
    bare = PHANTOM.with_values({"setup.guide_to_skin_mm": None, **COARSE})
    plans = [flexneedle.plan(bare, (30.0, 0.5), strategy) for strategy in ("manipulation", "steering")]
    assert plans[0].controls.tobytes() == plans[1].controls.tobytes()


def test_a_search_that_still_improves_continues_as_long_as_the_scenario_allows():
    """The usual number, four iterations, is far too few here."""
    usual = {"plan.samples": 32, "plan.iterations": 4}
    first, later = (coarse(usual | {"plan.max_iterations": most}, seed=1) for most in (1, 200))
    assert (first.iterations, first.converged) == (4, False)
    assert later.converged
    assert 4 < later.iterations < 200
    assert later.cost < first.cost
    assert later.history[:4] == first.history


@pytest.mark.parametrize(
    ("target", "strategy", "changes", "limit"),
    [
        (LATERAL, "steering", {}, "needle.bevel.offset_mm = 4 (the bevel alone reaches -1.796 to 1.796 mm"),
        # Without a roll the bevel pulls to one side.
        (
            (60.0, 0.0),
            "steering",
            {"plan.roll_weight_mm": 5e3},
            "plan.roll_weight_mm = 5000 (costs more than",
        ),
        ((45.0, 14.0), "manipulation", {"setup.max_guide_step_mm": 1e-3}, "setup.max_guide_step_mm = 0.001"),
        (
            (25.0, 5.0),
            "manipulation",
            GENTLE,
            "plan.peak_energy_weight_mm = 100000 (costs more than the miss)",
        ),
        ((25.0, 9.0), "manipulation", {"guard.needle_strain_percent": 0.02}, "guard.needle_strain_percent"),
        # Rolls cost too much, so the bevel pulls to one side, and the guide can hardly move.
        ((60.0, 0.0), "manipulation", HELD, "setup.max_guide_travel_mm = 0.05"),
    ],
)
def test_a_target_out_of_reach_is_reported_with_the_limit(target, strategy, changes, limit):
    plan = coarse(changes, target, strategy=strategy)
    assert not plan.reached
    assert plan.error_mm > 1.0
    assert plan.limit.startswith(limit)
    assert "\n" not in plan.limit


def test_stroke_is_named_when_it_binds():
    """A straight needle would just reach the depth; 28 mm lateral take 3 mm more."""
    plan = coarse(
        {"setup.max_guide_travel_mm": 30.0, "plan.iterations": 8, "plan.max_iterations": 8}, (81.5, 28.0)
    )
    assert plan.controls[:, DB_X].sum() == pytest.approx(110.0)
    assert plan.tip_mm[0] < 80.0
    assert plan.limit == "setup.stroke_mm = 110"


@pytest.mark.parametrize("depth", [81.4, 81.2])
def test_a_target_near_the_full_stroke_is_planned_within_it(depth):
    plan = coarse({"plan.iterations": 8}, (depth, 14.0))
    assert plan.controls[:, DB_X].sum() <= 110.0 + 1e-9


def test_unknown_strategy_names_the_choices():
    with pytest.raises(InputError, match=r"'push'.*manipulation, steering"):
        flexneedle.plan(PHANTOM, LATERAL, "push")


@pytest.mark.parametrize("target", [(82.0, 0.0), (0.0, 1.0), (40.0, 16.0), (np.nan, 0.0)])
def test_targets_that_the_scenario_excludes_are_refused(target):
    with pytest.raises(ScenarioError, match="target"):
        flexneedle.plan(PHANTOM, target)


def test_default_target_is_the_scenarios():
    plan = coarse({"target.depth_mm": 30.0, "target.lateral_mm": -2.0}, None)
    assert plan.target == (30.0, -2.0, 0.0)
    assert plan.tip_mm[0] == pytest.approx(30.0, abs=1e-5)


@pytest.mark.parametrize(
    ("key", "column", "other"),
    [("plan.base_sigma_mm", DB_Y, DB_THETA), ("plan.base_turn_sigma_mrad", DB_THETA, DB_Y)],
)
def test_scenario_frees_base_inputs(key, column, other):
    setup = PHANTOM.setup
    plan = coarse({key: 0.2})
    assert plan.controls[:, column].any()
    assert not plan.controls[:, other].any()
    limit = setup.max_base_step_mm if column == DB_Y else setup.max_base_turn_step
    assert np.abs(plan.controls[:, column]).max() <= limit + 1e-12
    still = coarse({key: 0.2}, strategy="steering")
    assert not still.controls[:, DB_Y:ROLL].any()


def test_guide_and_advance_are_fixed_without_sigma():
    plan = coarse({"plan.guide_sigma_mm": 0.0, "plan.advance_sigma_mm": 0.0})
    assert not plan.controls[:, DG_Y].any()
    assert (plan.controls[:, DB_X] <= 1.0 + 1e-9).all()
    assert (plan.controls[:-1, DB_X] > 0.85).all()


def test_without_a_guide_the_bevel_steers_and_the_limit_names_it():
    free = {"setup.guide_to_skin_mm": None}
    near = flexneedle.plan(PHANTOM.with_values({**free, "plan.samples": 48}), (40.0, 1.0))
    assert near.error_mm <= 0.05
    assert not near.controls[:, DG_Y].any()
    far = coarse({**free, "plan.guide_sigma_mm": 5.0}, (40.0, 14.0))
    assert not far.controls[:, DG_Y].any()
    assert far.limit.startswith("needle.bevel.offset_mm = 4 (the bevel alone reaches")


NEAR_THE_SKIN = {
    "in the plane": (world(4), (11.5, -10.0)),
    "in space": (world(4, rig="two-axes"), (11.5, -6.0, 8.0)),
}


@pytest.mark.parametrize("where", ["in space", pytest.param("in the plane", marks=pytest.mark.long)])
def test_a_target_near_the_skin_that_one_search_misses_is_reached(where, monkeypatch):
    """Both searches have one history, in which the best cost never rises."""
    scenario, target = NEAR_THE_SKIN[where]
    calls, found, carry_out = [], [], planner.carry_out
    monkeypatch.setattr(planner, "carry_out", lambda *args: found.append(carry_out(*args)) or found[-1])
    plan = flexneedle.plan(scenario, target, listeners=[lambda event: calls.append(event.info)])
    assert plan.error_mm <= 0.5
    assert plan.limit == ""
    assert plan.cost == plan.history[-1]["best"]
    assert [call["iteration"] for call in calls] == list(range(1, plan.iterations + 1))
    assert [call["best"] for call in calls] == [entry["best"] for entry in plan.history]
    assert sorted(entry["best"] for entry in plan.history)[::-1] == [entry["best"] for entry in plan.history]
    assert all(call["iteration"] <= call["iterations"] for call in calls)
    once = found[0]
    assert once.error_mm > 0.1
    assert once.history == plan.history[: once.iterations]


def test_a_plan_that_reaches_its_target_is_not_searched_again(monkeypatch):
    monkeypatch.setattr(planner, "widen_search", None)
    assert coarse(target=LATERAL).error_mm <= 0.1


def test_the_cost_depends_on_no_stiffness_if_needle_and_tissue_share_the_factor():
    """Forces and energies are 100 times as large, lengths and strains the same."""
    layers = [
        {**layer, "shear_modulus_kpa": 100.0 * layer["shear_modulus_kpa"]}
        for layer in PHANTOM.values()["tissue"]
    ]
    stiffer = {"tissue": layers, "needle.youngs_modulus_gpa": 100.0 * PHANTOM.needle.youngs_modulus_gpa}
    soft, stiff = coarse(), coarse(stiffer)
    assert stiff.strain_energy[-1] == pytest.approx(100.0 * soft.strain_energy[-1], rel=1e-4)
    assert stiff.terms == pytest.approx(soft.terms, rel=1e-4, abs=1e-9)
    np.testing.assert_allclose(stiff.controls, soft.controls, atol=1e-6)


def largest_strain(plan, scenario=PHANTOM):
    return max(bending_strain(state) for state in states_of(plan, scenario))


def test_a_plan_that_the_guard_would_refuse_is_not_reached_and_names_the_key():
    plan = coarse({"guard.needle_strain_percent": 0.01, "plan.limit_weight_mm": 0.0})
    assert plan.error_mm <= 1.0
    assert (plan.reached, plan.hit, plan.limit) == (False, False, "guard.needle_strain_percent")
    assert plan.refusal == f"needle strain {1e2 * largest_strain(plan):.3f} % > 0.01 %"
    assert f"the guard would refuse it: {plan.refusal} (guard.needle_strain_percent)" in plan.summary


def test_a_plan_keeps_a_fifth_of_a_limit_in_reserve():
    """The limit is the largest strain of the plan without it."""
    strain = largest_strain(planned(LATERAL, "manipulation"))
    limited = {"guard.needle_strain_percent": 1e2 * strain}
    plan = flexneedle.plan(PHANTOM.with_values(limited), LATERAL, seed=1)
    assert plan.reached
    assert largest_strain(plan) <= 0.82 * strain


def test_a_force_of_the_guide_is_charged_if_it_has_a_limit():
    free = coarse()
    assert "guide force" not in free.terms
    force = max(np.hypot(*state.reactions.guide_force) for state in states_of(free))
    plan = coarse({"guard.guide_force_n": 0.5 * force, "plan.limit_weight_mm": 0.0})
    assert (plan.limit, plan.terms["guide force"]) == ("guard.guide_force_n", 0.0)
    assert plan.refusal.startswith("guide force")
    assert not coarse({"guard.guide_force_n": 0.5 * force}).refusal


def test_the_tolerance_of_a_plan_is_a_spread_in_mm():
    search = planner.search_settings(PHANTOM.with_values({"plan.tolerance_mm": 0.02}).plan, 64)
    assert (search.tolerance, search.relative) == (0.02, False)


def test_a_plan_that_two_searches_miss_is_made_of_rolls_alone(monkeypatch):
    """Of the three plans the one of least cost as carried out is kept, though its search cost more."""
    found, carry_out = [], planner.carry_out
    monkeypatch.setattr(planner, "carry_out", lambda *args: found.append(carry_out(*args)) or found[-1])
    plan = flexneedle.plan(world(120))
    first, second, third = found
    assert min(first.error_mm, second.error_mm) > 0.1
    assert third.cost > first.cost
    assert plan.error_mm == third.error_mm < 0.05
    assert not plan.controls[:, DG_Y].any()
    assert plan.iterations == sum(each.iterations for each in found)


def test_a_second_search_that_is_worse_changes_nothing_but_the_history(monkeypatch):
    """Out of reach; the later searches have one iteration with half of the samples."""
    short = {"plan.samples": 16, "plan.iterations": 1, "plan.max_iterations": 1}
    far, search = {"setup.max_guide_step_mm": 0.01}, planner._search

    def worse(simulator, problem, rng, progress):
        fewer = short if made else {}
        made.append(search(Simulator(simulator.scenario.with_values(fewer)), problem, rng, progress))
        return made[-1]

    made = []
    monkeypatch.setattr(planner, "_search", worse)
    plan = coarse(far, (40.0, 15.0))
    first, *later = made
    assert not plan.reached
    assert plan.limit
    assert first.cost < min(each.cost for each in later)
    assert plan.cost == first.cost == plan.history[-1]["best"]
    assert plan.iterations == sum(each.search_state.iterations for each in made)
