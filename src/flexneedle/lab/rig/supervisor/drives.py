"""Axes and their motors: positions in mm or rad and in counts, with backlash; the search of the home. Pure functions.

With backlash the axis lags behind its motor by half of the lost motion on either side: motor = axis + s·backlash/2 with
the side s = ±1 of the flank that pushes, 0 before the first motion.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.ports import MotorState


@dataclass(frozen=True)
class Drive:
    """An axis by its name, and the side of its backlash: 1 or −1, the direction of its last motion; 0: unknown."""

    name: str
    axis: Axis
    side: int = 0

    @property
    def unit(self) -> str:
        """Unit of positions in messages."""
        return "rad" if self.name == "rotation" else "mm"

    def to_counts(self, position: float) -> float:
        """Return the motor position (counts) for a position of the axis (mm or rad)."""
        return self.axis.scale * (position + 0.5 * self.side * self.axis.backlash)

    def to_position(self, counts: float) -> float:
        """Return the position (mm or rad) of the axis with its motor at `counts`."""
        return counts / self.axis.scale - 0.5 * self.side * self.axis.backlash

    def in_direction(self, travel: float) -> "Drive":
        """Return the drive with its backlash on the side of a motion by `travel` (mm or rad)."""
        return replace(self, side=int(math.copysign(1, travel))) if travel else self

    def error_of(self, state: MotorState) -> float:
        """Return commanded minus measured position (mm or rad), as the controller reports them."""
        return (state.commanded - state.position) / self.axis.scale

    def to_text(self, value: float) -> str:
        """Return a position or distance with its unit."""
        text, unit = (f"{math.degrees(value):.2f}", "°") if self.unit == "rad" else (f"{value:.3f}", " mm")
        return (text.removeprefix("-") if float(text) == 0.0 else text) + unit


_BACK_OFF_SHARE = 0.02  # of the range an axis moves away from its limit switch
_HOMING_SHARE = 0.1  # of the largest speed
_HOMING_REACH = 1.1  # of the range


def homing_speed(axis: Axis) -> float:
    """Return the speed (mm/s or rad/s) at which an axis searches its limit switch, and leaves it."""
    return _HOMING_SHARE * axis.speed


def homing_reach(axis: Axis) -> float:
    """Return the largest travel (mm or rad, signed) of an axis to the limit switch of its home.

    The switch may be beyond the range.
    """
    low, high = axis.limits
    beyond = max(low - axis.at_home, axis.at_home - high, 0.0)
    return axis.to_home * (_HOMING_REACH * (high - low) + beyond)


def position_after_homing(axis: Axis) -> float:
    """Return the position (mm or rad) at rest after homing: inside the range, off the limit switch of the home."""
    low, high = axis.limits
    return min(max(axis.at_home, low), high) - axis.to_home * _BACK_OFF_SHARE * (high - low)


def is_near_switch(axis: Axis, position: float) -> bool:
    """Return whether the switch of the home may be active at a position (mm or rad).

    It may be active nearer to the switch than midway between it and the position after homing.
    """
    return axis.to_home * (position - 0.5 * (axis.at_home + position_after_homing(axis))) > 0.0


@dataclass(frozen=True)
class MotorReading:
    """States of the motors by channel, at a time between the request and the reply (s)."""

    states: Mapping[str, MotorState]
    asked: float
    known: float

    @property
    def time(self) -> float:
        """Most likely time of the states (s)."""
        return 0.5 * (self.asked + self.known)


def has_arrived(drive: Drive, state: MotorState, goal: float) -> bool:
    """Return whether a motor is at rest within the tolerance of its goal (counts)."""
    return not state.moving and abs((state.position - goal) / drive.axis.scale) <= drive.axis.tolerance
