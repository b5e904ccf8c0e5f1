"""The rig file: the motors, trackers and links of a laboratory, and how axes of the needle map to motors.

Lengths are in mm, angles in degrees; counts are those of the motor's encoder. A driver or tracker has settings of its
own beside `kind`, which it checks itself.
"""

from collections.abc import Iterator, Mapping
from importlib.resources import files
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from flexneedle.errors import RigError
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title
from flexneedle.scenario.sections.registration import Registration

RIGS = Library("a rig file", "rig", files(__package__) / "rigs", RigError)
"""The rigs that come with the package."""

LINEAR_AXES = ("insertion", "guide_y", "guide_z", "base_y", "base_z")
"""Axes with a length: advance of the base, lateral offsets of guide and base."""

Channel = Annotated[str, Field(min_length=1, max_length=40)]
Range = Annotated[tuple[float, float], Field(strict=False)]
Home = Literal["here", "reverse-limit", "forward-limit", "absolute"]


class Part(Section):
    """A driver or tracker: its kind, and settings of its own, unchecked here."""

    model_config = ConfigDict(extra="allow")

    kind: Annotated[str, Field(min_length=1, max_length=200)]
    """Name of one that is installed, or `module:NAME` for your own."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Its own settings by key."""
        return dict(self.model_extra or {})


class Axis(Section):
    """An axis and its motor. `scale`, `limits` and the other properties are in counts, mm or rad, and s."""

    channel: Channel
    """The motor's name at its controller, such as "A"."""
    direction: Literal[-1, 1] = 1
    """1 if counts increase with the axis's positive direction, else −1."""
    home: Home = "here"
    """How `rig home` finds the zero: where the axis is, at a limit switch, or never (an absolute encoder)."""

    @property
    def scale(self) -> float:
        """Signed counts per mm or rad."""
        raise NotImplementedError

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position, mm or rad."""
        raise NotImplementedError

    @property
    def speed(self) -> float:
        """Largest speed, mm/s or rad/s."""
        raise NotImplementedError

    @property
    def acceleration(self) -> float:
        """Acceleration, mm/s² or rad/s²."""
        raise NotImplementedError

    @property
    def at_home(self) -> float:
        """Position of the zero, mm or rad."""
        raise NotImplementedError

    @property
    def backlash(self) -> float:
        """Lost motion on reversal, mm or rad."""
        raise NotImplementedError

    @property
    def max_error(self) -> float:
        """Largest difference of commanded and measured position, mm or rad."""
        raise NotImplementedError

    @property
    def tolerance(self) -> float:
        """Largest distance from the goal of a motion that has ended, mm or rad."""
        raise NotImplementedError


class LinearAxis(Axis):
    """Section `axes.insertion`, and those of guide and base: an axis with a length."""

    counts_per_mm: Positive
    """Counts of the encoder per mm."""
    range_mm: Range
    """Soft limits [lowest, highest]: no command goes beyond."""
    speed_mm_s: Positive
    """Largest speed."""
    acceleration_mm_s2: Positive
    """Acceleration and deceleration."""
    home_mm: float = 0.0
    """Position of the axis at its home."""
    backlash_mm: NonNegative = 0.0
    """Lost motion when the motor reverses, made up for."""
    max_error_mm: Positive = 0.2
    """Largest difference of commanded and measured position; beyond it the rig stops with a fault."""
    tolerance_mm: Positive = 0.02
    """A motion has arrived within this distance from its goal."""

    scale = property(lambda self: self.direction * self.counts_per_mm)
    limits = property(lambda self: self.range_mm)
    speed = property(lambda self: self.speed_mm_s)
    acceleration = property(lambda self: self.acceleration_mm_s2)
    at_home = property(lambda self: self.home_mm)
    backlash = property(lambda self: self.backlash_mm)
    max_error = property(lambda self: self.max_error_mm)
    tolerance = property(lambda self: self.tolerance_mm)


class RotaryAxis(Axis):
    """Section `axes.rotation`: the roll of the needle about its axis."""

    counts_per_deg: Positive
    """Counts of the encoder per degree."""
    range_deg: Range
    """Soft limits [lowest, highest]: no command goes beyond."""
    speed_deg_s: Positive
    """Largest speed."""
    acceleration_deg_s2: Positive
    """Acceleration and deceleration."""
    home_deg: float = 0.0
    """Angle of the axis at its home."""
    backlash_deg: NonNegative = 0.0
    """Lost motion when the motor reverses, made up for."""
    max_error_deg: Positive = 5.0
    """Largest difference of commanded and measured angle; beyond it the rig stops with a fault."""
    tolerance_deg: Positive = 1.0
    """A roll has arrived within this angle from its goal."""

    scale = property(lambda self: self.direction * self.counts_per_deg / radians(1.0))
    limits = property(lambda self: (radians(self.range_deg[0]), radians(self.range_deg[1])))
    speed = property(lambda self: radians(self.speed_deg_s))
    acceleration = property(lambda self: radians(self.acceleration_deg_s2))
    at_home = property(lambda self: radians(self.home_deg))
    backlash = property(lambda self: radians(self.backlash_deg))
    max_error = property(lambda self: radians(self.max_error_deg))
    tolerance = property(lambda self: radians(self.tolerance_deg))


class Axes(Section):
    """Section `axes`: the axes that the rig has."""

    insertion: LinearAxis
    rotation: RotaryAxis | None = None
    guide_y: LinearAxis | None = None
    guide_z: LinearAxis | None = None
    base_y: LinearAxis | None = None
    base_z: LinearAxis | None = None

    def items(self) -> Iterator[tuple[str, Axis]]:
        """Yield name and axis of each that the rig has."""
        for name in type(self).model_fields:
            if (axis := getattr(self, name)) is not None:
                yield name, axis

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(_axis_problems(self))
        return self


def _axis_problems(axes: Axes) -> Iterator[Problem]:
    channels: dict[str, str] = {}
    for name, axis in axes.items():
        if (other := channels.setdefault(axis.channel, name)) != name:
            yield Problem(f"{name}.channel", axis.channel, f"is that of {other}, too: each axis has its own")
        key = "range_deg" if isinstance(axis, RotaryAxis) else "range_mm"
        low, high = getattr(axis, key)
        if low >= high:
            yield Problem(f"{name}.{key}", [low, high], "must be [lowest, highest]")


class LoopSettings(Section):
    """Section `loop`: times of the supervisor and of the decisions."""

    rate_hz: Positive = 40.0
    """Rate at which tracker and motors are read and checked, and targets sent."""
    queue_ms: Annotated[float, Field(gt=0, le=100)] = 75.0
    """Motion that is queued in the motors: what they still do after the computer has stopped."""
    decision_ms: Positive = 200.0
    """Time for a decision. While it takes longer the needle rests, and the period counts as late."""
    decision_limit_s: Positive = 2.0
    """Time without a command after which the insertion is stopped: the controller does not answer."""


class RigFile(Section):
    """A rig, as its file describes it."""

    name: Title
    """Title in messages and records."""
    driver: Part
    axes: Axes
    tracker: Part
    registration: Registration | None = None
    """Map from the tracker's frame to that of the insertion; takes the place of the scenario's."""
    loop: LoopSettings = LoopSettings()
    ros: Part | None = None
    """What is published to ROS 2. Not set: nothing."""


def load_rig(path: str | Path) -> RigFile:
    """Return the rig of a shipped name or of a TOML file.

    Raises RigError with one line for each problem: file, key, value, rule.
    """
    return RIGS.load(path, RigFile)
