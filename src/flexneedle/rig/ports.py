"""What the closed loop needs of the world: a clock, a driver that moves the needle, a tracker of its tip."""

from typing import Protocol

from flexneedle.types import Command, Frame, Measurement


class Clock(Protocol):
    """Time since the start of the run."""

    def now(self) -> float:
        """Seconds since the start."""
        ...

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass."""
        ...


class Driver(Protocol):
    """Moves base and guide and turns the bevel."""

    def apply(self, command: Command, duration: float) -> Command:
        """Carry out `command` within `duration` seconds; return it as it was applied."""
        ...


class Tracker(Protocol):
    """Sees sensors: a device, a recording or a simulation."""

    def read(self) -> tuple[Frame, ...]:
        """The frames since the last call, oldest first; empty if there was none. Never waits for the next."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while frames come, or in a few words why none do."""
        ...


class TipTracker(Protocol):
    """Sees the tip of the needle, in the frame of the stage."""

    def read(self) -> tuple[Measurement, ...]:
        """The readings since the last call, oldest first; empty if there was none."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while readings come, or in a few words why none do."""
        ...
