"""One axis of the emulated controller: amplifier, motor, encoder and switches. Counts and seconds."""

import math
from dataclasses import dataclass, field, replace

from flexneedle.lab.emulators.galil.profile import (
    DECELERATION,
    SAMPLE_S,
    MotionProfile,
    advance_profile,
    halt,
    slow_to_rest,
)

FOLLOWS = "follows"
FAULTS = ("stall", "lag", "overshoot", "reversed", "limit")
"""Faults of a motor: it does not move; follows late; moves too far; turns the wrong way; is at a limit switch."""

_LAG_S = 0.15
_SERVO_S = 0.02  # in which the servo of a motor that is free again makes up for its position error
_OVERSHOOT = 0.2

RUNNING, ARRIVED, FORWARD_LIMIT, REVERSE_LIMIT, STOPPED, ABORTED, ERROR_OFF = 0, 1, 2, 3, 4, 7, 8
"""Stop codes, as SC reports them."""

_FAR = 2_147_483_647.0
_OFF_ON_ERROR, _OFF_ON_SWITCH = 1, 2
_ROUNDING = 1e-6  # counts; steps of the encoder are summed up


@dataclass(frozen=True)
class MotorAxis:
    """An axis of the controller.

    encoder: measured position; forward, reverse: software limits; switches: positions of the limit switches;
    disabled: switches that stop nothing (LD), 1 forward, 2 reverse, 3 both; deceleration, limit_deceleration: to its
    goal or after a stop (DC), and at a limit (SD); error_limit: position error (ER), none if negative; off_on_error:
    OE, 1 to switch the motor off beyond it and on an abort, 2 at a limit switch, 3 both; relative, absolute: of the
    next motion, PR or PA; tracking: it follows PA at once (PT); rested: commanded position at which the last motion
    ended; stop: stop code; fault: kind of fault of the motor.
    """

    profile: MotionProfile = field(default_factory=MotionProfile)
    encoder: float = 0.0
    servo: bool = False
    running: bool = False
    tracking: bool = False
    relative: float | None = None
    absolute: float = 0.0
    rested: float = 0.0
    forward: float = _FAR
    reverse: float = -_FAR - 1.0
    deceleration: float = DECELERATION
    limit_deceleration: float = DECELERATION
    switches: tuple[float, float] = (-math.inf, math.inf)
    disabled: int = 0
    error_limit: float = 16_384.0
    off_on_error: int = 0
    stop: int = ARRIVED
    fault: str = FOLLOWS

    @property
    def error(self) -> float:
        """Position error: commanded minus measured position."""
        return self.profile.position - self.encoder

    @property
    def at_switches(self) -> tuple[bool, bool]:
        """Whether the reverse and the forward limit switch are active."""
        stuck = self.fault == "limit"
        return stuck or self.encoder <= self.switches[0], stuck or self.encoder >= self.switches[1]

    @property
    def goal(self) -> float:
        """Position at which the motion that is set would end."""
        return self.absolute if self.relative is None else self.profile.position + self.relative

    def limit_in(self, direction: float) -> int | None:
        """Return the stop code of a limit in a direction, None without one. A software limit begins a count beyond."""
        active, switch_off = self.at_switches, self.disabled
        reverse, forward = active[0] and not switch_off & 2, active[1] and not switch_off & 1
        if direction > 0.0 and (forward or self.profile.position >= self.forward + 1.0):
            return FORWARD_LIMIT
        if direction < 0.0 and (reverse or self.profile.position <= self.reverse - 1.0):
            return REVERSE_LIMIT
        return None

    @property
    def idle(self) -> bool:
        """Whether nothing changes in a sample: the motor is off, or commanded and measured position rest as one."""
        rests = self.profile.at_rest and abs(self.error) < _ROUNDING
        return not self.servo or (rests and self.running == self.tracking)


def begin_motion(axis: MotorAxis) -> MotorAxis:
    """Return the axis at the begin of the motion that is set."""
    profile = replace(axis.profile, goal=axis.goal, stopping=False, deceleration=axis.deceleration)
    return replace(axis, profile=profile, running=True, stop=RUNNING, relative=None, absolute=axis.goal)


def follow_position(axis: MotorAxis, position: float) -> MotorAxis:
    """Return the axis at the begin of its motion to a new position."""
    profile = replace(axis.profile, goal=position, stopping=False, deceleration=axis.deceleration)
    return replace(axis, profile=profile, absolute=position, running=True, stop=RUNNING)


def slow_down(axis: MotorAxis, why: int) -> MotorAxis:
    """Return the axis at the begin of its deceleration to rest, with SD at a limit, else with DC."""
    at_limit = why in (FORWARD_LIMIT, REVERSE_LIMIT)
    rate = axis.limit_deceleration if at_limit else axis.deceleration
    profile = replace(slow_to_rest(axis.profile), deceleration=rate)
    return replace(axis, profile=profile, tracking=False, stop=why)


def switch_off(axis: MotorAxis, why: int | None = None) -> MotorAxis:
    """Return the axis with its motor off: the commanded position follows the encoder.

    why: stop code if it was in motion.
    """
    stop = why if why is not None and axis.running else axis.stop
    profile = halt(replace(axis.profile, position=axis.encoder))
    off = replace(axis, profile=profile, servo=False, running=False, tracking=False)
    return replace(off, rested=axis.encoder, stop=stop)


def switch_on(axis: MotorAxis) -> MotorAxis:
    """Return the axis with its motor on, held at its position."""
    if axis.servo:
        return axis
    profile = halt(replace(axis.profile, position=axis.encoder))
    return replace(axis, profile=profile, servo=True, absolute=axis.encoder)


def abort_motion(axis: MotorAxis) -> MotorAxis:
    """Return the axis at rest at once, with its motor off if errors switch it off."""
    if axis.off_on_error:
        return switch_off(axis, ABORTED)
    stop = ABORTED if axis.running else axis.stop
    profile = halt(axis.profile)
    return replace(axis, profile=profile, running=False, tracking=False, rested=profile.position, stop=stop)


def define_position(axis: MotorAxis, position: float) -> MotorAxis:
    """Return the axis with another value for its present position."""
    shift = position - axis.encoder
    profile = halt(replace(axis.profile, position=axis.profile.position + shift))
    low, high = axis.switches
    switches = (low + shift, high + shift)
    return replace(
        axis, profile=profile, encoder=position, absolute=position, rested=profile.position, switches=switches
    )


def advance_axis(axis: MotorAxis) -> MotorAxis:
    """Return the axis after one sample of the controller."""
    if axis.idle:
        return axis
    before = axis.profile
    limit = axis.limit_in(_direction_of(axis)) if axis.running and not before.stopping else None
    if limit is not None:
        if axis.off_on_error & _OFF_ON_SWITCH and any(axis.at_switches):
            return switch_off(axis, limit)
        axis = slow_down(axis, limit)
    profile = advance_profile(axis.profile) if axis.running else axis.profile
    axis = replace(axis, profile=profile, encoder=_next_encoder(axis, before, profile))
    if axis.off_on_error & _OFF_ON_ERROR and abs(axis.error) > axis.error_limit >= 0.0:
        return switch_off(axis, ERROR_OFF)
    return _end_motion(axis) if axis.running and profile.at_rest else axis


def _end_motion(axis: MotorAxis) -> MotorAxis:
    """Return the axis at the end of its motion. In position tracking it waits for the next goal."""
    if axis.tracking:
        return replace(axis, rested=axis.profile.position, stop=RUNNING)
    stop = ARRIVED if axis.stop == RUNNING else axis.stop
    return replace(axis, running=False, rested=axis.profile.position, stop=stop)


def _direction_of(axis: MotorAxis) -> float:
    if axis.profile.velocity:
        return axis.profile.velocity
    return axis.profile.goal - axis.profile.position


def _next_encoder(axis: MotorAxis, before: MotionProfile, after: MotionProfile) -> float:
    """Return the measured position after a sample: the profile's, unless the motor has a fault."""
    moved = after.position - before.position
    if axis.fault == "stall":
        return axis.encoder
    if axis.fault == "lag":
        return axis.encoder + (after.position - axis.encoder) * SAMPLE_S / _LAG_S
    if axis.fault == "overshoot":
        return axis.encoder + (1.0 + _OVERSHOOT) * moved
    if axis.fault == "reversed":
        return axis.encoder - moved
    return axis.encoder + moved + (before.position - axis.encoder) * SAMPLE_S / _SERVO_S
