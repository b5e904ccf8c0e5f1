"""The closed loop with delayed and missing readings."""

from dataclasses import replace

import numpy as np
import pytest

from insertions import (
    HELD,
    PHANTOM,
    READING,
    RESTING,
    STILL,
    TapedRig,
    blind,
    moving,
    run,
)


def test_after_the_last_move_it_rests_until_a_reading_at_rest_arrives(plan, late):
    """The readings of the last move arrive a period later; the record ends with a reading at rest."""
    done, recorded = late
    assert (done.outcome, done.reason) == ("done", "")
    rests = [period for period in done.periods if period.decision == RESTING]
    assert rests
    assert list(done.periods[-len(rests) :]) == rests
    arrival = done.periods[-len(rests) - 1]
    assert arrival.decision != RESTING
    assert arrival.estimate.x >= plan.target[0] - PHANTOM.control.depth_tolerance_mm
    assert {(period.command, period.applied) for period in rests} == {(STILL, STILL)}
    assert len(recorded.moves) == len(moving(done))
    assert {period.true_tip for period in rests} == {arrival.true_tip}
    assert done.periods[-1].measurement.time > arrival.time - 1e-6
    assert all(period.measurement.time < arrival.time - 1e-6 for period in done.periods[: -len(rests)])
    assert done.periods[-1].time == pytest.approx(arrival.time + 0.2)
    assert recorded.phantom.now() == done.periods[-1].time
    off = np.subtract((done.periods[-1].measurement.x, done.periods[-1].measurement.y), arrival.true_tip[:2])
    assert np.abs(off).max() < 4.0 * PHANTOM.tracker.jitter_per_axis


def test_delayed_readings_are_used_at_their_time_of_measurement(late, real):
    """Innovations are as small as without a delay, although the needle moves by 1 mm per period."""
    for done, recorded in (late, real):
        off = np.array([period.innovation for period in done.periods[20:]])
        assert np.sqrt((off**2).mean(axis=0)).max() < 0.15
        assert all(str(period.verdict) == "ok" for period in done.periods)
        assert recorded.tape[30][-1].time == pytest.approx(
            done.periods[30].time - (0.2 if recorded is late[1] else 0.0)
        )


def test_a_bad_reading_at_rest_holds_the_needle_until_a_good_one(plan, late):
    """The needle has arrived: there is no further move."""
    done, recorded = late
    tape, rests = list(recorded.tape), sum(period.decision == RESTING for period in done.periods)
    spoilt = tuple(map(blind, tape[-1]))
    again = [replace(sample, time=sample.time + READING) for sample in tape[-1]]
    held = run(plan, TapedRig([*tape[:-1], spoilt, again], recorded.applied).rig())
    assert held.outcome == "done"
    assert len(held.periods) == len(done.periods) + 1
    assert [period.decision for period in held.periods[-rests - 1 :]] == [*[RESTING] * rests, HELD]
    assert [str(period.verdict) for period in held.periods[-2:]] == ["missing: tip not measured", "ok"]


def test_missing_readings_hold_the_needle_for_one_reading_each(plan, inserted):
    """20 %, as in the scenario: the needle is held whenever the newest reading has no tip."""
    done = inserted(2001, controller="resolved-rate", phantom__missing_fraction=0.2)
    assert done.outcome == "done"
    blind = [period.index for period in done.periods if str(period.verdict) == "missing: tip not measured"]
    assert len(blind) > 5
    for index in blind:
        after = done.periods[index + 1]
        assert (after.decision, after.command) == (HELD, STILL)
        assert after.time - done.periods[index].time == pytest.approx(READING)
        assert after.true_tip == done.periods[index].true_tip
    assert {period.index for period in done.periods if period.decision == HELD} == {k + 1 for k in blind}
    assert len(moving(done)) <= 1.1 * len(plan.controls)
    assert done.true_error_mm < 1.0


def test_a_delay_beyond_the_age_limit_holds_from_the_start(inserted):
    """All readings are older than the limit of 0.3 s and rejected, and nothing moves."""
    done = inserted(2001, phantom__delay_periods=1.75)
    assert done.outcome == "held"
    assert "stale: 0.350 s old, limit 0.300 s" in done.reason
    assert done.periods[-1].time == pytest.approx(1.0)
    assert {period.command for period in done.periods} == {STILL}
