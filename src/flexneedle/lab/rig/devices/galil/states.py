"""Reports of the controller about an axis: its setup, and the state of its motor after them and the commands.

Source of the bits, codes and operands: Galil, Command Reference, DMC-4103.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

from flexneedle.lab.rig.devices.galil.replies import GarbledError
from flexneedle.ports import MotorSetup, MotorState

_MOVING, _OFF, _FORWARD_INACTIVE, _REVERSE_INACTIVE = 1 << 7, 1 << 5, 1 << 3, 1 << 2  # bits of TS
_FARTHEST = 2_147_483_648.0
_LARGEST_BYTE = 255.0

RUNNING, ARRIVED, STOPPED, ABORTED = 0, 1, 4, 7
_REASONS = {
    2: "at the forward limit: its switch, or FL",
    3: "at the reverse limit: its switch, or BL",
    STOPPED: "stopped by an ST that is not the driver's",
    6: "abort input",
    ABORTED: "aborted by an AB that is not the driver's",
    8: "off on error: position error, amplifier error or abort",
    11: "abort input of this axis",
    12: "encoder failure",
    15: "amplifier error",
    16: "stepper position error",
    41: "the controller's computer was overloaded",
    70: "EtherCAT communication failed",
    71: "EtherCAT drive error",
    99: "not in position in time",
}


SETUP = ("BL", "FL", "ER", "OE", "LD")
"""Operands of the setup of an axis."""
_UNLIMITED = 2_147_483_647.0
_DISABLED = {0: "", 1: "forward", 2: "reverse"}
_SWITCHES_OFF = (1, 3)  # values of OE


def make_setup(values: Sequence[float]) -> MotorSetup:
    """Return the setup of an axis with these values of `SETUP`. A negative ER disables the check of the error."""
    reverse, forward, error, on_error, disabled = values
    return MotorSetup(
        lowest=-inf if reverse <= -_UNLIMITED else reverse,
        highest=inf if forward >= _UNLIMITED else forward,
        most_error=error if error >= 0.0 else inf,
        off_on_error=int(on_error) in _SWITCHES_OFF,
        disabled=_DISABLED.get(int(disabled), "reverse and forward"),
    )


@dataclass(frozen=True)
class MotorReport:
    """One axis at one time, as reported: positions (counts), switches (TS), stop code (SC)."""

    position: float
    commanded: float
    switches: int
    code: int

    @property
    def moving(self) -> bool:
        """Whether the controller counts the axis as in motion; in position tracking perhaps also at its target."""
        return bool(self.switches & _MOVING)

    @property
    def reverse_limit(self) -> bool:
        """Whether the limit switch in the direction of falling counts is active."""
        return not self.switches & _REVERSE_INACTIVE

    @property
    def forward_limit(self) -> bool:
        """Whether the limit switch in the direction of rising counts is active."""
        return not self.switches & _FORWARD_INACTIVE


def make_report(position: float, commanded: float, switches: float, code: float) -> MotorReport:
    """Return the report of these values. Raises GarbledError for values that an axis cannot have."""
    if max(abs(position), abs(commanded)) > _FARTHEST:
        raise GarbledError(f"no position: {position:.12g}, {commanded:.12g}")
    for value in (switches, code):
        if not (0.0 <= value <= _LARGEST_BYTE and value == int(value)):
            raise GarbledError(f"no byte: {value:.12g}")
    return MotorReport(position, commanded, int(switches), int(code))


@dataclass(frozen=True)
class ChannelState:
    """State of an axis in the driver.

    target: commanded position (counts); None: nothing was commanded since it was stopped, defined or switched, or the
    connection was opened. tracking: the driver has started position tracking, and the controller has not ended it by
    a stop. waiting: the target is not sent yet; it is dropped if the controller stops the axis by itself, or would at
    once, at a limit switch. commanded: at the last report. code: stop code at the last report. old: stop codes that
    explain an earlier stop, not one of this motion.
    """

    target: int | None = None
    tracking: bool = False
    waiting: bool = False
    commanded: float | None = None
    code: int = ARRIVED
    old: frozenset[int] = frozenset()

    def with_target(self, target: int, *, tracking: bool) -> "ChannelState":
        """Return the channel on its way to a new target. The stop code is old until another one is reported."""
        old = self.old | {self.code}
        return replace(self, target=target, tracking=tracking, waiting=False, old=old)

    def without_target(self, *codes: int) -> "ChannelState":
        """Return the channel without a target; codes: stop codes that this will cause."""
        old = frozenset({self.code, *codes})
        return replace(self, target=None, tracking=False, waiting=False, old=old)


def take_report(channel: ChannelState, found: MotorReport) -> tuple[ChannelState, MotorState]:
    """Return the channel after a report, and the state of the motor.

    In position tracking the maker does not say whether an axis at its target counts as in motion. It rests if two
    reports in succession have the commanded position at the target: passing it, the axis is there in one at most.
    """
    arrived = channel.tracking and found.commanded == channel.target == channel.commanded
    good = found.code in (RUNNING, ARRIVED)
    old = channel.old if found.code in channel.old and not good else frozenset[int]()
    stopped = (
        _REASONS.get(found.code, f"stop code {found.code}")
        if channel.target is not None and not good and found.code not in old
        else ""
    )
    on = not found.switches & _OFF
    tracking = channel.tracking and on and not stopped
    waiting = channel.waiting and not stopped and not _is_blocked(channel, found)
    after = replace(
        channel, tracking=tracking, waiting=waiting, commanded=found.commanded, code=found.code, old=old
    )
    return after, MotorState(
        position=found.position,
        commanded=found.commanded,
        moving=(found.moving and not arrived) or waiting,
        on=on,
        reverse_limit=found.reverse_limit,
        forward_limit=found.forward_limit,
        stopped=stopped,
    )


def _is_blocked(channel: ChannelState, found: MotorReport) -> bool:
    """Return whether the target is beyond a limit switch that is active: the controller would not move there."""
    way = 0.0 if channel.target is None else channel.target - found.commanded
    return (found.reverse_limit and way < 0.0) or (found.forward_limit and way > 0.0)
