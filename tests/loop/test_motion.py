"""A motion has the command as applied and its time, without the time of the decision."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.control.interface import Controller, Decision, travel_left
from flexneedle.errors import CommandError, StoppedError
from flexneedle.estimation.moves import Move, position_along
from flexneedle.results import Outcome
from flexneedle.simulator.control import Limits, controls
from flexneedle.types import STILL, Control, Motion
from insertions import PHANTOM, RecordedPhantom, TapedRig, run

THINKING_S = 0.1


def straight(before):
    """A controller that advances to the target depth and calls `before` before each decision."""

    def decide(task, _memory, estimate, _rng):
        before()
        left = travel_left(task.scenario, task.plan, estimate.state)
        return Decision(Control(db_x=min(task.scenario.setup.max_advance_mm, left)), "ahead"), None

    return Controller("straight", "advances without a roll", decide=decide)


class Overshooting(RecordedPhantom):
    """A driver that reports slightly more than the command, as encoders do."""

    def apply(self, command, duration):
        motion = super().apply(command, duration)
        more = motion.control._replace(db_x=1.0004 * motion.control.db_x)
        return motion._replace(control=more)


@pytest.mark.parametrize("controller", ["resolved-rate", "open-loop"])
def test_a_driver_that_reports_more_than_a_step_does_not_end_the_insertion(plan, controller):
    done = run(plan, Overshooting(plan.roll).rig(), controller=controller)
    assert done.outcome is Outcome.DONE
    assert any(period.applied.db_x > period.command.db_x + 1e-4 for period in done.periods)


@pytest.mark.parametrize("thinking", [0.0, THINKING_S])
def test_the_time_of_a_decision_is_no_motion(plan, thinking):
    """The clock runs while the controller decides, and the readings are compared with a needle at rest."""
    recorded = RecordedPhantom(plan.roll)
    slow = straight(lambda: thinking and recorded.phantom.wait(thinking))
    done = run(plan, recorded.rig(), controller=slow, force=True)
    off = [period.estimate.x - period.true_tip.x for period in done.periods][20:]
    assert len(off) >= 30
    assert abs(np.mean(off)) <= 0.03


def test_between_two_moves_the_tip_rests():
    tips = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.2, 0.0, 0.0, 0.0], [2.0, 0.2, 0.4, 0.0, 0.0]])
    moves = Move.of(Motion(STILL, 0.0, 1.0)), Move.of(Motion(STILL, 2.0, 3.0))
    found = [position_along(moves, tips, time) for time in (0.5, 1.0, 1.5, 2.0, 2.5, 9.0)]
    expected = [(0.5, 0.1, 0.0), *[(1.0, 0.2, 0.0)] * 3, (1.5, 0.2, 0.2), (2.0, 0.2, 0.4)]
    np.testing.assert_allclose(found, expected)


class Stopped(TapedRig):
    """A driver that counts its stops and is interrupted in a motion."""

    def __init__(self, error):
        super().__init__([])
        self.error, self.stops = error, 0

    def apply(self, _command, _duration):
        raise self.error

    def stop(self):
        self.stops += 1


def test_motors_are_stopped_at_the_end(plan):
    recorded = RecordedPhantom(plan.roll)
    stops = []
    recorded.stop = lambda: stops.append(recorded.phantom.now())
    done = run(plan, recorded.rig())
    assert stops == [done.periods[-1].time]


def test_beyond_a_limit_the_needle_may_rest_and_return_but_not_advance():
    limits, setup = Limits.of(PHANTOM), PHANTOM.setup
    beyond = np.zeros(7)
    beyond[5] = setup.max_guide_travel_mm + 4e-4
    for step in (0.0, -0.1):
        limits.check(beyond, controls(1, dg_y=step))
    limits.check(-beyond, controls(1, dg_y=0.1))
    for moved_to, step in ((beyond, 1e-3), (-beyond, -1e-3)):
        with pytest.raises(CommandError, match="sum of the steps"):
            limits.check(moved_to, controls(1, dg_y=step))
    with pytest.raises(CommandError, match="sum of the steps"):
        limits.check(beyond, controls(2, dg_y=[-0.1, 0.2]))


def test_beyond_its_range_the_needle_may_only_roll_back():
    limits = replace(Limits.of(PHANTOM), half_turns="", rotation=1.0)
    limits.check(np.zeros(7), controls(1, roll=-0.1), 1.0004)
    limits.check(np.zeros(7), controls(1), 1.0004)
    with pytest.raises(CommandError, match="angle of the needle"):
        limits.check(np.zeros(7), controls(1, roll=0.1), 1.0004)


def test_an_insertion_that_is_stopped_at_the_rig_is_interrupted(plan):
    stage = Stopped(StoppedError("stopped: the emergency button"))
    done = run(plan, stage.rig(), force=True)
    assert (done.outcome, done.reason) == (Outcome.INTERRUPTED, "stopped: the emergency button")
    assert stage.stops == 1
