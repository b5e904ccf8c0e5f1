"""An error of a device ends the insertion with a record: outcome failed, the reason, all periods before it."""

import pytest

from flexneedle.errors import CommandError, DriverError, RefusedError, RunError
from flexneedle.results import Outcome
from insertions import RecordedPhantom, facts, first_periods, run

LOST = DriverError("galil 10.0.0.5:23: no reply within 0.1 s")
LAST = 6


class Failing(RecordedPhantom):
    """A rig whose driver, tracker or stop raises an error after some calls; it counts its stops."""

    def __init__(self, roll, **errors):
        super().__init__(roll)
        self.errors, self.calls, self.stops = errors, {"apply": 0, "read": 0}, 0

    def fail(self, name):
        self.calls[name] += 1
        if name in self.errors and self.calls[name] > LAST:
            raise self.errors[name]

    def apply(self, command, duration):
        self.fail("apply")
        return super().apply(command, duration)

    def read(self):
        self.fail("read")
        return super().read()

    def stop(self):
        self.stops += 1
        if "stop" in self.errors:
            raise self.errors["stop"]


@pytest.mark.parametrize(("part", "kept"), [("apply", LAST), ("read", LAST - 1)])
def test_the_insertion_fails_with_its_reason_and_all_periods_before_it(plan, part, kept):
    rig = Failing(plan.roll, **{part: LOST})
    done = run(plan, rig.rig())
    assert (done.outcome, done.reason, rig.stops) == (Outcome.FAILED, str(LOST), 1)
    assert len(done.periods) == kept
    expected = first_periods(kept, plan, RecordedPhantom(plan.roll).rig())
    assert [facts(period) for period in done.periods] == [facts(period) for period in expected]
    assert (
        done.summary
        == f"failed {-done.periods[-1].estimate.x:.1f} mm before the skin after {kept} periods: {LOST}"
    )
    assert not done.reached


@pytest.mark.parametrize("refusal", [CommandError("db_x", 1.1, 1.0, "too far"), RefusedError("too far")])
def test_a_command_that_is_refused_ends_the_insertion_as_held(plan, refusal):
    """By the limits of the scenario, or by the rig."""
    rig = Failing(plan.roll, apply=refusal)
    done = run(plan, rig.rig())
    assert (done.outcome, done.reason, len(done.periods)) == (Outcome.HELD, str(refusal), LAST)
    assert rig.stops == 1


def test_before_the_first_motion_the_record_is_empty(plan):
    rig = Failing(plan.roll, read=LOST)
    rig.calls["read"] = LAST
    done = run(plan, rig.rig())
    assert (done.outcome, done.reason, done.periods, rig.stops) == (Outcome.FAILED, str(LOST), (), 1)


DEAD = DriverError("galil 10.0.0.5:23: not connected")


def test_a_driver_that_cannot_be_stopped_either_is_in_the_reason(plan):
    done = run(plan, Failing(plan.roll, apply=LOST, stop=DEAD).rig())
    assert (done.outcome, done.reason) == (Outcome.FAILED, f"{LOST}; the driver was not stopped: {DEAD}")


def test_at_the_target_a_driver_that_cannot_be_stopped_is_a_failure(plan):
    done = run(plan, Failing(plan.roll, stop=DEAD).rig())
    assert (done.outcome, done.reason) == (Outcome.FAILED, f"the driver was not stopped: {DEAD}")
    assert done.true_error_mm <= 1.0


@pytest.mark.parametrize(("error", "text"), [(KeyboardInterrupt(), "interrupted"), (OSError("torn"), "torn")])
def test_a_driver_that_cannot_be_stopped_after_an_interrupt_raises_its_own_error(plan, error, text):
    with pytest.raises(DriverError, match=f"{text}; the driver was not stopped: galil.*no reply"):
        run(plan, Failing(plan.roll, apply=error, stop=LOST).rig())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("no such device"), RunError("refused")])
def test_other_errors_are_raised_after_the_stop(plan, error):
    rig = Failing(plan.roll, apply=error)
    with pytest.raises(type(error)):
        run(plan, rig.rig())
    assert rig.stops == 1
