"""The guard between loop and driver: no controller gets needle or tissue beyond a limit."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from flexneedle.control.interface import Controller, Decision
from flexneedle.loop.guard import Guard
from flexneedle.results import Action, Outcome
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.excess import bending_strain
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL, Control
from insertions import PHANTOM, RecordedPhantom, run
from observed import begun, in_tissue

FAR = {"setup.max_guide_travel_mm": 60.0, "setup.max_guide_step_mm": 2.0}
LATERAL = Control(dg_y=0.5)
SPACE = PHANTOM.with_values({"setup.axes": 2})


def guard_of(plan, **values):
    keys = {f"guard.{key}": value for key, value in values.items()}
    return Guard.of(PHANTOM.with_values(keys), plan)


def driven(simulator, state, command, count):
    for _ in range(count):
        state = simulator.step(state, command)
    return state


def estimate_at(state):
    return begun(Simulator(state.scenario, 1), state)


# ---- limits


def test_by_default_tissue_may_be_compressed_to_a_share_of_what_its_law_allows(plan):
    linear = {"law": "linear", "thickness_mm": 20.0, "shear_modulus_kpa": 1.82, "compression_length_mm": 20.0}
    layers = [{**linear, "engaged_width_mm": 5.2}, PHANTOM.values()["tissue"][1]]
    scenario = Scenario.from_values({**PHANTOM.values(), "tissue": layers})
    laws = laws_of(scenario.tissue)[0]
    assert len({law.law for law in laws}) == 2
    assert Guard.of(scenario, plan).loads.compression == pytest.approx([0.95 * law.limit for law in laws])
    assert guard_of(plan, least_stretch=0.6).loads.compression == pytest.approx([0.4])


def test_the_strain_of_a_cantilever_equals_beam_theory():
    """In air the guide bends the needle over its distance a from the clamp: M = F a, strain M d/2EI."""
    simulator, needle = Simulator(PHANTOM, 1), PHANTOM.needle
    bent = driven(simulator, simulator.start(), LATERAL, 10)
    arm = -PHANTOM.setup.guide_to_skin_mm - float(bent.base[0])
    moment = 3.0 * needle.bending_stiffness * 5.0 / arm**2
    assert bent.reactions.guide_force[0] * arm == pytest.approx(moment, rel=1e-3)
    expected = moment * needle.outer_diameter / (2.0 * needle.bending_stiffness)
    assert bending_strain(bent) == pytest.approx(expected, rel=1e-3)
    assert bending_strain(simulator.start()) == pytest.approx(0.0, abs=1e-12)


def test_the_strain_in_tissue_follows_from_the_curvature():
    simulator = Simulator(PHANTOM, 1)
    bent = driven(simulator, in_tissue(simulator, 49), LATERAL, 8)
    curvature = np.abs(np.gradient(bent.nodes[:, 3], bent.nodes[:, 0]))
    expected = curvature.max() * PHANTOM.needle.outer_diameter / 2.0
    assert bending_strain(bent) == pytest.approx(expected, rel=0.1)


def test_the_scenario_sets_the_limits(plan):
    guard = guard_of(plan, guide_force_n=0.2, past_target_mm=0.5, needle_strain_percent=0.1)
    assert (guard.past, guard.depth) == (0.5, plan.target[0])
    assert (guard.loads.force, guard.loads.strain) == (0.2, 0.001)
    assert (guard_of(plan).loads.force, guard_of(plan).loads.strain) == (math.inf, 0.01)


# ---- commands


def test_a_command_within_the_limits_is_not_refused(plan):
    estimate = estimate_at(in_tissue(Simulator(PHANTOM, 1), 40))
    both = Control(db_x=1.0, dg_y=-0.5, flip=True)
    for command in (STILL, Control(db_x=1.0), LATERAL, both, Control(db_x=-1.0)):
        assert Guard.of(PHANTOM, plan).refusal(estimate, command) == ""


@pytest.mark.parametrize(
    ("limit", "reason", "back"),
    [
        ({"guide_force_n": 0.05}, r"guard: guide force 0\.\d+ N > 0\.05 N", Control(dg_y=-0.5)),
        ({"needle_strain_percent": 0.01}, r"guard: needle strain 0\.\d{3} % > 0\.01 %", Control(dg_y=-0.5)),
        ({"least_stretch": 0.99}, r"guard: tissue stretch 0\.\d{3} < 0\.990", Control(dg_y=-0.5)),
        ({"past_target_mm": 0.1}, r"guard: tip \d\.\d{3} mm past the target > 0\.1 mm", Control(db_x=-1.0)),
    ],
)
def test_beyond_a_limit_a_command_may_lead_back_but_not_on(plan, limit, reason, back):
    """The state after the command is compared with the state before it."""
    simulator = Simulator(PHANTOM, 1)
    state = driven(simulator, in_tissue(simulator, 49), LATERAL, 8)
    guard = guard_of(replace(plan, target=(20.0, 0.0, 0.0)), **limit)
    estimate, worse = estimate_at(state), Control(db_x=1.0, dg_y=0.5)
    assert re.fullmatch(reason, guard.refusal(estimate, worse))
    assert guard.refusal(estimate, back) == ""
    assert guard.refusal(estimate, STILL) == ""


@pytest.mark.parametrize("degrees", [45.0, 90.0, 270.0])
def test_the_force_of_the_guide_is_limited_alike_in_every_direction(plan, degrees):
    """In air, where the needle is as stiff to all sides."""
    simulator, angle = Simulator(SPACE, 1), math.radians(degrees)
    along_y = abs(driven(simulator, simulator.start(), LATERAL, 5).reactions.guide_force[0])
    command = Control(dg_y=0.5 * math.cos(angle), dg_z=0.5 * math.sin(angle))
    estimate = estimate_at(driven(simulator, simulator.start(), command, 4))
    refusal = guard_of(plan, guide_force_n=0.99 * along_y).refusal(estimate, command)
    assert refusal.startswith("guard: guide force")
    assert guard_of(plan, guide_force_n=1.01 * along_y).refusal(estimate, command) == ""


def test_a_model_that_does_not_converge_is_no_prediction(plan, monkeypatch):
    estimate = estimate_at(in_tissue(Simulator(PHANTOM, 1), 40))
    monkeypatch.setattr(State, "converged", property(lambda _: False))
    assert Guard.of(PHANTOM, plan).refusal(estimate, LATERAL).startswith("guard: the model does not converge")


def test_a_refusal_takes_one_step_of_the_model(plan, monkeypatch):
    estimate, rows = estimate_at(in_tissue(Simulator(PHANTOM, 1), 40)), []
    carry_out = Simulator._carry_out
    monkeypatch.setattr(
        Simulator, "_carry_out", lambda *given: rows.append(len(given[2])) or carry_out(*given)
    )
    Guard.of(PHANTOM, plan).refusal(estimate, LATERAL)
    assert rows == [1]


# ---- in the loop


def wild(begin_at, command):
    """A controller that advances straight and repeats one command below a depth (mm)."""

    def decide(_task, _memory, estimate, _rng):
        inside = estimate.state.tip[0] > begin_at
        return Decision(command if inside else Control(db_x=1.0), "wild" if inside else "straight"), None

    return Controller(
        "wild", "runs wild in the tissue", decide=decide, arrived=lambda *_: False, predicts=True
    )


def test_a_wild_guide_is_stopped_and_the_insertion_held_with_the_reason(plan):
    """Also with `force`."""
    scenario = PHANTOM.with_values(FAR)
    recorded = RecordedPhantom(plan.roll, scenario=scenario)
    deeper = replace(plan, scenario=None, target=(30.0, 0.0, 0.0))
    done = run(deeper, recorded.rig(), scenario, controller=wild(15.0, Control(dg_y=2.0)), force=True)
    assert done.outcome is Outcome.HELD
    assert done.reason.startswith(("guard: needle strain", "guard: tissue stretch"))
    held = [period for period in done.periods if period.decision.startswith("held: guard: ")]
    assert {(period.action, period.command, period.applied) for period in held} == {
        (Action.HOLD, STILL, STILL)
    }
    limit = PHANTOM.control.hold_limit_s
    assert done.periods[-1].time - held[0].time == pytest.approx(limit, abs=0.05)
    wild_periods = [period for period in done.periods if period.decision == "wild"]
    assert len(wild_periods) >= 3
    assert done.periods[-1].true_stretch >= 0.3


def test_a_controller_that_does_not_stop_is_held_behind_the_target(plan):
    short = replace(plan, target=(5.0, 0.0, 0.0))
    done = run(short, RecordedPhantom(plan.roll).rig(), controller=wild(100.0, STILL), force=True)
    assert done.outcome is Outcome.HELD
    assert "mm past the target > 2 mm" in done.reason
    assert 5.0 < done.periods[-1].true_tip.x <= 7.2


def test_a_hold_ends_with_a_command_that_the_guard_admits(plan):
    """Refused four times, then back."""

    def decide(_task, memory, estimate, _rng):
        before, refused = memory or (-100.0, 0)
        tip = float(estimate.state.tip[0])
        refused += tip > 5.0 and abs(tip - before) < 0.5
        return Decision(Control(db_x=-1.0 if refused == 4 else 1.0), "back" if refused == 4 else "on"), (
            tip,
            refused,
        )

    method = Controller(
        "doubting", "advances, then retreats", decide=decide, arrived=lambda _, memory, __: memory[1] == 4
    )
    done = run(
        replace(plan, target=(5.0, 0.0, 0.0)), RecordedPhantom(plan.roll).rig(), controller=method, force=True
    )
    back = next(period.index for period in done.periods if period.decision == "back")
    actions = [period.action for period in done.periods[back - 5 : back + 1]]
    assert actions == [Action.MOVE, *[Action.HOLD] * 4, Action.MOVE]


def test_an_ordinary_insertion_is_not_held_by_it(real):
    assert real[0].outcome is Outcome.DONE
    assert not any("guard" in period.decision for period in real[0].periods)


# ---- the advance by the tracker


@pytest.mark.parametrize("scale", [0.96, 1.04])
def test_a_needle_that_advances_far_more_or_less_than_commanded_is_held(plan, scale):
    """The limit is three standard deviations of the scenario's prior of the scale."""
    even = [(travel, (scale - 1.0) * travel, 1e-4) for travel in np.arange(30.0)]
    estimate = replace(
        estimate_at(Simulator(PHANTOM, 1).start()), axial_scale=0.5 * (1.0 + scale), advances=(*even,)
    )
    assert guard_of(plan).refusal(estimate, Control(db_x=1.0)) == "", (
        "the prior may keep the scale within the limit"
    )
    estimate = replace(estimate, axial_scale=scale)
    refusal = guard_of(plan).refusal(estimate, Control(db_x=1.0))
    assert refusal == (
        f"guard: by the tracker the needle advances {scale:.3g} times as far as commanded (limit 1 ± 0.03): "
        "check insertion axis and tracker (flexneedle rig test)"
    )
    wide = Guard.of(PHANTOM.with_values({"control.axial_scale_sd": 0.02}), plan)
    assert wide.refusal(estimate, Control(db_x=1.0)) == ""


@pytest.mark.parametrize("off", [-0.5, 0.5])
def test_readings_that_are_late_now_and_then_are_no_scale_of_the_advance(plan, off):
    """The scale that fits them best is beyond its limit; the reason names what they are."""
    late = [(travel, off * (travel > 20.0), 1e-4) for travel in np.arange(30.0)]
    estimate = replace(
        estimate_at(Simulator(PHANTOM, 1).start()), axial_scale=1.0 + 0.08 * off, advances=(*late,)
    )
    refusal = guard_of(plan).refusal(estimate, Control(db_x=1.0))
    assert refusal.startswith("guard: the tracker's readings fit no even advance (off by 0.14 mm, limit ")
    assert "late now and then, as on a busy computer" in refusal
