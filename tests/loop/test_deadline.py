"""A decision that comes late is used only if nothing has changed since it was made; until then the needle rests."""

import math
from dataclasses import replace

import pytest

from flexneedle.control.controllers import CONTROLLERS, DEFAULT
from flexneedle.control.interface import Controller, Decision
from flexneedle.errors import InputError
from flexneedle.loop.loop_state import LateDecision
from flexneedle.record.fields import from_row, to_row
from flexneedle.results import Action, Outcome
from flexneedle.types import STILL
from insertions import READING, RecordedPhantom, blind, run
from phantoms import STRAIGHT

DEADLINE_S, TAKEN_S = 0.2, 0.35
LATE = 3  # the number of the decision
IN_TISSUE = 32
WARNED = "late: decided in 0.350 s, limit 0.200 s"


class Slow:
    """A controller that advances, and whose decisions with these numbers take longer on the clock of the rig."""

    def __init__(self, recorded, *late, seconds=TAKEN_S):
        self.recorded, self.late, self.seconds, self.count = recorded, late, seconds, 0

    def method(self):
        return Controller("slow", "advances", decide=self.decide)

    def decide(self, _task, _memory, _estimate, _rng):
        number, self.count = self.count, self.count + 1
        if number in self.late:
            self.recorded.phantom.wait(self.seconds)
        return Decision(STRAIGHT, f"number {number}"), None


def inserted(plan, slow, deadline=DEADLINE_S, depth=-20.0):
    """An insertion to a target, in air unless a depth is given, with this controller."""
    rig = replace(slow.recorded.rig(), deadline=deadline)
    return run(replace(plan, target=(depth, 0.0, 0.0)), rig, controller=slow.method(), force=True)


def used(done):
    """The decisions of the moves."""
    return [period.decision for period in done.periods if period.action is Action.MOVE]


@pytest.mark.parametrize(
    ("deadline", "late"), [(None, 0), (TAKEN_S + 1e-3, 0), (TAKEN_S - 1e-3, 1), (DEADLINE_S, 1)]
)
def test_a_decision_is_late_if_it_takes_longer_than_the_deadline(plan, deadline, late):
    done = inserted(plan, Slow(RecordedPhantom(plan.roll), LATE), deadline)
    assert (done.outcome, done.late) == (Outcome.DONE, late)


def test_after_a_late_decision_the_needle_rests_and_then_the_decision_is_used(plan):
    """If nothing has changed, the next period carries it out, and no decision is made twice."""
    slow = Slow(RecordedPhantom(plan.roll), LATE)
    done = inserted(plan, slow)
    before, period, after = done.periods[LATE - 1 : LATE + 2]
    assert (period.action, period.command, period.applied) == (Action.REST, STILL, STILL)
    assert period.decision == WARNED
    assert period.time - before.time == pytest.approx(TAKEN_S)
    assert len(period.readings) == pytest.approx(TAKEN_S / READING, abs=1)
    assert [other for other in done.periods if other.late] == [period]
    assert used(done) == [f"number {k}" for k in range(slow.count)]
    assert (after.decision, after.command) == (f"number {LATE}", STRAIGHT)
    assert after.time - period.time == pytest.approx(0.2)
    for each in (before, period):  # and in the record
        row = to_row(each)
        assert row["late"] == str(each.late)
        assert from_row(row, each.shape, {}).late is each.late


def spoilt_while_deciding(fault, number=LATE):
    """A phantom whose readings have the fault during the late decision of this number."""

    def spoil(batch):
        now = recorded.phantom.now()
        began = number * 0.2
        return tuple(
            fault(one) if began + 1e-9 < one.time and now < began + TAKEN_S + 0.1 else one for one in batch
        )

    recorded = RecordedPhantom(0.0, spoil=spoil)
    return recorded


def test_a_late_decision_is_repeated_after_bad_readings(plan):
    """The needle is held until a reading is good again."""
    done = inserted(plan, Slow(spoilt_while_deciding(blind), LATE))
    late, held = done.periods[LATE : LATE + 2]
    assert str(late.verdict).startswith("missing")
    assert (held.action, held.command) == (Action.HOLD, STILL)
    assert f"number {LATE}" not in used(done)
    assert f"number {LATE + 1}" in used(done)
    assert done.outcome is Outcome.DONE


@pytest.mark.parametrize(("off", "anew"), [(1.3, True), (0.0, False)])
def test_a_late_decision_is_repeated_where_the_readings_have_moved_the_estimate(plan, off, anew):
    """By more than the uncertainty of the estimate."""

    def moved(measurement):
        return replace(measurement, y=measurement.y + off)

    done = inserted(plan, Slow(spoilt_while_deciding(moved, IN_TISSUE), IN_TISSUE), depth=6.0)
    assert done.periods[IN_TISSUE].late
    assert done.periods[IN_TISSUE].verdict.ok
    assert (f"number {IN_TISSUE}" not in used(done)) is anew
    assert done.periods[IN_TISSUE + 1].action is Action.MOVE


def test_a_controller_that_is_always_late_ends(plan):
    """Each of its decisions is used after a rest."""
    slow = Slow(RecordedPhantom(plan.roll), *range(1000))
    done = inserted(plan, slow)
    assert (done.outcome, done.late) == (Outcome.DONE, slow.count)
    assert used(done) == [f"number {k}" for k in range(slow.count)]


def test_decisions_that_never_hold_count_as_moves(plan, monkeypatch):
    """An insertion that never moves ends, too."""
    monkeypatch.setattr(LateDecision, "holds_for", lambda *_: False)
    short = replace(plan, controls=plan.controls[:5], tips=plan.tips[:6], guide=plan.guide[:6])
    done = inserted(short, Slow(RecordedPhantom(plan.roll), *range(1000)))
    assert (done.outcome, done.late, used(done)) == (Outcome.FAILED, 20, [])
    assert "within 4 times the planned steps" in done.reason


@pytest.mark.long
def test_the_default_controller_ends_at_its_target_when_some_decisions_are_late(plan):
    recorded, numbers, method = RecordedPhantom(plan.roll, delay=0.2), iter(range(1000)), CONTROLLERS[DEFAULT]

    def decide(*given):
        recorded.phantom.wait(TAKEN_S if next(numbers) % 5 == 2 else 0.05)
        return method.decide(*given)

    rig = replace(recorded.rig(), deadline=DEADLINE_S)
    done = run(plan, rig, controller=replace(method, name="slow-mpc", decide=decide))
    assert done.late >= 8
    assert done.true_error_mm <= 0.2


@pytest.mark.parametrize("deadline", [0.0, -1.0, math.inf, math.nan])
def test_a_deadline_is_a_time_above_zero(plan, deadline):
    with pytest.raises(InputError, match=r"deadline = .*: must be a time above 0 \(s\), or None"):
        replace(RecordedPhantom(plan.roll).rig(), deadline=deadline)
