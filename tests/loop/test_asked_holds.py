"""The gate holds the needle: it rests from the next step on until the gate no longer holds it."""

from dataclasses import replace
from itertools import count

import pytest

from flexneedle.control.interface import Controller, Decision
from flexneedle.loop.events import Gate
from insertions import PHANTOM, READING, RecordedPhantom, run
from phantoms import STRAIGHT

WHY = "nobody is in control"


class Asked(Gate):
    """A gate that holds at these calls; the first is call 0."""

    def __init__(self, *calls):
        self.calls, self.count = calls, 0

    def hold(self):
        number, self.count = self.count, self.count + 1
        return WHY if number in self.calls else ""


def inserted(plan, gate, scenario=PHANTOM, depth=-20.0):
    recorded, numbers = RecordedPhantom(plan.roll), count()
    method = Controller(
        "numbered", "advances", decide=lambda *_: (Decision(STRAIGHT, f"number {next(numbers)}"), None)
    )
    target = replace(plan, target=(depth, 0.0, 0.0))
    return run(target, recorded.rig(), scenario, controller=method, force=True, gate=gate), recorded


def test_the_needle_rests_while_it_is_held_and_then_continues(plan):
    free, _ = inserted(plan, Asked())
    done, recorded = inserted(plan, Asked(*range(6, 16)))  # two calls for each of the first three moves
    held = [period for period in done.periods if period.action == "hold"]
    assert [period.index for period in held] == list(range(3, 13))
    assert {period.decision for period in held} == {f"held: {WHY}"}
    assert done.held_s == pytest.approx(10 * READING)
    assert done.outcome == free.outcome == "done"
    assert [command for _, command in recorded.moves] == [
        p.command for p in free.periods if p.action == "move"
    ]


def test_a_decision_made_before_the_hold_is_not_carried_out(plan):
    done, recorded = inserted(plan, Asked(7))  # after the fourth decision
    assert [period.action for period in done.periods[:5]] == ["move", "move", "move", "hold", "move"]
    assert done.periods[4].decision == "number 4"
    assert len(recorded.moves) == sum(period.action == "move" for period in done.periods)


def test_the_hold_counts_towards_the_limit_of_all_holds(plan):
    scenario = PHANTOM.with_values({"control.hold_total_s": 0.5})
    done, _ = inserted(plan, Asked(*range(6, 1000)), scenario)
    assert done.outcome == "held"
    assert done.reason == f"held for {done.held_s:.2f} s in all (limit 0.50 s): {WHY}"
    assert done.held_s == pytest.approx(0.5, abs=READING)


def test_a_needle_at_its_depth_is_measured_and_not_held(plan):
    calls = inserted(plan, counted := Asked())[0] and counted.count
    done, _ = inserted(plan, Asked(calls, calls + 1))
    assert done.outcome == "done"
    assert done.held_s == 0.0
