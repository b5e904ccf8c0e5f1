"""Checks of motors at each tick: pure functions that return a problem in one line, or ""."""

import math

from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.homes import homed_at, may_be_at_switch
from flexneedle.ports import MotorState

STILL = 2.0
"""Times the tolerance of its goal a motor at rest may move."""
_HASTE = 1.5  # times its speed an axis may seem to move between two ticks, whose times are not exact
_CREEP = 0.1  # of the tolerance a servo that still follows moves at least between two readings


def number_problem(drive: Drive, state: MotorState) -> str:
    """A position that is not a number."""
    if math.isfinite(drive.error(state)):
        return ""
    return f"{drive.name}: the motor controller reports position {state.position:g}, commanded {state.commanded:g}"


def motor_problem(drive: Drive, state: MotorState, before: MotorState) -> str:
    """A motor that is off, was stopped by the motor controller since the reading before, or does not follow."""
    error = drive.error(state)
    if not state.on:
        return f"{drive.name}: the motor is off{_because(state.stopped)}"
    if state.stopped and state.stopped != before.stopped:
        return f"{drive.name}: stopped by the motor controller: {state.stopped}"
    if abs(error) > drive.axis.max_error:
        limit = drive.shown(drive.axis.max_error)
        return f"{drive.name}: the motor does not follow: {drive.shown(abs(error))} off, limit {limit}"
    return ""


def position_problem(
    drive: Drive, state: MotorState, before: MotorState, seconds: float, *, unlimited: bool = False
) -> str:
    """A position that jumped since the reading before, `seconds` ago, or goes further beyond a soft limit.

    unlimited: the position counts from nowhere, as during homing, so that limits mean nothing.
    """
    moved = abs((state.position - before.position) / drive.axis.scale)
    most = _HASTE * drive.axis.speed * seconds + drive.axis.max_error
    if moved > most:
        return f"{drive.name}: the position jumped by {drive.shown(moved)} in {seconds:.3f} s"
    outside, further = _outside(drive, state), _outside(drive, before) + drive.axis.tolerance
    if not unlimited and outside > drive.axis.max_error and outside > further:
        low, high = map(drive.shown, drive.axis.limits)
        return f"{drive.name}: at {drive.shown(drive.position(state.position))}, beyond its range {low} to {high}"
    return ""


def _outside(drive: Drive, state: MotorState) -> float:
    """How far a position is beyond the range (mm or rad)."""
    position, (low, high) = drive.position(state.position), drive.axis.limits
    return max(low - position, position - high, 0.0)


def reversal_problem(drive: Drive, state: MotorState, before: MotorState, way: float) -> str:
    """A motor that went back on its way (counts, signed) since the reading before: its position was reset.

    A jump within what its speed allows is found by its direction alone.
    """
    back = -(state.position - before.position) * (1.0 if way > 0.0 else -1.0) / abs(drive.axis.scale)
    if back > STILL * drive.axis.tolerance:
        return f"{drive.name}: the position went back by {drive.shown(back)} during a motion"
    return ""


def target_problem(drive: Drive, state: MotorState, start: float, sent: float) -> str:
    """A motor that is beyond the target that was last sent, or behind where it began (counts).

    The controller's own profile may be wrong, too, and its position error small.
    """
    low, high = min(start, sent), max(start, sent)
    off = max(low - state.position, state.position - high) / abs(drive.axis.scale)
    if off > drive.axis.max_error:
        return (
            f"{drive.name}: {drive.shown(off)} beyond its target, limit {drive.shown(drive.axis.max_error)}"
        )
    return ""


def rests(drive: Drive, state: MotorState, before: MotorState) -> bool:
    """Whether a motor rests, its servo included, which may follow on when the controller's profile has ended.

    before: long enough ago that a servo that follows on has moved. A state that is repeated does not show it.
    """
    if state.repeated:
        return False
    tolerance, count = drive.axis.tolerance, 1.0 / abs(drive.axis.scale)
    moved = abs(state.position - before.position) * count
    return not state.moving and moved <= max(_CREEP * tolerance, min(count, tolerance))


def at_switch(drive: Drive, state: MotorState) -> bool:
    """Whether an axis is at the limit switch of its home, where the motor controller stops it."""
    return state.reverse_limit if drive.axis.home == "reverse-limit" else state.forward_limit


def at_home(drive: Drive, state: MotorState) -> bool:
    """Whether an axis is at the limit switch of its home, and rests there."""
    return at_switch(drive, state) and not state.moving


def switch_problem(drive: Drive, state: MotorState) -> str:
    """An axis that has left the limit switch of its home, which is still active."""
    if not at_home(drive, state):
        return ""
    way = abs(homed_at(drive.axis) - drive.axis.at_home)
    why = "it is stuck, or needs more room: a home further beyond the range"
    return (
        f"{drive.name}: the {drive.axis.home} switch is still active {drive.shown(way)} away from it: {why}"
    )


def stuck_problem(drive: Drive, state: MotorState) -> str:
    """Limit switches of both ends, of which no axis can be at both."""
    both = state.reverse_limit and state.forward_limit
    return f"{drive.name}: both limit switches are active: check their wiring and polarity" if both else ""


def resting_switch_problem(drive: Drive, state: MotorState) -> str:
    """A limit switch that is active at an axis at rest, but for that of its home where the axis is there."""
    if problem := stuck_problem(drive, state):
        return problem
    active, at = switches(state), drive.position(state.position)
    is_home = drive.axis.to_home != 0 and at_switch(drive, state)
    if not active or (is_home and may_be_at_switch(drive.axis, at)):
        return ""
    home = f", but the home is at {drive.shown(drive.axis.at_home)}" if is_home else ""
    return f"{drive.name}: the {' '.join(active)} limit switch is active at {drive.shown(at)}{home}"


def rest_problem(drive: Drive, state: MotorState, goal: float) -> str:
    """A motor that is not where it was left; goal: that position (counts)."""
    off = abs((state.position - goal) / drive.axis.scale)
    if off > STILL * drive.axis.tolerance:
        return f"{drive.name}: moved by {drive.shown(off)} without a command"
    return ""


def switches(state: MotorState) -> frozenset[str]:
    """Which limit switches of an axis are active: "reverse", "forward"."""
    sides = {"reverse": state.reverse_limit, "forward": state.forward_limit}
    return frozenset(side for side, is_active in sides.items() if is_active)


def new_switch_problem(drive: Drive, state: MotorState, known: frozenset[str]) -> str:
    """A limit switch that became active at a motor that rests, where its controller has nothing to stop.

    known: those that were active as the rig was armed, and still are.
    """
    new = switches(state) - known
    if state.moving or not new:
        return ""
    return f"{drive.name}: at rest, {' and '.join(sorted(new, reverse=True))} limit switch active"


def misplaced(drive: Drive, state: MotorState) -> bool:
    """Whether a motor at rest is further from where its controller has it than the checks at rest allow."""
    return abs(drive.error(state)) > min(drive.axis.max_error, STILL * drive.axis.tolerance)


def arrived(drive: Drive, state: MotorState, goal: float) -> bool:
    """Whether a motor is at rest within the tolerance of its goal (counts)."""
    return not state.moving and abs((state.position - goal) / drive.axis.scale) <= drive.axis.tolerance


def _because(reason: str) -> str:
    return f" ({reason})" if reason else ""
