"""Endings of an insertion away from its target, and drivers that do not execute the command exactly."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
import flexneedle.control
from flexneedle.control.controllers import CONTROLLERS, DEFAULT, adaptive_mpc
from flexneedle.errors import RunError
from flexneedle.loop.rig import Rig
from flexneedle.simulator.state import State
from flexneedle.types import Measurement
from insertions import (
    PHANTOM,
    STILL,
    RecordedPhantom,
    TapedRig,
    first_periods,
    moving,
    of_any_scenario,
    run,
)


def missing_by(plan, miss):
    tips = plan.tips.copy()
    tips[-1, :2] = plan.target[0], plan.target[1] + miss
    return replace(plan, tips=tips, limit="setup.max_guide_step_mm = 0.5")


def test_a_plan_that_misses_by_more_than_a_millimetre_is_rejected_unless_forced(plan):
    recorded = RecordedPhantom(plan.roll)
    with pytest.raises(
        RunError, match=r"misses the target by 1\.010 mm .*limited by setup\.max_guide_step_mm"
    ):
        run(missing_by(plan, 1.01), recorded.rig(), controller="open-loop")
    assert recorded.moves == []
    with pytest.raises(RunError):
        flexneedle.insert(PHANTOM, missing_by(plan, 1.01), seed=2001, controller="open-loop")
    for miss, force in ((1.01, True), (0.99, False)):
        rig = RecordedPhantom(plan.roll).rig()
        assert first_periods(1, missing_by(plan, miss), rig, force=force, controller="open-loop")


def test_a_controller_that_predicts_the_miss_is_held_by_that_and_not_by_the_plan(plan):
    """The miss of the plan does not apply to the phantom's needle; the insertion itself predicts the miss."""
    assert CONTROLLERS[DEFAULT].predicts
    assert not any(method.predicts for name, method in CONTROLLERS.items() if name != DEFAULT)
    assert first_periods(1, missing_by(plan, 1.01), RecordedPhantom(plan.roll).rig(), controller=DEFAULT)


class Stuck(TapedRig):
    """A driver that does not move, with a tracker that measures the needle at rest."""

    def __init__(self):
        super().__init__([])

    def apply(self, command, duration):
        return super().apply(command, duration)._replace(control=STILL)

    def read(self):
        return (Measurement(self.time, -28.5, 0.0),)


def test_a_needle_that_does_not_move_fails_after_four_times_the_planned_periods(plan):
    short = replace(plan, controls=plan.controls[:5], tips=plan.tips[:6], guide=plan.guide[:6])
    done = run(short, Stuck().rig(), force=True)
    assert done.outcome == "failed"
    assert "within 4 times the planned steps" in done.reason
    assert len(done.periods) == 20
    assert {period.applied for period in done.periods} == {STILL}
    assert done.periods[0].command.db_x > 0.0


def test_a_model_that_does_not_converge_ends_the_run(plan, monkeypatch):
    monkeypatch.setattr(State, "converged", property(lambda _: False))
    done = run(plan, RecordedPhantom(plan.roll).rig())
    assert done.outcome == "failed"
    assert done.reason.startswith("the model did not converge")
    assert len(done.periods) == 1
    assert not done.periods[0].converged


def test_the_needle_is_held_if_no_path_converges(plan, monkeypatch):
    rollout, calls = adaptive_mpc.rollout_as_measured, itertools.count()

    def lost(*args, **wanted):
        outcome = rollout(*args, **wanted)
        kept = next(calls) < 8
        return outcome if kept else replace(outcome, converged=np.zeros_like(outcome.converged))

    monkeypatch.setattr(adaptive_mpc, "rollout_as_measured", lost)
    done = run(plan, RecordedPhantom(plan.roll).rig(), controller=DEFAULT)
    assert (done.outcome, done.reason) == ("held", "no path converges on the fitted model")
    assert {period.applied for period in done.periods[-3:]} == {STILL}
    assert done.periods[-1].decision == "held: no path converges on the fitted model"


def test_a_plant_that_does_not_converge_is_recorded_in_its_periods(plan):
    """The controller has no access to the plant: the insertion continues, but its periods are not converged."""
    recorded = RecordedPhantom(plan.roll)
    lost_after = 1.0

    def truth():
        return recorded.phantom.condition()._replace(converged=recorded.phantom.now() < lost_after)

    in_air = replace(plan, target=(-20.0, 0.0, 0.0))
    done = run(in_air, Rig(recorded.phantom, recorded, recorded, truth), force=True)
    assert done.outcome == "done"
    assert [period.converged for period in done.periods] == [p.time < lost_after for p in done.periods]
    assert {period.converged for period in done.periods} == {True, False}


def test_the_end_of_the_stroke_ends_the_run_with_a_reason(plan):
    short = PHANTOM.with_values({"setup.stroke_mm": 40.0, "target.depth_mm": 10.0})
    recorded = RecordedPhantom(plan.roll, scenario=short)
    done = run(of_any_scenario(plan), recorded.rig(), short)
    assert sum(command.db_x for _, command in recorded.moves) == pytest.approx(40.0, abs=0.01)
    left = plan.target[0] - done.periods[-1].estimate.x
    assert done.reason.startswith(f"stroke ends {left:.3f} mm before the target depth; missed the target by ")
    assert not done.reached


class Rounding(RecordedPhantom):
    """A driver with a resolution of 0.05 mm in the guide."""

    def apply(self, command, duration):
        rounded = round(command.dg_y / 0.05) * 0.05
        return super().apply(command._replace(dg_y=rounded), duration)


def test_the_command_as_applied_is_recorded_and_used_by_the_estimate(plan):
    known = PHANTOM.with_values(
        {"phantom.start_axial_sd_mm": 0.0, "control.start_axial_sd_mm": 0.0, "control.axial_scale_sd": 0.0}
    )
    recorded = Rounding(plan.roll, scenario=known)
    done = run(plan, recorded.rig(), known)
    assert any(period.command.dg_y != period.applied.dg_y for period in done.periods)
    applied = np.cumsum([period.applied.dg_y for period in done.periods])
    np.testing.assert_allclose([period.guide[0] for period in done.periods], applied, atol=1e-12)
    advance = sum(period.applied.db_x for period in done.periods)
    assert done.periods[-1].base.x == pytest.approx(PHANTOM.start_base_x + advance)
    assert [period.applied for period in moving(done)] == recorded.applied
    assert done.outcome == "done"


def test_without_a_truth_the_true_error_is_not_known(plan, quick):
    """The tracker decides whether the target is reached; the commands are the same."""
    done, recorded = quick
    replayed = run(plan, TapedRig(recorded.tape, recorded.applied).rig())
    commands = [[period.command for period in one.periods] for one in (done, replayed)]
    assert commands[0] == commands[1]
    assert math.isnan(replayed.true_error_mm)
    assert replayed.error_mm == replayed.residual_mm <= 1.0
    assert replayed.reached
    assert (
        replayed.summary
        == f"reached: the tip ended {replayed.residual_mm:.3f} mm from the target by the tracker"
    )
    missed = replace(replayed, plan=replace(replayed.plan, target=(40.0, 7.0, 0.0)))
    assert not missed.reached
    assert missed.summary.endswith("mm from the target by the tracker, more than 1 mm")
    assert {period.true_tip for period in replayed.periods} == {None}
    assert {period.true_strain_energy for period in replayed.periods} == {None}
    assert {period.true_stretch for period in replayed.periods} == {None}
    assert replayed.residual_mm == done.residual_mm


class Longer(RecordedPhantom):
    """A driver whose insertion axis moves `factor` times as far as commanded, and reports what was commanded."""

    factor = 1.0

    def apply(self, command, duration):
        motion = super().apply(command._replace(db_x=self.factor * command.db_x), duration)
        return motion._replace(control=motion.control._replace(db_x=motion.control.db_x / self.factor))


@pytest.mark.parametrize("controller", ["adaptive-mpc", "ce-mpc"])
def test_a_hold_for_readings_that_are_late_for_a_while_claims_no_scale(plan, controller):
    """A busy computer: from 2 s on the readings are 0.3 s behind the needle, and dated as if they were not."""

    def spoil(batch):
        return [
            replace(one, x=one.x - phantom.tip_at(one.time)[0] + phantom.tip_at(one.time - 0.3)[0])
            if one.time > 2.0
            else one
            for one in batch
        ]

    recorded = RecordedPhantom(plan.roll, spoil=spoil)
    phantom = recorded.phantom
    done = run(plan, recorded.rig(), controller=controller)
    assert done.outcome == "held"
    assert "fit no even advance" in done.reason
    assert "late now and then, as on a busy computer" in done.reason


@pytest.mark.parametrize("controller", ["adaptive-mpc", "ce-mpc"])
@pytest.mark.parametrize(
    ("factor", "outcome"), [(0.9, "held"), (1.1, "held"), (0.985, "done"), (1.02, "done")]
)
def test_a_wrong_scale_of_the_insertion_axis_is_found_by_the_tracker(plan, controller, factor, outcome):
    """A large one ends the insertion, still in air; a small one is fitted, and the tip ends at the target's depth."""
    wide = {
        "setup.max_advance_mm": 1.1 * PHANTOM.setup.max_advance_mm,
        "setup.insertion_speed_mm_s": 1.1 * PHANTOM.setup.insertion_speed_mm_s,
    }
    recorded = Longer(plan.roll, scenario=PHANTOM.with_values(wide))
    recorded.factor = factor
    done = run(plan, recorded.rig(), controller=controller)
    assert done.outcome == outcome
    depth = done.periods[-1].true_tip.x
    if outcome == "done":
        assert depth == pytest.approx(plan.target[0], abs=0.1)
    else:
        assert "times as far as commanded" in done.reason
        assert depth < 0.0
