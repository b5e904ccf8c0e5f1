"""What the closed loop needs of the world: a clock, something that moves the needle, something that sees its tip."""

from dataclasses import dataclass
from typing import Protocol

Command = tuple[float, float, float, float, int]
"""db_x, db_y (mm), db_theta (rad), dg_y (mm), flip (−1, or +1 to turn the bevel)."""


@dataclass(frozen=True)
class Sample:
    """One reading of the tip tracker: time it was taken (s), tip x and y (mm), None where it saw nothing."""

    time: float
    x: float | None
    y: float | None


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
    """Sees the tip of the needle."""

    def read(self) -> tuple[Sample, ...]:
        """The readings since the last call, oldest first; empty if there was none."""
        ...
