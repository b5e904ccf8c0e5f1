"""Ports of the closed loop and of a rig: clock, driver, trackers, motors."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from flexneedle.types import Control, Frame, Measurement, Motion, Reading


class Clock(Protocol):
    """Time since the start of the run."""

    def now(self) -> float:
        """Return the time since the start (s)."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait for a time (s)."""
        ...


class Driver(Protocol):
    """Moves base and guide and rolls the bevel."""

    def apply(self, command: Control, duration: float) -> Motion:
        """Roll the needle, then travel; return the motion after all axes have come to rest.

        The needle first rolls by `command.roll` (rad) at the driver's own speed, with base and guide at rest. Base,
        guide and spin then move together and evenly over the duration.

        Args:
            command: The control to carry out.
            duration: Time of the travel (s), set by the slowest axis, never 0.

        Returns:
            The control that was carried out, with times on the clock of the run. Nothing moved before `begun` or after
            `ended`; `turned` is the time at which the roll ended and the travel began, None without a roll. Readings
            are compared with a needle that moves as these times state.

        Raises:
            DriverError: The command is not carried out.
            CommandError: The command exceeds a limit.
        """
        ...

    def stop(self) -> None:
        """Stop all axes at once. At rest, do nothing."""
        ...


class Tracker(Protocol):
    """Measures sensors: a device, a recording or a simulation."""

    def read(self) -> tuple[Frame, ...]:
        """Return the frames since the last call, oldest first, without waiting; may be empty."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, otherwise the reason in a few words."""
        ...


class TipTracker(Protocol):
    """Measures the tip of the needle in the frame of the stage."""

    def read(self) -> tuple[Measurement, ...]:
        """Return the readings since the last call, oldest first, without waiting; may be empty."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, otherwise the reason in a few words."""
        ...


class NeedleSensor(Protocol):
    """Measures the needle: a sensor of the scenario's `[[sensor]]`, other than the tracker."""

    def read(self) -> tuple[Reading, ...]:
        """Return the readings since the last call, oldest first, without waiting; may be empty."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, otherwise the reason in a few words."""
        ...


@dataclass(frozen=True)
class MotorState:
    """State of one motor as its controller reports it. Positions are in counts.

    Attributes:
        position: Position measured by the encoder.
        commanded: Present position of the controller's own profile.
        moving: Whether the profile is under way.
        on: Whether the motor is powered.
        reverse_limit: Whether the limit switch of the reverse side is active.
        forward_limit: Whether the limit switch of the forward side is active.
        stopped: Reason for which the controller itself ended the motion or switched the motor off, otherwise "".
        repeated: Whether the state is the one of the previous call, without newer data.
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
    """Setup of a controller for one motor. Positions are in counts.

    Attributes:
        lowest: Lower soft limit of the controller, infinite without one.
        highest: Upper soft limit of the controller, infinite without one.
        most_error: Difference of commanded and measured position from which the controller reports an error.
        off_on_error: Whether the controller then switches the motor off.
        disabled: Limit switches that the controller ignores, such as "forward"; "" for none.
    """

    lowest: float
    highest: float
    most_error: float
    off_on_error: bool
    disabled: str = ""


@dataclass(frozen=True)
class MotorPaces:
    """Smallest and largest speed (counts/s) and acceleration (counts/s²) that a controller accepts."""

    speeds: tuple[float, float]
    accelerations: tuple[float, float]


class Motors(Protocol):
    """The motors of a rig by channel, in counts.

    No call takes longer than the reply timeout of the device. A call raises DriverError with the device's reason if the
    device cannot be reached or refuses the command.

    A driver should have `address`, one line that names the device on this machine: one program at a time moves the
    motors at an address. Without it, the address is the driver's kind with its settings in the rig file. Optional
    attributes: `identity`, one line that names the controller and its firmware, and `setup()`, which returns a
    `MotorSetup` by channel, both for `rig check`; and `paces`, a `MotorPaces`, so that a rig file with another speed
    or acceleration is refused when the motors are opened.
    """

    def read(self) -> Mapping[str, MotorState]:
        """Return the present state of each channel."""
        ...

    def set_speed(self, channel: str, speed: float, acceleration: float) -> None:
        """Limit speed (counts/s) and acceleration (counts/s²) of present and later motions."""
        ...

    def follow(self, positions: Mapping[str, float]) -> None:
        """Move channels to absolute positions (counts); each call replaces the previous one."""
        ...

    def stop(self) -> None:
        """Stop all channels at once; motors stay powered."""
        ...

    def define(self, channel: str, position: float) -> None:
        """Set the present position of a channel at rest to `position` (counts), as at the end of homing."""
        ...

    def power(self, channel: str, on: bool) -> None:
        """Switch a motor at rest on or off. A motor that is switched on is held at its measured position."""
        ...

    def reconnect(self) -> None:
        """Drop the connection and open a new one, without a motion or a change in the device.

        If connecting takes longer than the reply timeout, connect in a thread: this call raises DriverError until the
        connection is open, and is repeated.
        """
        ...

    def close(self) -> None:
        """Close the connection; the motors stay as they are."""
        ...
