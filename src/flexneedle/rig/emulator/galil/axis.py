"""One axis of the emulated controller: amplifier, motor, encoder and switches. Counts and seconds."""

import math
from dataclasses import dataclass, field, replace

from flexneedle.rig.emulator.galil.profile import SAMPLE_S, Profile, advanced, halted, stopped

FOLLOWS = "follows"
FAULTS = ("stall", "lag", "overshoot", "reversed", "limit")
"""What a motor may do in place of its command: it does not move; follows late; goes too far; turns the wrong way; is at
a limit switch."""

_LAG_S = 0.15
_OVERSHOOT = 0.2

RUNNING, ARRIVED, FORWARD_LIMIT, REVERSE_LIMIT, STOPPED, ABORTED, ERROR_OFF = 0, 1, 2, 3, 4, 7, 8
"""Stop codes, as SC reports them."""

_FAR = 2_147_483_647.0


@dataclass(frozen=True)
class Axis:
    """An axis. encoder: measured position; forward, reverse: software limits; switches: positions of the limit
    switches; error_limit: position error (ER); off_on_error: whether the motor is switched off beyond it (OE).

    relative, absolute: of the next motion, PR or PA; tracking: whether it follows PA at once (PT); stop: why it
    rests; fault: what the motor does.
    """

    profile: Profile = field(default_factory=Profile)
    encoder: float = 0.0
    servo: bool = False
    running: bool = False
    tracking: bool = False
    jog: float | None = None
    relative: float | None = None
    absolute: float = 0.0
    forward: float = _FAR
    reverse: float = -_FAR
    switches: tuple[float, float] = (-math.inf, math.inf)
    error_limit: float = 16_384.0
    off_on_error: bool = False
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

    def blocked(self, direction: float) -> int | None:
        """The stop code of a limit in this direction, if one is there."""
        reverse, forward = self.at_switches
        if direction > 0.0 and (forward or self.profile.position >= self.forward):
            return FORWARD_LIMIT
        if direction < 0.0 and (reverse or self.profile.position <= self.reverse):
            return REVERSE_LIMIT
        return None


def begun(axis: Axis) -> Axis:
    """The axis on its way to what is set."""
    if axis.jog is not None:
        profile = replace(axis.profile, goal=None, cruise=axis.jog, stopping=False)
    else:
        profile = replace(axis.profile, goal=axis.goal, stopping=False)
    return replace(axis, profile=profile, running=True, stop=RUNNING, relative=None, absolute=axis.goal)


def tracked(axis: Axis, position: float) -> Axis:
    """The axis following a new position at once."""
    profile = replace(axis.profile, goal=position, stopping=False)
    return replace(axis, profile=profile, absolute=position, running=True, stop=RUNNING)


def slowed(axis: Axis, why: int) -> Axis:
    """The axis slowing down to rest."""
    return replace(axis, profile=stopped(axis.profile), tracking=False, jog=None, stop=why)


def off(axis: Axis, why: int | None = None) -> Axis:
    """The axis with its motor off: the commanded position follows the encoder."""
    profile = halted(replace(axis.profile, position=axis.encoder))
    stop = axis.stop if why is None else why
    return replace(axis, profile=profile, servo=False, running=False, tracking=False, jog=None, stop=stop)


def on(axis: Axis) -> Axis:
    """The axis held where it is."""
    if axis.servo:
        return axis
    profile = halted(replace(axis.profile, position=axis.encoder))
    return replace(axis, profile=profile, servo=True, absolute=axis.encoder)


def aborted(axis: Axis) -> Axis:
    """The axis at rest at once."""
    return replace(axis, profile=halted(axis.profile), running=False, tracking=False, jog=None, stop=ABORTED)


def defined(axis: Axis, position: float) -> Axis:
    """The axis with its present position called so."""
    shift = position - axis.encoder
    profile = halted(replace(axis.profile, position=axis.profile.position + shift))
    low, high = axis.switches
    return replace(
        axis, profile=profile, encoder=position, absolute=position, switches=(low + shift, high + shift)
    )


def sampled(axis: Axis) -> Axis:
    """The axis after one sample of the controller."""
    if not axis.servo:
        return axis
    before = axis.profile
    limit = axis.blocked(_direction(axis)) if axis.running and not before.stopping else None
    if limit is not None:
        axis = slowed(axis, limit)
    profile = advanced(axis.profile) if axis.running else axis.profile
    axis = replace(axis, profile=profile, encoder=_followed(axis, before, profile))
    if axis.running and profile.at_rest:
        arrived = ARRIVED if axis.stop == RUNNING else axis.stop
        axis = replace(axis, running=axis.tracking, stop=RUNNING if axis.tracking else arrived)
    if axis.off_on_error and abs(axis.error) > axis.error_limit:
        return off(axis, ERROR_OFF)
    return axis


def _direction(axis: Axis) -> float:
    if axis.profile.velocity:
        return axis.profile.velocity
    return axis.profile.cruise if axis.profile.goal is None else axis.profile.goal - axis.profile.position


def _followed(axis: Axis, before: Profile, after: Profile) -> float:
    """Measured position after a sample: that of the profile, or what a faulty motor does."""
    moved = after.position - before.position
    if axis.fault == "stall":
        return axis.encoder
    if axis.fault == "lag":
        return axis.encoder + (after.position - axis.encoder) * SAMPLE_S / _LAG_S
    if axis.fault == "overshoot":
        return axis.encoder + (1.0 + _OVERSHOOT) * moved
    if axis.fault == "reversed":
        return axis.encoder - moved
    return axis.encoder + moved
