"""What the closed loop needs of the world: a clock, something that moves the needle, something that sees its tip."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

Command = tuple[float, float, float, float, int]
"""db_x, db_y (mm), db_theta (rad), dg_y (mm), flip (−1, or +1 to turn the bevel)."""


Point = tuple[float, float, float]
"""x, y, z (mm)."""
Quaternion = tuple[float, float, float, float]
"""Unit quaternion w, x, y, z: turns the sensor's frame into the tracker's. The sensor's z axis is the needle's."""

VISIBLE = "ok"
"""Status of a sensor that the tracker sees, and of a tracker that sends frames."""


@dataclass(frozen=True)
class Reading:
    """One sensor in one frame of a tracker, in the tracker's frame; what it does not know is None.

    indicator: how far the two coils of a 6-DOF sensor disagree (paper, section IV-B); 5-DOF sensors may have one, too.
    status: VISIBLE, or in a few words why there is no position.
    """

    position: Point | None
    orientation: Quaternion | None = None
    indicator: float | None = None
    status: str = VISIBLE


def is_reference(sensor: str) -> bool:
    """Whether a sensor is one that stands still around the workspace, by its name: ref1, ref2, reference, …"""
    return sensor.lower().startswith("ref")


@dataclass(frozen=True)
class Frame:
    """What a tracker saw at one time (s, on the clock of the run): readings by name of the sensor, such as "tip".

    number: the tracker's own count of frames; it goes on while frames are lost.
    """

    time: float
    number: int
    readings: Mapping[str, Reading]


@dataclass(frozen=True)
class Sample:
    """The tip in one frame: time it was taken (s); x, y in the plane and z out of it (mm), None where it was not seen.

    frame: what the tracker said, for those who judge it; None if there is no more than the tip.
    """

    time: float
    x: float | None
    y: float | None
    z: float | None = None
    frame: Frame | None = None


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

    def read(self) -> tuple[Sample, ...]:
        """The readings since the last call, oldest first; empty if there was none."""
        ...

    @property
    def status(self) -> str:
        """VISIBLE while readings come, or in a few words why none do."""
        ...
