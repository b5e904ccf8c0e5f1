"""studies/decision_time.py: paired insertions, and its two bounds."""

import numpy as np
import pytest

import decision_time as study
import flexneedle
from flexneedle.control.controllers import DEFAULT

pytestmark = pytest.mark.long

TARGET = (25.0, 0.0)


@pytest.mark.long
def test_without_a_decision_time_it_is_the_insertion_of_the_package():
    ours = study.inserted(study.Job(TARGET, 3, 0.0))
    plan = study.plan_to(TARGET)
    theirs = flexneedle.insert("phantom", plan, 3, controller=DEFAULT, threads=1)
    assert [period.estimate for period in ours.periods] == [period.estimate for period in theirs.periods]
    assert ours.true_error_mm == theirs.true_error_mm


def is_whole(command):
    return command.db_x >= 1.0 and command.roll == 0.0


def test_a_decision_takes_its_time_on_the_clock_of_the_rig():
    """A move of 0.2 s without a roll takes 0.35 s."""
    periods = study.inserted(study.Job(TARGET, 3, 0.15)).periods
    steps = np.diff([0.0, *(period.time for period in periods)])
    moves = [step for step, period in zip(steps, periods, strict=True) if is_whole(period.command)]
    assert len(moves) > 40
    assert moves == pytest.approx([0.35] * len(moves))


def test_every_pair_has_every_decision_time():
    found = list(study.jobs(16, 5, (0.0, 50.0)))
    assert [job.seed for job in found] == [5 + k // 2 for k in range(32)]
    assert [job.decision for job in found[:4]] == [0.0, 0.05, 0.0, 0.05]
    assert found[30].target == study.TARGETS[0]


def rows(decision, errors, innovation, outcome="done"):
    return [
        {
            "decision_ms": decision, "seed": seed, "outcome": outcome, "true_error_mm": error,
            "axial_innovation_mm": innovation,
        }
        for seed, error in enumerate(errors)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("more", "innovation", "outcome", "within"),
    [
        (0.039, 0.019, "done", True),
        (0.041, 0.0, "done", False),
        (0.0, 0.021, "done", False),
        (0.0, -0.021, "done", False),
        (0.0, 0.0, "held", False),
    ],
)
def test_both_bounds_must_be_met_by_insertions_that_are_done(more, innovation, outcome, within):
    base = [0.01, 0.03, 0.08]
    slow = rows(50.0, [error + more for error in base], innovation, outcome)
    zero, other = study.lines([*slow, *rows(0.0, base, 0.0)])
    assert (zero.decision_ms, zero.growth, zero.within) == (0.0, 0.0, True)
    assert other.growth == pytest.approx(more)
    assert other.within is within
    assert study.table([zero, other]).count("\n") == 3
