"""The check of all motors at a tick: which checks apply to each, by what it is to do. Pure functions."""

from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.rig.ports import MotorState
from flexneedle.rig.supervisor.checks import (
    at_home,
    motor_problem,
    position_problem,
    rest_problem,
    reversal_problem,
    target_problem,
)
from flexneedle.rig.supervisor.drives import Drive
from flexneedle.rig.supervisor.motion import Motion

States = Mapping[str, MotorState]


@dataclass(frozen=True)
class Inspection:
    """The motion under way, or None; where motors were last sent (counts by channel); whether they are being stopped;
    the states of this reading and of the one before, `seconds` ago.
    """

    motion: Motion | None
    goals: Mapping[str, float]
    stopping: bool
    states: States
    before: States
    seconds: float

    def first_problem(self, drives: Mapping[str, Drive]) -> str:
        """The problem of the first drive (by axis) that has one, or ""."""
        return next(filter(None, map(self._problem, drives.values())), "")

    def _problem(self, drive: Drive) -> str:
        channel, motion = drive.axis.channel, self.motion
        state, last = self.states[channel], self.before[channel]
        unlimited = motion is not None and motion.unlimited
        problem = "" if self._is_at_home(drive) else motor_problem(drive, state, last)
        problem = problem or position_problem(drive, state, last, self.seconds, unlimited=unlimited)
        if problem or self.stopping:
            return problem
        leg = None if motion is None else motion.leg
        if leg is None or channel not in leg.drives:
            return rest_problem(drive, state, self.goals[channel])
        problem = reversal_problem(drive, state, last, leg.way(channel))
        return problem or target_problem(drive, state, leg.trajectory.start[channel], leg.sent[channel])

    def _is_at_home(self, drive: Drive) -> bool:
        """Whether the axis has reached the limit switch that is its home, where its controller stops it."""
        home = None if self.motion is None else self.motion.home
        return (
            home is not None and home.name == drive.name and at_home(drive, self.states[drive.axis.channel])
        )
