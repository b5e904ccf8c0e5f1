"""The check of all motors at a tick: which checks apply to each, by what it is to do. Pure functions."""

from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.lab.rig.supervisor.axes import Reading
from flexneedle.lab.rig.supervisor.checks import (
    at_switch,
    motor_problem,
    new_switch_problem,
    number_problem,
    position_problem,
    rest_problem,
    reversal_problem,
    target_problem,
)
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.motion import Motion


@dataclass(frozen=True)
class Inspection:
    """The motion under way, or None; where motors were last sent (counts by channel); whether they are being stopped;
    this reading of their states and the one before; limit switches by channel that were active before.
    """

    motion: Motion | None
    goals: Mapping[str, float]
    stopping: bool
    newest: Reading
    before: Reading
    switches: Mapping[str, frozenset[str]]

    def first_problem(self, drives: Mapping[str, Drive]) -> str:
        """The problem of the first drive (by axis) that has one, or ""."""
        return next(filter(None, map(self._problem, drives.values())), "")

    def _problem(self, drive: Drive) -> str:
        channel, motion = drive.axis.channel, self.motion
        state, last = self.newest.states[channel], self.before.states[channel]
        seconds = self.newest.time - self.before.time
        unlimited = motion is not None and motion.unlimited
        problem = number_problem(drive, state)
        if not self._is_stopped_at_home(drive):
            problem = problem or motor_problem(drive, state, last)
        problem = problem or position_problem(drive, state, last, seconds, unlimited=unlimited)
        if not self._is_at_its_home(drive):
            problem = problem or new_switch_problem(drive, state, self.switches[channel])
        if problem or self.stopping:
            return problem
        leg = None if motion is None else motion.leg
        if leg is None or channel not in leg.drives:
            return rest_problem(drive, state, self.goals[channel])
        problem = reversal_problem(drive, state, last, leg.way(channel))
        start = leg.trajectory.start[channel]  # where it still is, if its first target was refused
        return problem or target_problem(drive, state, start, leg.sent.get(channel, start))

    def _is_at_its_home(self, drive: Drive) -> bool:
        """Whether the axis searches or leaves its home, whose switch may then change several times."""
        motion = self.motion
        homes = () if motion is None else (motion.home, motion.released)
        return any(home is not None and home.name == drive.name for home in homes)

    def _is_stopped_at_home(self, drive: Drive) -> bool:
        """Whether the axis has reached the limit switch that is its home, where the motor controller stops it."""
        home = None if self.motion is None else self.motion.home
        state = self.newest.states[drive.axis.channel]
        return home is not None and home.name == drive.name and at_switch(drive, state)
