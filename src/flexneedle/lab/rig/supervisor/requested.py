"""The motion of a request: pure functions."""

from collections.abc import Mapping

from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.homes import homed_at, homing_reach, homing_speed
from flexneedle.lab.rig.supervisor.messages import Go, Step
from flexneedle.lab.rig.supervisor.motion import Motion
from flexneedle.lab.rig.supervisor.trajectory import shortest


def stepping(step: Step) -> Motion:
    """A step of an insertion: its roll, then its travel."""
    legs = [(step.travel, step.duration)]
    if step.roll:
        legs.insert(0, ({"rotation": step.roll}, step.roll_duration))
    return Motion(step.number, legs, step.expected, roll=bool(step.roll))


def going(go: Go, drive: Drive, at: float) -> Motion:
    """A motion of one axis alone, from where it was last sent (mm or rad)."""
    travel = go.position - at
    return Motion(go.number, [({go.axis: travel}, shortest(abs(travel), go.speed, drive.axis.acceleration))])


def homing(number: int, drive: Drive, *, at_switch: bool) -> Motion:
    """The search of a home, with `home` the axis; without legs, and with `here`, where the home is here.

    From a switch that is active the axis moves away before, and is `released` then: one that is stuck is no home.
    """
    if not drive.axis.to_home:
        return Motion(number, [], here=drive, unlimited=True)
    search = _slowly(drive, homing_reach(drive.axis))
    if at_switch:
        return Motion(number, [back_off(drive), search], released=drive, unlimited=True)
    return Motion(number, [search], home=drive, unlimited=True)


def back_off(drive: Drive) -> tuple[Mapping[str, float], float]:
    """The leg of an axis from the limit switch of its home into its range, as (travel by axis, duration)."""
    return _slowly(drive, homed_at(drive.axis) - drive.axis.at_home)


def _slowly(drive: Drive, travel: float) -> tuple[Mapping[str, float], float]:
    """The leg of a travel (mm or rad) at the speed of homing."""
    return {drive.name: travel}, shortest(abs(travel), homing_speed(drive.axis), drive.axis.acceleration)
