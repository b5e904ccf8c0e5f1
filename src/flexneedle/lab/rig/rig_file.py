"""Rig file: the motors, trackers and links of a laboratory.

A driver or tracker has further settings besides `kind`, and checks them itself.
"""

from collections.abc import Iterator, Mapping
from importlib.resources import files
from os import fspath
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, ConfigDict, Field, PrivateAttr, ValidationError, model_validator

from flexneedle.errors import RigError
from flexneedle.lab.rig.rig_axes import Axes, Axis
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, describe, refuse
from flexneedle.scenario.sections.fields import Positive, Section, Title, one_line
from flexneedle.scenario.sections.registration import Registration

RIGS = Library("a rig file", "rig", files(__package__) / "rigs", RigError)
"""The rigs that come with the package."""

Settings = TypeVar("Settings", bound=Section)

_FASTEST_HZ = 1000.0
_QUEUE_MS, _QUEUE_TICKS, _LONGEST_QUEUE_MS = 75.0, 3.0, 100.0
_SLOWEST_HZ = 1e3 / _LONGEST_QUEUE_MS
_LEAST_QUEUE = 2.0  # tolerances
_ROUNDING = 1e-9


class DeviceSection(Section):
    """Kind of a device and its settings, which the device checks."""

    model_config = ConfigDict(extra="allow")

    kind: Annotated[str, Field(max_length=200), AfterValidator(one_line)]
    """Name of an installed device, or `module:NAME` for your own."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings of the device by key."""
        return dict(self.model_extra or {})


class SensorSection(DeviceSection):
    """Sensor along the needle and its settings, which the device checks."""

    name: Title
    """Name of the sensor in the scenario: its `name`, or its `kind` without one."""


class LoopSettings(Section):
    """Section `loop`: timing of the supervisor and the decisions."""

    rate_hz: Annotated[float, Field(ge=_SLOWEST_HZ, le=_FASTEST_HZ)] = 40.0
    """Rate at which tracker and motors are read and checked and targets are sent."""
    queue_ms: Annotated[float, Field(gt=0, le=_LONGEST_QUEUE_MS)] | None = None
    """Time of the motion queued in the motors, which they complete if the computer fails. Not set: three ticks, 75 to
    100."""
    queue_mm: Positive = 0.5
    """Largest queued distance, for linear axes: a faster axis is slowed down. At least twice each tolerance."""
    decision_ms: Positive = 200.0
    """Time for a decision. Then the needle rests until the decision arrives, and the period counts as late."""
    decision_limit_s: Positive = 2.0
    """Time without a command after which the insertion is stopped."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(self._problems())
        return self

    def _problems(self) -> Iterator[Problem]:
        tick = 1e3 / self.rate_hz
        if self.queue_ms is not None and self.queue_ms < tick:
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
        """Return the largest distance (mm or rad) of an axis from its target, at this speed (mm/s or rad/s).

        It is at least two tolerances: a motor may rest one tolerance from its goal, and must still move on.
        """
        way = max(speed * self.queue, _LEAST_QUEUE * axis.tolerance)
        return min(way, self.queue_mm) if axis.unit == "mm" else way


class RosSettings(Section):
    """Section `ros`: topics that publish, arm and stop an insertion."""

    profile: Annotated[str, Field(max_length=1000), AfterValidator(one_line)] = "neutral"
    """Name or file of the profile."""
    arm: bool = False
    """Arm the rig only after a message on the arm topic, and stop if the ROS node is lost."""
    target: bool = False
    """Take the target from its topic, before planning."""


class RigFile(Section):
    """Description of a rig."""

    name: Title
    """Title in messages and records."""
    driver: DeviceSection
    axes: Axes
    tracker: DeviceSection
    sensor: Annotated[tuple[SensorSection, ...], Field(strict=False, max_length=100)] = ()
    """Devices of the sensors along the needle that the scenario has, one for each."""
    registration: Registration | None = None
    """Replaces the registration of the scenario."""
    loop: LoopSettings = LoopSettings()
    ros: RosSettings | None = None
    """Not set: no connection to ROS 2."""
    _source: str = PrivateAttr("RIG")

    @property
    def source(self) -> str:
        """Name or path of the rig for suggested commands, quoted for a shell; RIG for a rig without a file."""
        return self._source

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse((*_queue_problems(self), *_name_problems(self)))
        return self


def _name_problems(rig: RigFile) -> Iterator[Problem]:
    """Yield the problem of each name that an earlier sensor has."""
    names = [one.name for one in rig.sensor]
    for n, name in enumerate(names):
        if name in names[:n]:
            yield Problem(("sensor", n, "name"), name, "another sensor has this name")


def _queue_problems(rig: RigFile) -> Iterator[Problem]:
    """Yield the problem of a queue from which a motor may not move on."""
    linear = [(name, axis) for name, axis in rig.axes.items() if axis.unit == "mm"]
    name, axis = max(linear, key=lambda one: one[1].tolerance)
    least = _LEAST_QUEUE * axis.tolerance
    if rig.loop.queue_mm < least * (1.0 - _ROUNDING):
        rule = f"must be at least {axis.to_text(least)}, twice tolerance_mm of axes.{name}: a motor may rest one away"
        yield Problem("loop.queue_mm", rig.loop.queue_mm, rule)


def check_settings(model: type[Settings], settings: Mapping[str, Any]) -> Settings:
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
    rig = RIGS.load(path, RigFile)
    rig._source = quote(fspath(path))
    return rig
