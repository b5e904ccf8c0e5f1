"""The motion of a request: pure functions."""

from collections.abc import Mapping

from flexneedle.rig.supervisor.drives import Drive
from flexneedle.rig.supervisor.messages import Go, Step
from flexneedle.rig.supervisor.motion import Motion
from flexneedle.rig.supervisor.trajectory import shortest
from flexneedle.scenario.sections.axes import Axis

_BACK_OFF_SHARE = 0.02  # of the range an axis moves away from its limit switch
_HOMING_SHARE = 0.1  # of the largest speed
_HOMING_REACH = 1.1  # of the range


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
    """The search of a home, with `home` the axis; without legs where there is none: it is here, or at the switch."""
    motion = Motion(number, [], unlimited=True)
    if drive.axis.to_home and not at_switch:
        motion.legs = [_slowly(drive, homing_reach(drive.axis))]
        motion.home = drive
    return motion


def back_off(drive: Drive) -> tuple[Mapping[str, float], float]:
    """The leg of an axis from the limit switch of its home into its range, as (travel by axis, duration)."""
    return _slowly(drive, homed_at(drive.axis) - drive.axis.at_home)


def homing_speed(axis: Axis) -> float:
    """Speed (mm/s or rad/s) at which an axis searches its limit switch, and leaves it."""
    return _HOMING_SHARE * axis.speed


def homing_reach(axis: Axis) -> float:
    """Largest travel (mm or rad, signed) of an axis to the limit switch of its home."""
    low, high = axis.limits
    return axis.to_home * _HOMING_REACH * (high - low)


def homed_at(axis: Axis) -> float:
    """Position (mm or rad) at which an axis rests after homing: inside its range, off the limit switch of its home."""
    low, high = axis.limits
    return min(max(axis.at_home, low), high) - axis.to_home * _BACK_OFF_SHARE * (high - low)


def _slowly(drive: Drive, travel: float) -> tuple[Mapping[str, float], float]:
    """The leg of a travel (mm or rad) at the speed of homing."""
    return {drive.name: travel}, shortest(abs(travel), homing_speed(drive.axis), drive.axis.acceleration)
