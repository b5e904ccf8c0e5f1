"""Response of the loop to a predicted miss: warning, hold, abort with the reason; or continuation with force."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control.controllers import DEFAULT
from flexneedle.control.interface import Controller, Decision
from flexneedle.record.fields import to_row
from flexneedle.scenario.worlds import world
from flexneedle.types import Control
from insertions import PHANTOM, STILL, RecordedPhantom, moving, of_any_scenario, run

SECONDS = PHANTOM.control.hold_limit_s
HELD = "held: no path to the target found"


def predicting(misses, sd=0.1):
    """A controller that inserts straight and predicts these misses (mm), then the last one repeatedly."""

    def decide(_task, memory, _estimate, _rng):
        miss = misses[min(memory, len(misses) - 1)]
        return Decision(Control(db_x=1.0), "straight", miss=miss, miss_sd=sd), memory + 1

    return Controller("straight-on", "inserts straight", decide=decide, begin=lambda _task: 0)


def in_air(plan):
    """The plan with a target in air: fast, without bending."""
    return replace(plan, target=(-20.0, 0.0, 0.0))


def inserted(plan, misses, sd=0.1, *, force=True, scenario=PHANTOM):
    """An insertion with such a controller."""
    recorded = RecordedPhantom(plan.roll, scenario=scenario)
    return run(plan, recorded.rig(), scenario, controller=predicting(misses, sd), force=force), recorded


def test_without_a_path_the_needle_is_held_and_the_insertion_aborted_with_the_reason(plan):
    """The needle rests from the first such decision; the reason gives the miss, the limit and the remedy."""
    done, recorded = inserted(plan, [0.0] * 5 + [3.0], force=False)
    assert done.outcome == "held"
    assert done.reason.startswith("no path to the target found: predicted miss +3.000 ± 0.100 mm is beyond")
    assert "control.miss_limit_mm = 2 " in done.reason
    assert done.reason.endswith("to insert anyway: flexneedle insert --force (force=True)")
    assert done.summary.endswith(done.reason)
    assert len(recorded.moves) == 5
    stopped = [period for period in done.periods if period.decision.startswith(HELD)]
    assert [period.index for period in stopped] == list(range(5, 5 + len(stopped)))
    assert {period.applied for period in stopped} == {period.command for period in stopped} == {STILL}
    before = done.periods[4].time
    assert done.periods[-1].time - before == pytest.approx(SECONDS, abs=2.0 * PHANTOM.tracker.period)
    assert done.held_s == pytest.approx(done.periods[-1].time - before)


def test_a_hold_ends_when_a_path_is_found_again(plan):
    """Held for less than the limit; the next hold has the whole limit again."""
    misses = [0.0] * 3 + [3.0] * 10 + [0.0] * 3 + [3.0]
    done, recorded = inserted(plan, misses, force=False)
    assert len(recorded.moves) == 6
    assert done.outcome == "held"
    last = max(period.time for period in done.periods if not period.decision.startswith(HELD))
    assert done.periods[-1].time - last == pytest.approx(SECONDS, abs=2.0 * PHANTOM.tracker.period)


def test_force_continues_with_a_warning(plan):
    done, recorded = inserted(in_air(plan), [3.0], force=True)
    assert done.outcome == "done"
    assert len(recorded.moves) >= 8
    assert done.warning == "predicted miss +3.000 ± 0.100 mm: likely beyond 1 mm"
    assert to_row(done.periods[-1])["warning"] == done.periods[-1].warning
    assert sum(bool(period.warning) for period in moving(done)) > len(moving(done)) - 4
    assert not any("nan" in period.warning for period in done.periods)


@pytest.mark.parametrize(("miss", "sd", "warned"), [(1.5, 0.1, True), (-1.1, 0.5, True), (0.5, 0.1, False)])
def test_a_likely_miss_gives_a_warning_and_no_hold(plan, miss, sd, warned):
    done, _ = inserted(in_air(plan), [miss], sd)
    assert done.outcome == "done"
    assert bool(done.warning) is warned
    recorded = [(period.miss, period.miss_sd) for period in moving(done)]
    assert set(recorded) == {((miss, 0.0), sd)}


def test_a_doubt_of_the_controller_is_a_warning(plan):
    def decide(_task, memory, _estimate, _rng):
        return Decision(Control(db_x=1.0), "straight", doubt="softer than expected"), memory

    recorded = RecordedPhantom(plan.roll, scenario=PHANTOM)
    doubting = Controller("doubting", "inserts straight", decide=decide)
    done = run(in_air(plan), recorded.rig(), PHANTOM, controller=doubting, force=True)
    assert done.outcome == "done"
    assert done.warning == "softer than expected"


def test_a_miss_in_space_is_recorded_with_its_direction(plan):
    done, _ = inserted(in_air(plan), [0.3 - 0.4j])
    assert {period.miss for period in moving(done)} == {(0.3, -0.4)}
    row = to_row(moving(done)[0])
    assert (row["miss_y_mm"], row["miss_z_mm"], row["miss_sd_mm"]) == ("0.3", "-0.4", "0.1")


def test_a_controller_without_predictions_gets_neither_hold_nor_warning(plan):
    done, _ = inserted(in_air(plan), [np.nan], np.nan)
    assert done.outcome == "done"
    assert done.warning == ""
    assert all(np.isnan(period.miss).all() for period in done.periods)


def test_a_miss_that_was_not_predicted_is_reported_in_the_reason_without_a_warning(plan):
    """A study can then count the misses without a warning."""
    lateral = replace(in_air(plan), target=(-20.0, 3.0, 0.0))
    done, _ = inserted(lateral, [0.0])
    assert done.outcome == "done"
    assert done.reason.startswith("missed the target by 3.")
    assert done.warning == ""


@pytest.mark.long
def test_an_unreachable_target_is_held(plan):
    """The plan needs a larger guide motion than this rig permits, and the bevel is too weak to compensate."""
    narrow = PHANTOM.with_values(
        {"setup.max_guide_travel_mm": 0.1, "needle.bevel.offset_mm": 0.5, "target.lateral_mm": 0.0}
    )
    recorded = RecordedPhantom(plan.roll, scenario=narrow)
    done = run(of_any_scenario(plan), recorded.rig(), narrow, controller=DEFAULT)
    assert done.outcome == "held"
    assert done.reason.startswith("no path to the target found: predicted miss -")
    assert done.periods[-1].estimate.x < 0.0  # it is known before the needle enters


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 3])
def test_with_a_perfect_model_it_ends_at_the_target(number):
    """Worlds whose plant is the model, with the tracker's noise, and no warning."""
    scenario = world(number, "perfect")
    plan = flexneedle.plan(scenario, seed=0, threads=1)
    done = flexneedle.insert(scenario, plan, 0, rig=flexneedle.VirtualRig("model"), threads=1)
    assert done.outcome == "done"
    assert done.true_error_mm < 0.15
    assert done.warning == ""


@pytest.mark.parametrize(
    ("controller", "gap"), [pytest.param(DEFAULT, -2.0, marks=pytest.mark.long), ("resolved-rate", 2.0)]
)
def test_the_depth_is_reached_with_an_axial_start_error(plan, controller, gap):
    """The scenario's tip is 2 mm further from the skin than the plant's, or 2 mm nearer."""
    nothing = {
        key: value
        for key, value in world(1, "perfect").flat().items()
        if key.startswith("phantom.") and "structure" not in key
    }
    scenario = PHANTOM.with_values(nothing)
    recorded = RecordedPhantom(plan.roll, scenario=scenario.with_values({"setup.tip_to_skin_mm": 28.5 + gap}))
    done = run(plan, recorded.rig(), scenario, controller=controller)
    assert done.outcome == "done"
    assert done.periods[-1].true_tip.x == pytest.approx(plan.target[0], abs=0.1)
