"""The rig file: the motors, trackers and links of a laboratory, and how axes of the needle map to motors.

Lengths are in mm, angles in degrees; counts are those of the motor's encoder. A driver or tracker has settings of its
own beside `kind`, which it checks itself.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from importlib.resources import files
from math import radians
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from flexneedle.errors import RigError
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, describe, refuse
from flexneedle.scenario.sections.fields import LARGEST, NonNegative, Positive, Section, Title, one_line
from flexneedle.scenario.sections.registration import Registration

RIGS = Library("a rig file", "rig", files(__package__) / "rigs", RigError)
"""The rigs that come with the package."""

LINEAR_AXES = ("insertion", "guide_y", "guide_z", "base_y", "base_z")
"""Axes with a length: advance of the base, lateral offsets of guide and base."""

Settings = TypeVar("Settings", bound=Section)

_FASTEST_HZ = 1000.0
_QUEUE_MS, _QUEUE_TICKS, _LONGEST_QUEUE_MS = 75.0, 3.0, 100.0
_LEAST_QUEUE = 2.0  # tolerances
_TOLERATED_COUNTS = 3.0
_LAG_S = 0.04  # of an axis at its largest speed: several times that of a healthy servo
_TOLERANCES = 4.0  # that the largest error has at least
_ROUNDING = 1e-9
_SWITCH = "the {} switch is at the {} end of range_{}, or beyond"


def _whole(value: object) -> object:
    if isinstance(value, bool):  # equal to 1, but not what was meant by a direction
        raise ValueError("must be one of -1, 1")
    return value


Channel = Annotated[str, Field(max_length=40), AfterValidator(one_line)]
Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Range = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
Home = Literal["here", "reverse-limit", "forward-limit", "absolute"]


class Part(Section):
    """A kind, and settings of its own, which are checked where it is made."""

    model_config = ConfigDict(extra="allow")

    kind: Annotated[str, Field(max_length=200), AfterValidator(one_line)]
    """Name of one that is installed, or `module:NAME` for your own."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Its own settings by key."""
        return dict(self.model_extra or {})


class Axis(Section, ABC):
    """An axis and its motor. `scale`, `limits` and the other properties are in counts, mm or rad, and s.

    unit: of the file, "mm" or "deg"; size: of that unit in mm or rad; usual_error and usual_tolerances: if the file has
    none, the largest error at most, and the tolerance at least and at most, in that unit.
    """

    unit: ClassVar[str]
    size: ClassVar[float]
    usual_error: ClassVar[float]
    usual_tolerances: ClassVar[tuple[float, float]]

    channel: Channel
    """The motor's name at its controller, such as "A"."""
    direction: Annotated[Literal[-1, 1], BeforeValidator(_whole)] = 1
    """1 if counts increase with the axis's positive direction, else −1."""
    home: Home = "here"
    """How `rig home` finds the zero: where the axis is, at a limit switch of the controller, or never (an absolute
    encoder)."""

    @property
    @abstractmethod
    def scale(self) -> float:
        """Signed counts per mm or rad."""

    @property
    @abstractmethod
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position, mm or rad."""

    @property
    @abstractmethod
    def speed(self) -> float:
        """Largest speed, mm/s or rad/s."""

    @property
    @abstractmethod
    def acceleration(self) -> float:
        """Acceleration, mm/s² or rad/s²."""

    @property
    @abstractmethod
    def at_home(self) -> float:
        """Position of the axis at its home, mm or rad."""

    @property
    @abstractmethod
    def backlash(self) -> float:
        """Lost motion on reversal, mm or rad."""

    @property
    @abstractmethod
    def _errors(self) -> tuple[float | None, float | None]:
        """The largest error and the tolerance of the file, in its unit; None: not set."""

    @property
    def tolerance(self) -> float:
        """Largest distance from the goal of a motion that has ended, mm or rad."""
        return self._usual_tolerance if self._errors[1] is None else self.size * self._errors[1]

    @property
    def max_error(self) -> float:
        """Largest difference of commanded and measured position, mm or rad."""
        if self._errors[0] is not None:
            return self.size * self._errors[0]
        usual = min(self.size * self.usual_error, _LAG_S * self.speed)
        return max(usual, _TOLERANCES * self._usual_tolerance)

    @property
    def _usual_tolerance(self) -> float:
        # At most: a "count" of a joint in m or rad is no step of an encoder.
        least, most = self.usual_tolerances
        return min(max(self.size * least, _TOLERATED_COUNTS / abs(self.scale)), self.size * most)

    @property
    def to_home(self) -> int:
        """Direction in which the axis moves to the limit switch of its home, 1 or −1; 0 without one."""
        return self.direction * {"forward-limit": 1, "reverse-limit": -1}.get(self.home, 0)

    def shown(self, value: float) -> str:
        """A position, distance or speed (mm or rad, and s) as a number in the unit of the file, such as "12.5"."""
        return f"{round(value / self.size, 6) + 0.0:.7g}"  # not -0

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(_problems_of(self))
        return self


class LinearAxis(Axis):
    """Section `axes.insertion`: an axis with a length, as those of guide and base."""

    unit = "mm"
    size = 1.0
    usual_error = 0.2
    usual_tolerances = (0.02, 0.1)

    counts_per_mm: Positive
    """Counts of the encoder per mm."""
    range_mm: Range
    """Soft limits [lowest, highest]: no command goes beyond."""
    speed_mm_s: Positive
    """Largest speed."""
    acceleration_mm_s2: Positive
    """Acceleration and deceleration."""
    home_mm: Coordinate = 0.0
    """Position of the axis at its home."""
    backlash_mm: NonNegative = 0.0
    """Lost motion when the motor reverses. Each command makes up for it from the end of its first motion on; until then
    the position is uncertain by half of it."""
    max_error_mm: Positive | None = None
    """Largest difference of commanded and measured position; beyond it the rig stops with a fault. Not set: the way of
    40 ms at `speed_mm_s`, at most 0.2 mm, at least four times the usual tolerance."""
    tolerance_mm: Positive | None = None
    """A motion has arrived within this distance from its goal. Not set: 3 counts, 0.02 to 0.1 mm."""

    @property
    def scale(self) -> float:
        """Signed counts per mm."""
        return self.direction * self.counts_per_mm

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position, mm."""
        return self.range_mm

    @property
    def speed(self) -> float:
        """Largest speed, mm/s."""
        return self.speed_mm_s

    @property
    def acceleration(self) -> float:
        """Acceleration, mm/s²."""
        return self.acceleration_mm_s2

    @property
    def at_home(self) -> float:
        """Position of the axis at its home, mm."""
        return self.home_mm

    @property
    def backlash(self) -> float:
        """Lost motion on reversal, mm."""
        return self.backlash_mm

    @property
    def _errors(self) -> tuple[float | None, float | None]:
        return self.max_error_mm, self.tolerance_mm


class RotaryAxis(Axis):
    """Section `axes.rotation`: the roll of the needle about its axis."""

    unit = "deg"
    size = radians(1.0)
    usual_error = 5.0
    usual_tolerances = (1.0, 2.0)

    counts_per_deg: Positive
    """Counts of the encoder per degree."""
    range_deg: Range
    """Soft limits [lowest, highest]: no command goes beyond."""
    speed_deg_s: Positive
    """Largest speed."""
    acceleration_deg_s2: Positive
    """Acceleration and deceleration."""
    home_deg: Coordinate = 0.0
    """Angle of the axis at its home."""
    backlash_deg: NonNegative = 0.0
    """Lost motion when the motor reverses. Each command makes up for it from the end of its first motion on; until then
    the angle is uncertain by half of it."""
    max_error_deg: Positive | None = None
    """Largest difference of commanded and measured angle; beyond it the rig stops with a fault. Not set: the angle of
    40 ms at `speed_deg_s`, at most 5°, at least four times the usual tolerance."""
    tolerance_deg: Positive | None = None
    """A roll has arrived within this angle from its goal. Not set: 3 counts, 1° to 2°."""

    @property
    def scale(self) -> float:
        """Signed counts per rad."""
        return self.direction * self.counts_per_deg / self.size

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest angle, rad."""
        low, high = self.range_deg
        return radians(low), radians(high)

    @property
    def speed(self) -> float:
        """Largest speed, rad/s."""
        return radians(self.speed_deg_s)

    @property
    def acceleration(self) -> float:
        """Acceleration, rad/s²."""
        return radians(self.acceleration_deg_s2)

    @property
    def at_home(self) -> float:
        """Angle of the axis at its home, rad."""
        return radians(self.home_deg)

    @property
    def backlash(self) -> float:
        """Lost motion on reversal, rad."""
        return radians(self.backlash_deg)

    @property
    def _errors(self) -> tuple[float | None, float | None]:
        return self.max_error_deg, self.tolerance_deg


def _problems_of(axis: Axis) -> Iterator[Problem]:
    """The rules between the keys of an axis. Keys end in the axis's unit."""
    unit, shown, (low, high) = axis.unit, axis.shown, axis.limits
    limits = [float(shown(low)), float(shown(high))]
    if low >= high:
        yield Problem(f"range_{unit}", limits, "must be [lowest, highest]")
        return
    if (rule := _misplaced(axis, low, high)) and axis.home != "absolute":
        yield Problem(f"home_{unit}", float(shown(axis.at_home)), rule)
    if axis.backlash >= high - low:
        rule = f"must be below {shown(high - low)}, the width of range_{unit}"
        yield Problem(f"backlash_{unit}", float(shown(axis.backlash)), rule)
    if axis.tolerance >= axis.max_error:
        rule = f"must be below max_error_{unit} ({shown(axis.max_error)})"
        yield Problem(f"tolerance_{unit}", float(shown(axis.tolerance)), rule)


def _misplaced(axis: Axis, low: float, high: float) -> str:
    """The rule that the home of an axis breaks, or "". A limit switch is not between the soft limits."""
    home, end = axis.at_home, axis.to_home
    if end == 0 and not low - _ROUNDING <= home <= high + _ROUNDING:
        return f"must be within range_{axis.unit}, {axis.shown(low)} to {axis.shown(high)}"
    if end < 0 and home > low + _ROUNDING:
        return f"must be at most {axis.shown(low)}: {_SWITCH.format(axis.home, 'low', axis.unit)}"
    if end > 0 and home < high - _ROUNDING:
        return f"must be at least {axis.shown(high)}: {_SWITCH.format(axis.home, 'high', axis.unit)}"
    return ""


class Axes(Section):
    """Section `axes`: the axes that the rig has. All but `insertion` may be left out."""

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
        refuse(_shared_channels(self))
        return self


def _shared_channels(axes: Axes) -> Iterator[Problem]:
    channels: dict[str, str] = {}
    for name, axis in axes.items():
        if (other := channels.setdefault(axis.channel, name)) != name:
            yield Problem(f"{name}.channel", axis.channel, f"is that of {other}, too: each axis has its own")


class LoopSettings(Section):
    """Section `loop`: times of the supervisor and of the decisions."""

    rate_hz: Annotated[float, Field(gt=0, le=_FASTEST_HZ)] = 40.0
    """Rate at which tracker and motors are read and checked, and targets sent."""
    queue_ms: Annotated[float, Field(gt=0, le=_LONGEST_QUEUE_MS)] | None = None
    """Time of the motion that is queued in the motors: what they still do after the computer has stopped. Not set:
    three ticks, at least 75 and at most 100."""
    queue_mm: Positive = 0.5
    """Largest distance of that motion, for axes with a length. A faster axis is slowed down."""
    decision_ms: Positive = 200.0
    """Time for a decision. While it takes longer the needle rests, and the period counts as late."""
    decision_limit_s: Positive = 2.0
    """Time without a command after which the insertion is stopped: the controller does not answer."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(self._problems())
        return self

    def _problems(self) -> Iterator[Problem]:
        tick = 1e3 / self.rate_hz
        if tick > _LONGEST_QUEUE_MS:
            rule = f"must be at least {1e3 / _LONGEST_QUEUE_MS:g}: motors would stop between two ticks"
            yield Problem("rate_hz", self.rate_hz, rule)
        elif self.queue_ms is not None and self.queue_ms < tick:
            rule = f"must be at least {tick:g}, the time of a tick at rate_hz ({self.rate_hz:g})"
            yield Problem("queue_ms", self.queue_ms, f"{rule}: motors would stop between two ticks")
        if 1e3 * self.decision_limit_s <= self.decision_ms:
            rule = f"must be above decision_ms ({self.decision_ms:g} ms)"
            yield Problem("decision_limit_s", self.decision_limit_s, rule)

    @property
    def queue(self) -> float:
        """Time of the motion that is queued in the motors, s."""
        ticks = max(_QUEUE_MS, 1e3 * _QUEUE_TICKS / self.rate_hz)
        return 1e-3 * (min(ticks, _LONGEST_QUEUE_MS) if self.queue_ms is None else self.queue_ms)

    def queue_of(self, axis: Axis, speed: float) -> float:
        """Largest distance (mm or rad) of an axis from its target, in a motion with this speed (mm/s or rad/s).

        It is at least two tolerances: a motor may rest within one, and shall move on.
        """
        way = max(speed * self.queue, _LEAST_QUEUE * axis.tolerance)
        return min(way, self.queue_mm) if axis.unit == "mm" else way


class RosSettings(Section):
    """Section `ros`: the topics by which an insertion is followed and stopped."""

    profile: Annotated[str, Field(max_length=1000), AfterValidator(one_line)] = "neutral"
    """Name or file of the profile of topics."""
    arm: bool = False
    """Whether the rig is armed only after an arm on its topic, and stopped if the ROS node is lost."""
    target: bool = False
    """Whether the target is taken from its topic, before planning."""


class RigFile(Section):
    """A rig, as its file describes it."""

    name: Title
    """Title in messages and records."""
    driver: Part
    axes: Axes
    tracker: Part
    registration: Registration | None = None
    """In place of the scenario's, where it is set."""
    loop: LoopSettings = LoopSettings()
    ros: RosSettings | None = None
    """Connection to ROS 2. Not set: none."""


def settings_of(model: type[Settings], settings: Mapping[str, Any]) -> Settings:
    """Return the settings of a driver or tracker, checked.

    Raises RigError with one line `key = value: rule` for each problem.
    """
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        raise RigError(*describe(error, model)) from None


def load_rig(path: str | Path) -> RigFile:
    """Return the rig of a shipped name or of a TOML file.

    Raises RigError with one line for each problem: file, key, value, rule.
    """
    return RIGS.load(path, RigFile)
