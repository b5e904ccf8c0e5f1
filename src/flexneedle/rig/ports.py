"""Ports of the closed loop: a clock, a driver that moves the needle, a tracker of its tip."""

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
        """Execute `command` within `duration` seconds; return what was done, and when it began and ended."""
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
