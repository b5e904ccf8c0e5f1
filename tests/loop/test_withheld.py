"""A rig whose checks are stricter than the loop's ends motions early: the loop must not repeat them forever."""

import pytest

from flexneedle.results import Outcome
from flexneedle.types import STILL, Motion
from insertions import PHANTOM, RecordedPhantom, run

WHY = "frozen: 4 identical readings while the tip travelled 0.31 mm"
FIRST = 5


class Withholding(RecordedPhantom):
    """A rig that carries out only a share of some commands. times: numbers of these commands."""

    def __init__(self, roll, times, share=0.0):
        super().__init__(roll)
        self.times, self.share = times, share

    def apply(self, command, duration):
        if len(self.moves) not in self.times:
            return super().apply(command, duration)
        now = self.phantom.now()
        if self.share:
            part = command._replace(**{name: self.share * value for name, value in command._asdict().items()})
            return super().apply(part, duration)._replace(held=WHY)
        self.moves.append((now, command))
        return Motion(STILL, now, now, held=WHY)


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_a_command_that_is_never_carried_out_ends_the_insertion_as_held_with_the_reason(plan, share):
    recorded = Withholding(plan.roll, range(FIRST, 10_000), share)
    done = run(plan, recorded.rig(), controller="open-loop")
    assert (done.outcome, done.reason) == (Outcome.HELD, WHY)
    limit, reading = PHANTOM.control.hold_limit_s, PHANTOM.tracker.period
    assert done.periods[-1].decision == f"held by the rig: {WHY}"
    last = recorded.moves[FIRST][0]
    assert limit - 0.5 <= recorded.phantom.now() - last <= limit + 0.5
    assert len(recorded.moves) - FIRST <= limit / reading + 2


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_an_insertion_continues_once_the_rig_does(plan, share):
    times = [*range(FIRST, FIRST + 3), *range(20, 22)]
    done = run(plan, Withholding(plan.roll, times, share).rig())
    assert done.outcome is Outcome.DONE
    assert done.true_error_mm < 0.5
