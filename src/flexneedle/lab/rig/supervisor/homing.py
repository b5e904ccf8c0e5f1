"""Homing: the motion that searches the home of an axis, and the changes at its limit switch."""

from collections.abc import Mapping

from flexneedle.lab.rig.supervisor.checks import switch_problem
from flexneedle.lab.rig.supervisor.drives import Drive, homing_reach, homing_speed, position_after_homing
from flexneedle.lab.rig.supervisor.motion import CommandedMotion
from flexneedle.lab.rig.supervisor.trajectory import shortest_duration
from flexneedle.ports import MotorState


def make_homing(number: int, drive: Drive, *, at_switch: bool) -> CommandedMotion:
    """Return the motion that searches a home. Its axis is `home`, or `here` if the home is the present position.

    An axis at an active switch (`released`) first moves off it, since a stuck switch is no home.
    """
    if not drive.axis.to_home:
        return CommandedMotion(number, [], here=drive, unlimited=True)
    search = _homing_leg(drive, homing_reach(drive.axis))
    if at_switch:
        return CommandedMotion(number, [_back_off_leg(drive), search], released=drive, unlimited=True)
    return CommandedMotion(number, [search], home=drive, unlimited=True)


def _back_off_leg(drive: Drive) -> tuple[Mapping[str, float], float]:
    """Return the leg from the limit switch of the home into the range, as (travel by axis, duration)."""
    return _homing_leg(drive, position_after_homing(drive.axis) - drive.axis.at_home)


def _homing_leg(drive: Drive, travel: float) -> tuple[Mapping[str, float], float]:
    """Return the leg of a travel (mm or rad) at the speed of homing."""
    return {drive.name: travel}, shortest_duration(
        abs(travel), homing_speed(drive.axis), drive.axis.acceleration
    )


def leave_switch(motion: CommandedMotion, drive: Drive, shift: float) -> None:
    """Make the axis at the switch of its home move off it; shift: correction of its positions there (counts)."""
    motion.home, motion.released, motion.shift, motion.legs = None, drive, shift, [_back_off_leg(drive)]


def end_leaving_switch(motion: CommandedMotion, drive: Drive, state: MotorState) -> bool:
    """Return whether the home can be defined after an axis has left the switch; otherwise the search continues or ends.

    A switch that is still active is stuck: it shows no home, and positions are left unchanged.
    """
    motion.why = switch_problem(drive, state)
    if motion.why:
        motion.legs = []
    elif motion.legs:
        motion.home, motion.released = drive, None
    else:
        return True
    return False
