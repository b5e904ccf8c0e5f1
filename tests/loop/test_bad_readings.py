"""The closed loop with a tracker that fails: it holds the needle, resumes, or aborts."""

import math
from dataclasses import replace
from itertools import cycle, pairwise

import numpy as np
import pytest

from flexneedle.control.controllers import DEFAULT
from insertions import (
    PHANTOM,
    READING,
    STILL,
    RecordedPhantom,
    TapedRig,
    acted,
    blind,
    loop,
    lost,
    run,
    spoilt_tape,
)


def garbled(measurement):
    return replace(measurement, y=math.nan)


def old(measurement):
    return replace(measurement, time=measurement.time - 0.5)


def jumping(measurement):
    return replace(measurement, y=measurement.y + 3.0)


FAULTS = {
    "missing: no reading": lost,
    "missing: tip not measured": blind,
    "not a number": garbled,
    "stale: 0.500 s old": old,
    "innovation: ": jumping,
}


def between(first, last, fault):
    """Apply a fault to the readings taken within [first, last) s."""

    def spoil(batch):
        spoilt = [fault(one) if first <= one.time < last else one for one in batch]
        return tuple(one for one in spoilt if one is not None)

    return spoil


def bad(done):
    return [period for period in done.periods if not period.verdict.ok]


def test_bad_readings_hold_the_needle_until_good_ones_return(plan):
    """Each fault lasts 0.6 s, in air and in tissue; the limit of 1 s is for each hold, not for their sum."""
    spells = [(2.69 + 1.3 * k, *fault) for k, fault in zip(range(10), cycle(FAULTS.items()), strict=False)]
    spoilers = [between(begin, begin + 0.6, fault) for begin, _, fault in spells]

    def spoil(batch):
        for spoiler in spoilers:
            batch = spoiler(batch)
        return batch

    recorded = RecordedPhantom(plan.roll, spoil=spoil)
    done = run(plan, recorded.rig(), controller=DEFAULT)
    assert done.outcome == "done"
    assert done.true_error_mm < 1.0
    for begin, verdict, _ in spells:
        failed = [period for period in bad(done) if begin < period.time < begin + 0.7]
        first = failed[0].index
        assert [period.index for period in failed] == list(range(first, first + len(failed)))
        # The first reading of a displaced tip may be a jump from the one before.
        kinds = [str(period.verdict)[:11] for period in failed]
        assert {*kinds[1:]} == {verdict[:11]}
        assert kinds[0] == verdict[:11] or (kinds[0][:5] == "jump:" and verdict.startswith("innovation"))
        assert failed[0].time < begin + 0.4  # a period is bad without a reading, or with a bad last one
        assert begin + 0.55 < failed[-1].time < begin + 0.65
        # The period in which it was detected had moved; then nothing moves, and no reading is assimilated.
        held = done.periods[first + 1 : first + len(failed) + 1]
        assert {period.command for period in held} == {period.applied for period in held} == {STILL}
        assert [period.decision for period in held] == [
            f"held: measurement {each.verdict}" for each in failed
        ]
        assert not [
            time for time, _ in recorded.moves if failed[0].time - 1e-9 <= time < held[-1].time - 1e-9
        ]
        assert len({period.true_tip for period in (failed[0], *held)}) == 1
        assert {period.innovation for period in failed} == {(0.0, 0.0, 0.0)}
        for period in failed[1:]:
            np.testing.assert_allclose(period.estimate, failed[1].estimate, atol=1e-6)
            np.testing.assert_allclose(period.estimate, failed[0].estimate, atol=0.15)  # the estimated play
            assert period.tip_load == failed[0].tip_load
        # With the first good reading it resumes.
        assert held[-1].verdict.ok
        assert done.periods[held[-1].index + 1].command.db_x > 0.0
    assert sum(period.action == "move" for period in done.periods) <= 1.1 * len(plan.controls)


@pytest.mark.parametrize(("verdict", "fault"), FAULTS.items(), ids=FAULTS)
def test_after_the_hold_limit_the_run_ends_with_its_record(plan, verdict, fault):
    recorded = RecordedPhantom(plan.roll, spoil=between(3.01, math.inf, fault))
    done = run(plan, recorded.rig())
    failed = bad(done)
    assert (done.outcome, done.reached) == ("held", False)
    assert done.reason.startswith("held for 1.0")
    assert verdict in done.reason
    assert "limit 1.00 s" in done.reason
    assert failed[-1].index == done.periods[-1].index
    assert failed[-1].time - failed[0].time == pytest.approx(1.0, abs=1e-6)
    assert len(failed) == 41  # of 25 ms each after the first
    assert recorded.moves[-1][0] < failed[0].time
    assert done.periods[0].verdict.ok


@pytest.mark.parametrize("limit", [0.1, 12.0])  # in 12 s there are more readings than periods in a run
def test_the_scenario_sets_the_hold_limit(plan, limit):
    scenario = PHANTOM.with_values({"control.hold_limit_s": limit})
    failed = bad(run(plan, RecordedPhantom(plan.roll, spoil=between(1.0, math.inf, lost)).rig(), scenario))
    assert failed[-1].time - failed[0].time == pytest.approx(limit, abs=READING)


def test_all_holds_together_have_a_limit(plan):
    """Each hold is within its own limit; the insertion ends when the sum exceeds the total."""
    scenario = PHANTOM.with_values({"control.hold_total_s": 0.5})

    def spoil(batch):
        return tuple(one for one in batch if one.time % 1.0 <= 0.6 or one.time < 1.0)

    done = run(plan, RecordedPhantom(plan.roll, spoil=spoil).rig(), scenario)
    assert done.outcome == "held"
    assert done.reason.startswith(f"held for {done.held_s:.2f} s in all (limit 0.50 s): missing")
    assert 0.5 - 1e-6 <= done.held_s <= 0.5 + READING + 1e-6
    held = [period.action == "hold" for period in done.periods]
    assert sum(one and not before for before, one in pairwise(held)) >= 3


@pytest.mark.long
def test_the_scenario_limits_age_and_innovation(plan):
    def offset(measurement):
        return replace(measurement, time=measurement.time - 0.05, y=measurement.y + 1.2)

    def verdicts(scenario):
        done = run(plan, RecordedPhantom(plan.roll, spoil=between(8.0, 8.4, offset)).rig(), scenario)
        return {str(period.verdict).split(":")[0] for period in done.periods}

    assert verdicts(PHANTOM) == {"ok"}
    assert verdicts(PHANTOM.with_values({"control.innovation_limit_mm": 0.3})) == {"ok", "innovation"}
    assert verdicts(PHANTOM.with_values({"control.stale_after_s": 0.03})) == {"ok", "stale"}


def test_a_bad_reading_among_good_ones_is_not_used(plan, quick):
    """The result is the same as without it."""
    tape, applied = quick[1].tape, quick[1].applied
    kinds, none = cycle([blind, garbled, jumping]), cycle([lost])
    one, other = (
        run(plan, TapedRig(loop(spoilt_tape(tape, 1, lambda it, f=f: next(f)(it))), applied).rig())
        for f in (kinds, none)
    )
    assert list(map(acted, one.periods)) == list(map(acted, other.periods))
    assert one.outcome == "done"


def test_a_bad_reading_at_the_target_depth_does_not_count_as_arrival(plan, quick):
    """The needle is held there, and done with the next good reading."""
    done, recorded = quick
    *way, last = recorded.tape
    again = (replace(last[-1], time=last[-1].time + READING),)
    rig = TapedRig([*way, (garbled(last[-1]),), again], recorded.applied).rig()
    held = run(plan, rig)
    assert [str(period.verdict) for period in held.periods[-2:]] == ["not a number: y nan", "ok"]
    assert len(held.periods) == len(done.periods) + 1
    assert held.outcome == "done"
    assert held.periods[-1].command == STILL


def test_a_frozen_sensor_holds_the_driven_needle_within_a_period(plan):
    begin, frozen_at = 8.0, []

    def spoil(batch):
        frozen_at.extend(measurement for measurement in batch if measurement.time >= begin)
        return tuple(replace(s, x=frozen_at[0].x, y=frozen_at[0].y) if s.time >= begin else s for s in batch)

    done = run(plan, RecordedPhantom(plan.roll, spoil=spoil).rig())
    assert done.outcome == "held"
    first = bad(done)[0]
    assert str(first.verdict).startswith("frozen: ")
    assert begin < first.time < begin + 0.4
