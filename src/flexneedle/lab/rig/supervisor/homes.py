"""How an axis searches the limit switch of its home, and where it rests afterwards: pure functions of its file."""

from flexneedle.scenario.sections.axes import Axis

_BACK_OFF_SHARE = 0.02  # of the range an axis moves away from its limit switch
_HOMING_SHARE = 0.1  # of the largest speed
_HOMING_REACH = 1.1  # of the range


def homing_speed(axis: Axis) -> float:
    """Speed (mm/s or rad/s) at which an axis searches its limit switch, and leaves it."""
    return _HOMING_SHARE * axis.speed


def homing_reach(axis: Axis) -> float:
    """Largest travel (mm or rad, signed) of an axis to the limit switch of its home, which may be beyond its range."""
    low, high = axis.limits
    beyond = max(low - axis.at_home, axis.at_home - high, 0.0)
    return axis.to_home * (_HOMING_REACH * (high - low) + beyond)


def homed_at(axis: Axis) -> float:
    """Position (mm or rad) at which an axis rests after homing: inside its range, off the limit switch of its home."""
    low, high = axis.limits
    return min(max(axis.at_home, low), high) - axis.to_home * _BACK_OFF_SHARE * (high - low)


def may_be_at_switch(axis: Axis, position: float) -> bool:
    """Whether the switch of the home may be active at a position (mm or rad): nearer to it than where homing ends."""
    return axis.to_home * (position - 0.5 * (axis.at_home + homed_at(axis))) > 0.0
