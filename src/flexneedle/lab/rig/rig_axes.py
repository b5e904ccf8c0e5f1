"""Axes of a rig: map from lengths and angles of the needle to motors, with limits and tolerances.

Lengths are in mm, angles in degrees; counts are the encoder counts of the motor.
"""

from collections.abc import Iterator
from math import radians
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import LARGEST, NonNegative, Positive, Section, one_line

LINEAR_AXES = ("insertion", "guide_y", "guide_z", "base_y", "base_z")
"""Axes with a length: advance of the base, lateral offsets of guide and base."""

_TOLERATED_COUNTS = 3.0
_LAG_S = 0.04  # of an axis at its largest speed: several times the lag of a healthy servo
_TOLERANCES = 4.0  # that the largest error has at least
_ROUNDING = 1e-9
_SWITCH = "the {} switch is at the {} end of range_{}, or beyond"


def _whole(value: object) -> object:
    if isinstance(value, bool):  # equal to 1, but no direction
        raise ValueError("must be one of -1, 1")
    return value


Channel = Annotated[str, Field(max_length=40), AfterValidator(one_line)]
Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Range = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
Home = Literal["here", "reverse-limit", "forward-limit", "absolute"]


class Axis(Section):
    """An axis and its motor. `scale`, `limits` and the other properties are in counts, mm or rad, and s.

    unit: of the file, "mm" or "deg"; size: of that unit in mm or rad; usual_error and usual_tolerances: if the file has
    none, the largest error at most, and the tolerance at least and at most, in that unit.
    """

    unit: ClassVar[str]
    size: ClassVar[float]
    usual_error: ClassVar[float]
    usual_tolerances: ClassVar[tuple[float, float]]

    channel: Channel
    """Name of the motor at its controller."""
    direction: Annotated[Literal[-1, 1], BeforeValidator(_whole)] = 1
    """1 if counts increase in the positive direction of the axis, else −1."""
    home: Home = "here"
    """Home for `rig home`: the present position, a limit switch, or none (absolute encoder)."""

    @property
    def scale(self) -> float:
        """Signed counts per mm or rad."""
        return self.direction * self._setting("counts_per_{}") / self.size

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position, mm or rad."""
        low, high = getattr(self, f"range_{self.unit}")
        return self.size * low, self.size * high

    @property
    def speed(self) -> float:
        """Largest speed, mm/s or rad/s."""
        return self.size * self._setting("speed_{}_s")

    @property
    def acceleration(self) -> float:
        """Acceleration, mm/s² or rad/s²."""
        return self.size * self._setting("acceleration_{}_s2")

    @property
    def at_home(self) -> float:
        """Position of the axis at its home, mm or rad."""
        return self.size * self._setting("home_{}")

    @property
    def backlash(self) -> float:
        """Lost motion on reversal, mm or rad."""
        return self.size * self._setting("backlash_{}")

    def _setting(self, key: str) -> float:
        """Return a setting in the unit of the file; 0 if it is not set."""
        return float(getattr(self, key.format(self.unit)) or 0.0)

    @property
    def tolerance(self) -> float:
        """Largest distance from the goal of a motion that has ended, mm or rad."""
        return self.size * self._setting("tolerance_{}") or self._usual_tolerance

    @property
    def uncertainty(self) -> float:
        """Largest distance (mm or rad) of a motor at rest from its goal.

        The tolerance, and half of the lost motion, whose side is unknown before the first motion.
        """
        return self.tolerance + 0.5 * self.backlash

    @property
    def max_error(self) -> float:
        """Largest difference between commanded and measured position, mm or rad."""
        usual = min(self.size * self.usual_error, _LAG_S * self.speed)
        return self.size * self._setting("max_error_{}") or max(usual, _TOLERANCES * self._usual_tolerance)

    @property
    def _usual_tolerance(self) -> float:
        # At most: a "count" of a joint in m or rad is no step of an encoder.
        least, most = self.usual_tolerances
        return min(max(self.size * least, _TOLERATED_COUNTS / abs(self.scale)), self.size * most)

    @property
    def to_home(self) -> int:
        """Direction in which the axis moves to the limit switch of its home, 1 or −1; 0 without one."""
        return self.direction * {"forward-limit": 1, "reverse-limit": -1}.get(self.home, 0)

    def to_text(self, value: float) -> str:
        """Return a position, distance or speed (mm or rad, and s) as text in the unit of the file, such as "12.5"."""
        return f"{round(value / self.size, 6) + 0.0:.7g}"  # not -0

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(_problems_of(self))
        return self


class LinearAxis(Axis):
    """Section `axes.insertion`: a linear axis."""

    unit = "mm"
    size = 1.0
    usual_error = 0.2
    usual_tolerances = (0.02, 0.1)

    counts_per_mm: Positive
    """Counts of the encoder per mm."""
    range_mm: Range
    """Soft limits [lowest, highest] of all commands."""
    speed_mm_s: Positive
    """Largest speed."""
    acceleration_mm_s2: Positive
    """Acceleration and deceleration."""
    home_mm: Coordinate = 0.0
    """Position of the axis at its home."""
    backlash_mm: NonNegative = 0.0
    """Lost motion when the motor reverses."""
    max_error_mm: Positive | None = None
    """Largest difference between commanded and measured position; a larger one is a fault. Not set: the distance of 40
    ms at `speed_mm_s`, at most 0.2 mm, at least four default tolerances."""
    tolerance_mm: Positive | None = None
    """Distance from the goal within which a motion has arrived. Not set: 3 counts, 0.02 to 0.1 mm."""


class RotaryAxis(Axis):
    """Section `axes.rotation`: the roll of the needle about its axis."""

    unit = "deg"
    size = radians(1.0)
    usual_error = 5.0
    usual_tolerances = (1.0, 2.0)

    counts_per_deg: Positive
    """Counts of the encoder per degree."""
    range_deg: Range
    """Soft limits [lowest, highest] of all commands."""
    speed_deg_s: Positive
    """Largest speed."""
    acceleration_deg_s2: Positive
    """Acceleration and deceleration."""
    home_deg: Coordinate = 0.0
    """Angle of the axis at its home."""
    backlash_deg: NonNegative = 0.0
    """Lost motion when the motor reverses."""
    max_error_deg: Positive | None = None
    """Largest difference between commanded and measured angle; a larger one is a fault. Not set: the angle of 40 ms at
    `speed_deg_s`, at most 5°, at least four default tolerances."""
    tolerance_deg: Positive | None = None
    """Angle from the goal within which a roll has arrived. Not set: 3 counts, 1° to 2°."""


def _problems_of(axis: Axis) -> Iterator[Problem]:
    """Yield broken rules between the keys of an axis. Keys end in the axis's unit."""
    unit, shown, (low, high) = axis.unit, axis.to_text, axis.limits
    limits = [float(shown(low)), float(shown(high))]
    if low >= high:
        yield Problem(f"range_{unit}", limits, "must be [lowest, highest]")
        return
    if (rule := _find_home_problem(axis, low, high)) and axis.home != "absolute":
        yield Problem(f"home_{unit}", float(shown(axis.at_home)), rule)
    if axis.backlash >= high - low:
        rule = f"must be below {shown(high - low)}, the width of range_{unit}"
        yield Problem(f"backlash_{unit}", float(shown(axis.backlash)), rule)
    if axis.tolerance >= axis.max_error:
        rule = f"must be below max_error_{unit} ({shown(axis.max_error)})"
        yield Problem(f"tolerance_{unit}", float(shown(axis.tolerance)), rule)


def _find_home_problem(axis: Axis, low: float, high: float) -> str:
    """Return the rule that the home of an axis breaks, or "". A limit switch is not between the soft limits."""
    home, end = axis.at_home, axis.to_home
    if end == 0 and not low - _ROUNDING <= home <= high + _ROUNDING:
        return f"must be within range_{axis.unit}, {axis.to_text(low)} to {axis.to_text(high)}"
    if end < 0 and home > low + _ROUNDING:
        return f"must be at most {axis.to_text(low)}: {_SWITCH.format(axis.home, 'low', axis.unit)}"
    if end > 0 and home < high - _ROUNDING:
        return f"must be at least {axis.to_text(high)}: {_SWITCH.format(axis.home, 'high', axis.unit)}"
    return ""


class Axes(Section):
    """Section `axes`: the axes of the rig. Only `insertion` is required."""

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
            yield Problem(
                f"{name}.channel",
                axis.channel,
                f"is also the channel of {other}: give each axis its own",
            )
