"""Ports of the closed loop: a clock, a driver that moves the needle, a tracker of its tip; and the motors of a rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from flexneedle.types import Control, Frame, Measurement, Motion


class Clock(Protocol):
    """Time since the start of the run."""

    def now(self) -> float:
        """Seconds since the start."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait for `seconds`."""
        ...


class Driver(Protocol):
    """Moves base and guide and rolls the bevel."""

    def apply(self, command: Control, duration: float) -> Motion:
        """Roll, then travel, the travel within `duration` seconds; return what was done, and when.

        The needle first rolls by `command.roll` (rad), with base and guide at rest, at the driver's own speed and in a
        time of its own: the travel begins only once the roll has arrived. Base, guide and spin then move together, each
        evenly over the `duration`, which is that of the slowest axis, never 0. Returns when all axes are at rest.

        The `Motion` has the control as it was carried out, and times on the clock of the run: `begun`, before which,
        and `ended`, after which nothing moved; `turned` (None without a roll), when the roll had arrived and the travel
        began. So readings are compared with a needle that rests until `begun`, rolls until `turned`, and travels until
        `ended`. Raises DriverError if the command is not carried out, CommandError if it exceeds a limit.
        """
        ...

    def stop(self) -> None:
        """Stop all axes at once, also a motion that is under way; without one, do nothing."""
        ...


class Tracker(Protocol):
    """Measures sensors: a device, a recording or a simulation."""

    def read(self) -> tuple[Frame, ...]:
        """The frames since the last call, oldest first; may be empty. Does not wait for the next frame."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, else the reason in a few words."""
        ...


class TipTracker(Protocol):
    """Measures the tip of the needle in the frame of the stage."""

    def read(self) -> tuple[Measurement, ...]:
        """The readings since the last call, oldest first; may be empty."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, else the reason in a few words."""
        ...


@dataclass(frozen=True)
class MotorState:
    """One motor as its controller reports it. Positions in counts.

    position: measured by the encoder; commanded: where the controller's own profile is now; moving: whether the profile
    is under way; on: whether the motor is powered; reverse_limit, forward_limit: whether the limit switch is active;
    stopped: why the controller itself ended the motion or switched the motor off, "" while it did neither; repeated:
    whether nothing newer is known than at the call before.
    """

    position: float
    commanded: float
    moving: bool = False
    on: bool = True
    reverse_limit: bool = False
    forward_limit: bool = False
    stopped: str = ""
    repeated: bool = False


@dataclass(frozen=True)
class MotorSetup:
    """How a controller is set up for one motor. Positions in counts.

    lowest, highest: soft limits of the controller itself, infinite where it has none; most_error: difference of
    commanded and measured position that it takes for an error; off_on_error: whether it then switches the motor off;
    disabled: limit switches that it ignores, such as "forward", "" for none.
    """

    lowest: float
    highest: float
    most_error: float
    off_on_error: bool
    disabled: str = ""


@dataclass(frozen=True)
class MotorPaces:
    """The smallest and largest speed (counts/s) and acceleration (counts/s²) that a controller takes."""

    speeds: tuple[float, float]
    accelerations: tuple[float, float]


class Motors(Protocol):
    """The motors of a rig by channel. It knows counts and channels, neither needles nor plans.

    No call takes longer than the reply timeout of the device. Each raises DriverError if the device cannot be reached
    or refuses the command; the message has the device's reason. For `rig check` a driver may have `identity`, one line
    that names the controller and its firmware, and `setup()`, which returns a `MotorSetup` by channel. It should have
    `address`, one line that names the device on this machine, by which one program at a time moves it; without it the
    driver's kind and settings in the rig file do. It may have `paces`, a `MotorPaces`: a rig file with another speed or
    acceleration is refused when the motors are opened.
    """

    def read(self) -> Mapping[str, MotorState]:
        """State of every channel, as of now."""
        ...

    def set_speed(self, channel: str, speed: float, acceleration: float) -> None:
        """Limit speed (counts/s) and acceleration (counts/s²) of the motions to come, and of those under way."""
        ...

    def follow(self, positions: Mapping[str, float]) -> None:
        """Move channels to absolute positions (counts), from wherever they are; each call replaces the one before."""
        ...

    def stop(self) -> None:
        """Stop all channels at once; motors stay powered."""
        ...

    def define(self, channel: str, position: float) -> None:
        """Call the present position of a channel at rest `position` (counts), as at the end of homing."""
        ...

    def power(self, channel: str, on: bool) -> None:
        """Switch a motor at rest on or off. Switched on from off, it is held where it is, its commanded position."""
        ...

    def reconnect(self) -> None:
        """Drop the connection and open a new one. It moves nothing, and changes nothing in the device.

        One that takes longer than the reply timeout is opened in a thread: this call raises DriverError until it is
        open, and is repeated.
        """
        ...

    def close(self) -> None:
        """Close the connection; motors are left as they are."""
        ...
