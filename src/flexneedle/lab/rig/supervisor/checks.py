"""Checks of motors at each tick: pure functions that return a problem in one line, or ""."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.lab.rig.supervisor.drives import Drive, MotorReading, is_near_switch, position_after_homing
from flexneedle.lab.rig.supervisor.motion import CommandedMotion
from flexneedle.ports import MotorState

STILL = 2.0
"""Largest motion of a motor at rest, in tolerances of its goal."""
_HASTE = 1.5  # times its largest speed: so fast may an axis seem, since the times of ticks are not exact
_CREEP = 0.1  # of the tolerance: least motion of a servo that still follows between two readings


def number_problem(drive: Drive, state: MotorState) -> str:
    """Report a position that is not a number."""
    if math.isfinite(drive.error_of(state)):
        return ""
    return f"{drive.name}: the motor controller reports position {state.position:g}, commanded {state.commanded:g}"


def motor_problem(drive: Drive, state: MotorState, before: MotorState) -> str:
    """Report a motor that is off, was stopped by the motor controller since the reading before, or does not follow."""
    error = drive.error_of(state)
    if not state.on:
        return f"{drive.name}: the motor is off" + (f" ({state.stopped})" if state.stopped else "")
    if state.stopped and state.stopped != before.stopped:
        return f"{drive.name}: stopped by the motor controller: {state.stopped}"
    if abs(error) > drive.axis.max_error:
        limit = drive.to_text(drive.axis.max_error)
        return f"{drive.name}: the motor does not follow: {drive.to_text(abs(error))} off, limit {limit}"
    return ""


def position_problem(
    drive: Drive, state: MotorState, before: MotorState, seconds: float, *, unlimited: bool = False
) -> str:
    """Report a position that jumped since the reading before, `seconds` ago, or moves further beyond a soft limit.

    unlimited: positions have no origin yet, as during homing, so that limits have no meaning.
    """
    moved = abs((state.position - before.position) / drive.axis.scale)
    most = _HASTE * drive.axis.speed * seconds + drive.axis.max_error
    if moved > most:
        return f"{drive.name}: the position jumped by {drive.to_text(moved)} in {seconds:.3f} s"
    outside, further = (
        _distance_outside(drive, state),
        _distance_outside(drive, before) + drive.axis.tolerance,
    )
    if not unlimited and outside > drive.axis.max_error and outside > further:
        low, high = map(drive.to_text, drive.axis.limits)
        return f"{drive.name}: at {drive.to_text(drive.to_position(state.position))}, beyond its range {low} to {high}"
    return ""


def _distance_outside(drive: Drive, state: MotorState) -> float:
    """Return the distance of a position beyond the range (mm or rad)."""
    position, (low, high) = drive.to_position(state.position), drive.axis.limits
    return max(low - position, position - high, 0.0)


def reversal_problem(drive: Drive, state: MotorState, before: MotorState, way: float) -> str:
    """Report a motor that moved against its travel (`way`, counts) since the reading before: its position was reset.

    A jump that its speed allows shows only in its direction.
    """
    back = -(state.position - before.position) * (1.0 if way > 0.0 else -1.0) / abs(drive.axis.scale)
    if back > STILL * drive.axis.tolerance:
        return f"{drive.name}: the position went back by {drive.to_text(back)} during a motion"
    return ""


def target_problem(drive: Drive, state: MotorState, start: float, sent: float) -> str:
    """Report a motor that is beyond its last target, or behind the start of its motion (counts).

    The controller's own profile may be wrong, too, and its position error small.
    """
    low, high = min(start, sent), max(start, sent)
    off = max(low - state.position, state.position - high) / abs(drive.axis.scale)
    if off > drive.axis.max_error:
        return f"{drive.name}: {drive.to_text(off)} beyond its target, limit {drive.to_text(drive.axis.max_error)}"
    return ""


def is_at_rest(drive: Drive, state: MotorState, before: MotorState) -> bool:
    """Return whether a motor rests with its servo, which may still follow after the controller's profile has ended.

    before: state at a time from which a servo that still follows has moved. A repeated state shows no rest.
    """
    if state.repeated:
        return False
    tolerance, count = drive.axis.tolerance, 1.0 / abs(drive.axis.scale)
    moved = abs(state.position - before.position) * count
    return not state.moving and moved <= max(_CREEP * tolerance, min(count, tolerance))


def is_at_switch(drive: Drive, state: MotorState) -> bool:
    """Return whether an axis is at the limit switch of its home, where the motor controller stops it."""
    return state.reverse_limit if drive.axis.home == "reverse-limit" else state.forward_limit


def is_at_home(drive: Drive, state: MotorState) -> bool:
    """Return whether an axis is at the limit switch of its home, and rests there."""
    return is_at_switch(drive, state) and not state.moving


def switch_problem(drive: Drive, state: MotorState) -> str:
    """Report that the limit switch of the home is still active after an axis has left it."""
    if not is_at_home(drive, state):
        return ""
    way = abs(position_after_homing(drive.axis) - drive.axis.at_home)
    why = "it is stuck, or the home must be further beyond the range"
    return (
        f"{drive.name}: the {drive.axis.home} switch is still active {drive.to_text(way)} away from it: {why}"
    )


def stuck_problem(drive: Drive, state: MotorState) -> str:
    """Report active limit switches of both ends: no axis can be at both."""
    both = state.reverse_limit and state.forward_limit
    return f"{drive.name}: both limit switches are active: check their wiring and polarity" if both else ""


def resting_switch_problem(drive: Drive, state: MotorState) -> str:
    """Report an active limit switch of an axis at rest, except the switch of its home if the axis is there."""
    if problem := stuck_problem(drive, state):
        return problem
    active, at = active_switches(state), drive.to_position(state.position)
    is_home = drive.axis.to_home != 0 and is_at_switch(drive, state)
    if not active or (is_home and is_near_switch(drive.axis, at)):
        return ""
    home = f", but the home is at {drive.to_text(drive.axis.at_home)}" if is_home else ""
    return f"{drive.name}: the {' '.join(active)} limit switch is active at {drive.to_text(at)}{home}"


def rest_problem(drive: Drive, state: MotorState, goal: float) -> str:
    """Report a motor that has left its goal (counts) without a command."""
    off = abs((state.position - goal) / drive.axis.scale)
    if off > STILL * drive.axis.tolerance:
        return f"{drive.name}: moved by {drive.to_text(off)} without a command"
    return ""


def active_switches(state: MotorState) -> frozenset[str]:
    """Return the active limit switches of an axis: "reverse", "forward"."""
    sides = {"reverse": state.reverse_limit, "forward": state.forward_limit}
    return frozenset(side for side, is_active in sides.items() if is_active)


def new_switch_problem(drive: Drive, state: MotorState, known: frozenset[str]) -> str:
    """Report a limit switch that became active at a motor that rests, where its controller has nothing to stop.

    known: switches that were active when the rig was armed, and still are.
    """
    new = active_switches(state) - known
    if state.moving or not new:
        return ""
    return f"{drive.name}: at rest, {' and '.join(sorted(new, reverse=True))} limit switch active"


def is_misplaced(drive: Drive, state: MotorState) -> bool:
    """Return whether a motor at rest is further from its commanded position than the checks at rest allow."""
    return abs(drive.error_of(state)) > min(drive.axis.max_error, STILL * drive.axis.tolerance)


@dataclass(frozen=True)
class Inspection:
    """Check of all motors at a tick, by their present motion.

    motion: under way, or None; goals: counts by channel; stopping: motors are being stopped; newest, before: this
    reading and the one before; known_switches: limit switches by channel that were active before.
    """

    motion: CommandedMotion | None
    goals: Mapping[str, float]
    stopping: bool
    newest: MotorReading
    before: MotorReading
    known_switches: Mapping[str, frozenset[str]]

    def first_problem(self, drives: Mapping[str, Drive]) -> str:
        """Return the problem of the first drive (by axis) that has one, or ""."""
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
            problem = problem or new_switch_problem(drive, state, self.known_switches[channel])
        if problem or self.stopping:
            return problem
        leg = None if motion is None else motion.leg
        if leg is None or channel not in leg.drives:
            return rest_problem(drive, state, self.goals[channel])
        problem = reversal_problem(drive, state, last, leg.way(channel))
        start = leg.trajectory.start[channel]  # where it still is, if its first target was refused
        return problem or target_problem(drive, state, start, leg.sent.get(channel, start))

    def _is_at_its_home(self, drive: Drive) -> bool:
        """Return whether the axis searches or leaves its home, whose switch may then change several times."""
        motion = self.motion
        homes = () if motion is None else (motion.home, motion.released)
        return any(home is not None and home.name == drive.name for home in homes)

    def _is_stopped_at_home(self, drive: Drive) -> bool:
        """Return whether the axis has reached the limit switch of its home, where the motor controller stops it."""
        home = None if self.motion is None else self.motion.home
        state = self.newest.states[drive.axis.channel]
        return home is not None and home.name == drive.name and is_at_switch(drive, state)
