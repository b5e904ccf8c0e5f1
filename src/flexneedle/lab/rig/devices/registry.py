"""Drivers and trackers of rig files: entry points by name, or `module:NAME`.

A factory makes a device from its settings in the rig file. It checks them, raises InputError (`key = value: rule`) for
invalid ones, and returns the device open and at rest. A package registers it under a name as an entry point:

    [project.entry-points."flexneedle.drivers"]
    stage = "mylab.stage:open_stage"
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

from flexneedle.errors import FlexneedleError, InputError, RigError, make_printable
from flexneedle.lab.rig.devices.answers import MOTORS, TRACKER
from flexneedle.lab.rig.devices.guarded import Guarded, errors_named
from flexneedle.lab.rig.rig_file import Part, RigFile
from flexneedle.ports import Clock, MotorPaces, Motors, Tracker
from flexneedle.scenario.own import a_kind_of, attribute, not_callable_with, resolved
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.axes import Axis
from flexneedle.types import Frame

DRIVERS, TRACKERS = "flexneedle.drivers", "flexneedle.trackers"
"""Groups of entry points."""

_SHOWN = 1e6  # digits of a limit in a message

MotorsFactory = Callable[[Mapping[str, Any], Sequence[str]], Motors]
"""Makes the motors of a driver from its settings and the channels of the rig's axes."""
TrackerFactory = Callable[[Mapping[str, Any], Clock], Tracker]
"""Makes a tracker from its settings and the clock of the run; it has `close`, or is a context manager."""


class OpenTracker(Tracker, Protocol):
    """A tracker, until it is closed."""

    def close(self) -> None:
        """Stop it."""
        ...


def open_motors(rig: RigFile) -> Motors:
    """Return the motors of a rig, connected, at rest.

    Raises RigError for an unknown driver, one that cannot be imported or lacks a part of the port, for settings that it
    refuses, and for speeds and accelerations that its controller does not take; DriverError if the controller cannot be
    reached, and for any other error of the driver, then and in each of its calls.
    """
    channels = tuple(axis.channel for _, axis in rig.axes.items())
    factory = _factory("driver", DRIVERS, rig.driver, ("settings", "channels"))
    name = _name("driver", rig.driver)
    with errors_named(name):
        made = _made("driver", rig.driver, lambda: factory(rig.driver.settings, channels))
        _check_parts("driver", rig.driver, made, parts_of(Motors))
    motors: Motors = Guarded(name, type(made).__name__, made, MOTORS)
    try:
        with errors_named(name):
            _check_paces(rig, getattr(motors, "paces", None))
    except FlexneedleError:
        motors.close()
        raise
    return motors


def address_of(part: Part, motors: Motors) -> str:
    """Return what names the motors on this machine: the `address` of a driver that has one, else kind and settings."""
    given: str = getattr(motors, "address", "")
    return given or f"{part.kind} {json.dumps(part.settings, sort_keys=True, default=str)}"


def _check_paces(rig: RigFile, paces: MotorPaces | None) -> None:
    if problems := [to_line(one) for one in _pace_problems(rig, paces)]:
        raise RigError(*problems)


def _pace_problems(rig: RigFile, paces: MotorPaces | None) -> Iterator[Problem]:
    """Speeds and accelerations that the controller would refuse at the first motion."""
    if paces is None:
        return
    for name, axis in rig.axes.items():
        for key, per, limits in (("speed", "s", paces.speeds), ("acceleration", "s2", paces.accelerations)):
            value = getattr(axis, key)
            if rule := _pace_rule(axis, value, limits, per.replace("2", "²")):
                yield Problem(f"axes.{name}.{key}_{axis.unit}_{per}", float(axis.shown(value)), rule)


def _pace_rule(axis: Axis, value: float, limits: tuple[float, float], per: str) -> str:
    """The rule that a speed or an acceleration (mm or rad, and s) breaks, or "". limits: in counts."""
    (least, most), counts = limits, abs(axis.scale)
    file = _SHOWN / (counts * axis.size)
    if value * counts < least:
        limit = math.ceil(least * file) / _SHOWN  # so that the value in the message is taken
        return f"must be at least {limit:.12g}: the controller takes {least:.12g} counts/{per} and more"
    if value * counts > most:
        limit = math.floor(most * file) / _SHOWN
        return f"must be at most {limit:.12g}: the controller takes {most:.12g} counts/{per} and less"
    return ""


def open_tracker(rig: RigFile, clock: Clock) -> OpenTracker:
    """Return the tracker of a rig, started; `close` stops it. clock: of the run; frames have its times.

    Raises RigError as `open_motors`, RunError if the tracker does not respond, DriverError for any other error of it.
    """
    factory = _factory("tracker", TRACKERS, rig.tracker, ("settings", "clock"))
    name = _name("tracker", rig.tracker)
    with errors_named(name):
        made = _made("tracker", rig.tracker, lambda: factory(rig.tracker.settings, clock))
        opened = _closable(rig.tracker, made)
    owner = type(opened.tracker if isinstance(opened, _Entered) else opened).__name__
    tracker: OpenTracker = Guarded(name, owner, opened, TRACKER)
    return tracker


def _closable(part: Part, made: Any) -> OpenTracker:
    """The tracker, or the one that a context manager gives. Raises RigError if it is none, or cannot be closed."""
    if hasattr(made, "close"):
        _check_parts("tracker", part, made, parts_of(Tracker))
        tracker: OpenTracker = made
        return tracker
    if not isinstance(made, AbstractContextManager):
        rule = f"made {a_kind_of(made)} that cannot be closed: it needs close(), or to be a context manager"
        raise _error("tracker", part, rule)
    return _entered(part, made)


def installed(group: str) -> tuple[str, ...]:
    """Return the names of the installed drivers or trackers."""
    return tuple(sorted(entry_points(group=group).names))


def parts_of(port: type) -> tuple[str, ...]:
    """Return the names of the methods and attributes that a port has."""
    return tuple(name for name in vars(port) if not name.startswith("_"))


@dataclass(frozen=True)
class _Entered:
    """A tracker that a context manager gives."""

    tracker: Tracker
    manager: AbstractContextManager[Tracker]

    def read(self) -> tuple[Frame, ...]:
        return self.tracker.read()

    @property
    def status(self) -> str:
        return self.tracker.status

    def close(self) -> None:
        self.manager.__exit__(None, None, None)


def _entered(part: Part, manager: AbstractContextManager[Tracker]) -> _Entered:
    tracker = _made("tracker", part, manager.__enter__)
    try:
        _check_parts("tracker", part, tracker, parts_of(Tracker))
    except RigError:
        manager.__exit__(None, None, None)
        raise
    return _Entered(tracker, manager)


def _factory(section: str, group: str, part: Part, arguments: tuple[str, ...]) -> Callable[..., Any]:
    try:
        found = _found(group, part.kind)
        if rule := not_callable_with(found, arguments):
            raise InputError(rule)
    except InputError as error:
        raise RigError(make_printable(f'{section}.kind = "{part.kind}": {error}')) from error
    factory: Callable[..., Any] = found
    return factory


def _found(group: str, kind: str) -> Any:
    """The object of a name or of `module:NAME`. Raises InputError with the rule that is broken."""
    points = {point.value: point for point in entry_points(group=group, name=kind)}
    if len(points) > 1:
        raise InputError(f"several packages have one of this name: {'; '.join(_origins(points.values()))}")
    if not points:
        return resolved(kind, installed(group) or ("(none is installed)",))
    (point,) = points.values()
    try:
        return attribute(point.module, point.attr)
    except InputError as error:
        raise InputError(f"{error} (entry point of {_package(point)})") from error


def _origins(points: Iterable[EntryPoint]) -> Iterator[str]:
    for point in points:
        yield f"{_package(point)} ({point.value})"


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown package"


def _made(section: str, part: Part, make: Callable[[], Any]) -> Any:
    """What a factory makes. Raises RigError with the section and kind before each line of its InputError."""
    try:
        return make()
    except InputError as error:
        raise RigError(*(f"{_name(section, part)}: {line}" for line in str(error).splitlines())) from error


def _name(section: str, part: Part) -> str:
    return make_printable(f"{section} {part.kind}")


def _check_parts(section: str, part: Part, made: object, wanted: Sequence[str]) -> None:
    missing = [name for name in wanted if not hasattr(made, name)]
    if missing:
        if hasattr(made, "close"):
            made.close()
        raise _error(section, part, f"made {a_kind_of(made)} without {', '.join(missing)}")


def _error(section: str, part: Part, rule: str) -> RigError:
    return RigError(make_printable(f'{section}.kind = "{part.kind}": {rule}'))
