"""Commands to one axis of the emulated controller: settings, actions and queries, with the errors of refused ones."""

import math
from collections.abc import Callable
from dataclasses import replace

from flexneedle.lab.emulators.galil import motor_axis as one
from flexneedle.lab.emulators.galil.motor_axis import MotorAxis

ERRORS = {
    1: "Unrecognized command",
    4: "Operand error",
    6: "Number out of range",
    7: "Command not valid while running",
    20: "Begin not valid with motor off",
    21: "Begin not valid while running",
    22: "Begin not possible due to Limit Switch",
    50: "Not enough fields",
    51: "Question mark not valid",
}
"""Error codes that it may report, with their texts."""

_MOST = 2_147_483_647.0
_MOST_SPEED = 15_000_000.0  # of servo motors
_LEAST_ACCELERATION, _MOST_ACCELERATION = 1024.0, 1_073_740_800.0  # at 1000 samples a second (TM 1000)
_SPEED_STEP, _ACCELERATION_STEP = 2.0, 1024.0  # set values are rounded down to their multiples


class CommandRefusal(Exception):
    """A command that is answered by `?`, with its code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


# Settings


def _require_within(value: float, least: float, most: float) -> float:
    if not least <= value <= most:
        raise CommandRefusal(6)
    return value


def _require_rest(axis: MotorAxis) -> None:
    if axis.running:
        raise CommandRefusal(7)


def _set_speed(axis: MotorAxis, value: float) -> MotorAxis:
    speed = _round_down(_require_within(abs(value), 0.0, _MOST_SPEED), _SPEED_STEP)
    return replace(axis, profile=replace(axis.profile, speed=speed))


def _round_down(value: float, step: float) -> float:
    return math.floor(value / step) * step


def _round_rate(value: float) -> float:
    return _round_down(_require_within(value, _LEAST_ACCELERATION, _MOST_ACCELERATION), _ACCELERATION_STEP)


def _set_acceleration(axis: MotorAxis, value: float) -> MotorAxis:
    return replace(axis, profile=replace(axis.profile, acceleration=_round_rate(value)))


def _set_deceleration(axis: MotorAxis, value: float) -> MotorAxis:
    """Set DC, which may change after a stop, but not on the way to a position."""
    stopping = axis.profile.stopping
    if axis.running and not stopping and not axis.profile.at_rest:
        raise CommandRefusal(7)
    rate = _round_rate(value)
    profile = replace(axis.profile, deceleration=rate) if stopping else axis.profile
    return replace(axis, deceleration=rate, profile=profile)


def _set_relative(axis: MotorAxis, value: float) -> MotorAxis:
    _require_rest(axis)
    return replace(axis, relative=_round_counts(value))


def _round_counts(value: float) -> float:
    return float(int(_require_within(value, -_MOST - 1.0, _MOST)))


def _set_absolute(axis: MotorAxis, value: float) -> MotorAxis:
    value = _round_counts(value)
    if axis.tracking:
        if axis.limit_in(value - axis.profile.position) is not None:
            raise CommandRefusal(22)
        return one.follow_position(axis, value)
    _require_rest(axis)
    return replace(axis, absolute=value, relative=None)


def _set_position(axis: MotorAxis, value: float) -> MotorAxis:
    _require_rest(axis)
    return one.define_position(axis, _round_counts(value))


def _set_tracking(axis: MotorAxis, value: float) -> MotorAxis:
    if value not in (0.0, 1.0):
        raise CommandRefusal(6)
    if value == 0.0:
        return one.slow_down(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)
    if not axis.servo:
        raise CommandRefusal(20)
    if axis.tracking:
        return axis
    goal = axis.profile.goal if axis.running else axis.profile.position
    return replace(axis, tracking=True, relative=None, absolute=goal)


def _require_whole(value: float, least: float, most: float) -> float:
    if value != int(value):
        raise CommandRefusal(6)
    return _require_within(value, least, most)


SETTINGS: dict[str, tuple[Callable[[MotorAxis], float], Callable[[MotorAxis, float], MotorAxis]]] = {
    "SP": (lambda axis: axis.profile.speed, _set_speed),
    "AC": (lambda axis: axis.profile.acceleration, _set_acceleration),
    "DC": (lambda axis: axis.deceleration, _set_deceleration),
    "SD": (
        lambda axis: axis.limit_deceleration,
        lambda axis, value: replace(axis, limit_deceleration=_round_rate(value)),
    ),
    "PR": (lambda axis: axis.goal - axis.profile.position, _set_relative),
    "PA": (lambda axis: axis.rested, _set_absolute),
    "DP": (lambda axis: axis.encoder, _set_position),
    "PT": (lambda axis: float(axis.tracking), _set_tracking),
    "FL": (lambda axis: axis.forward, lambda axis, value: replace(axis, forward=_round_counts(value))),
    "BL": (lambda axis: axis.reverse, lambda axis, value: replace(axis, reverse=_round_counts(value))),
    "LD": (
        lambda axis: float(axis.disabled),
        lambda axis, value: replace(axis, disabled=int(_require_whole(value, 0.0, 3.0))),
    ),
    "ER": (
        lambda axis: axis.error_limit,
        lambda axis, value: replace(axis, error_limit=_require_whole(value, -1.0, _MOST)),
    ),
    "OE": (
        lambda axis: float(axis.off_on_error),
        lambda axis, value: replace(axis, off_on_error=int(_require_whole(value, 0.0, 3.0))),
    ),
}


# Actions


def _begin(axis: MotorAxis) -> MotorAxis:
    if not axis.servo:
        raise CommandRefusal(20)
    if axis.running:
        raise CommandRefusal(21)
    if axis.limit_in(axis.goal - axis.profile.position) is not None:
        raise CommandRefusal(22)
    return one.begin_motion(axis)


def _motor_off(axis: MotorAxis) -> MotorAxis:
    _require_rest(axis)
    return one.switch_off(axis)


def _stop(axis: MotorAxis) -> MotorAxis:
    return one.slow_down(axis, one.STOPPED) if axis.running else replace(axis, tracking=False)


def _motor_on(axis: MotorAxis) -> MotorAxis:
    _require_rest(axis)
    return one.switch_on(axis)


ACTIONS: dict[str, Callable[[MotorAxis], MotorAxis]] = {
    "SH": _motor_on,
    "MO": _motor_off,
    "BG": _begin,
    "ST": _stop,
}


# Queries


def _status_bits(axis: MotorAxis) -> float:
    """Return the bits of TS.

    7: in motion; 6: position error beyond its limit; 5: motor off; 3, 2: forward, reverse limit not active.
    """
    reverse, forward = axis.at_switches
    bits = (
        (7, axis.running),
        (6, abs(axis.error) > axis.error_limit),
        (5, not axis.servo),
        (3, not forward),
        (2, not reverse),
    )
    return float(sum(1 << bit for bit, holds in bits if holds))


REPORTED: dict[str, Callable[[MotorAxis], float]] = {
    "TP": lambda axis: round(axis.encoder),
    "RP": lambda axis: round(axis.profile.position),
    "TE": lambda axis: round(axis.profile.position) - round(axis.encoder),
    "TV": lambda axis: round(axis.profile.velocity),
    "TS": _status_bits,
    "SC": lambda axis: axis.stop,
}
OPERANDS: dict[str, Callable[[MotorAxis], float]] = {
    **REPORTED,
    **{name: reported for name, (reported, _) in SETTINGS.items()},
    "BG": lambda axis: float(axis.running),
    "MO": lambda axis: float(not axis.servo),
    "LF": lambda axis: float(not axis.at_switches[1]),
    "LR": lambda axis: float(not axis.at_switches[0]),
    "MT": lambda _: 1.0,
}
