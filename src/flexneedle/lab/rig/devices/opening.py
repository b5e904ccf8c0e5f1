"""Open the driver, the tracker and the sensors of a rig file, and check their calls.

A factory makes a device from its settings in the rig file. It raises InputError (`key = value: rule`) for invalid
settings, and returns the device open and at rest. A package registers a factory as an entry point:

    [project.entry-points."flexneedle.drivers"]
    stage = "mylab.stage:open_stage"
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, fields
from functools import partial
from importlib.metadata import entry_points
from inspect import signature
from math import hypot
from numbers import Real
from typing import Any, Protocol

import numpy as np

from flexneedle.arguments import shorten
from flexneedle.errors import DriverError, FlexneedleError, InputError, RigError, make_printable, one_line
from flexneedle.lab.rig.preflight.speeds import pace_problems
from flexneedle.lab.rig.rig_file import DeviceSection, RigFile, SensorSection
from flexneedle.plugins import (
    convert_exceptions,
    function_rule,
    load_part,
    missing_parts,
    name_kind,
    parts_of,
)
from flexneedle.ports import Clock, Motors, MotorSetup, MotorState, NeedleSensor, Tracker
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import Frame, Point, Quaternion, Reading, SensorReading

DRIVERS, TRACKERS, SENSORS = "flexneedle.drivers", "flexneedle.trackers", "flexneedle.sensors"
"""Groups of entry points."""

MotorsFactory = Callable[[Mapping[str, Any], Sequence[str]], Motors]
"""Makes the motors of a driver from its settings and the channels of the rig's axes."""
TrackerFactory = Callable[[Mapping[str, Any], Clock], Tracker]
"""Makes a tracker from its settings and the clock of the run; it has `close`, or is a context manager."""
SensorFactory = Callable[[Mapping[str, Any], Clock, Sensor], NeedleSensor]
"""Makes a sensor along the needle from its settings, the clock of the run and the scenario's sensor; as a tracker.

It may have a fourth parameter `scenario`, with a default.
"""

Rule = Callable[[Any], str]
"""Returns the rule that a value breaks, or ""."""

_NONE = object()
_UNIT = 0.01  # tolerance of the length of a quaternion; one with NaN is left to the monitor


class OpenTracker(Tracker, Protocol):
    """A tracker that has to be closed."""

    def close(self) -> None:
        """Stop tracking and release the device."""
        ...


class OpenNeedleSensor(NeedleSensor, Protocol):
    """A sensor along the needle that has to be closed."""

    def close(self) -> None:
        """Stop measuring and release the device."""
        ...


def read_positions(rig: RigFile) -> dict[str, float]:
    """Return the positions of the axes (mm or rad).

    Raises DriverError if the driver lacks a channel, or cannot be read.
    """
    with closing(open_motors(rig)) as motors:
        states = motors.read()
    missing = [axis.channel for _, axis in rig.axes.items() if axis.channel not in states]
    if missing:
        raise DriverError(
            f"the driver has no channel {', '.join(missing)}; it has {', '.join(states) or 'none'}"
        )
    return {name: states[axis.channel].position / axis.scale for name, axis in rig.axes.items()}


def open_motors(rig: RigFile) -> Motors:
    """Return the motors of a rig, connected and at rest.

    Raises:
        RigError: The driver is unknown, cannot be imported, lacks a part of the port, or refuses its settings; or the
            controller does not take a speed or an acceleration of the rig file.
        DriverError: The controller cannot be reached, or the driver fails in any other way, now or in a later call.
    """
    channels = tuple(axis.channel for _, axis in rig.axes.items())
    factory = _load_factory("driver", DRIVERS, rig.driver, ("settings", "channels"))
    name = _label("driver", rig.driver)
    with convert_exceptions(name):
        made = _call_factory("driver", rig.driver, lambda: factory(rig.driver.settings, channels))
        _check_parts("driver", rig.driver, made, parts_of(Motors))
    motors: Motors = GuardedDevice(name, type(made).__name__, made, _MOTORS)
    try:
        with convert_exceptions(name):
            if problems := pace_problems(rig, getattr(motors, "paces", None)):
                raise RigError(*problems)
    except FlexneedleError:
        motors.close()
        raise
    return motors


def open_tracker(rig: RigFile, clock: Clock) -> OpenTracker:
    """Return the tracker of a rig, started; `close` stops it.

    Args:
        rig: The rig file.
        clock: The clock of the run, on which frames have their times.

    Raises:
        RigError: As in `open_motors`.
        RunError: The tracker does not respond.
        DriverError: The tracker fails in any other way, now or in a later call.
    """
    factory = _load_factory("tracker", TRACKERS, rig.tracker, ("settings", "clock"))
    name = _label("tracker", rig.tracker)
    with convert_exceptions(name):
        made = _call_factory("tracker", rig.tracker, lambda: factory(rig.tracker.settings, clock))
        tracker: OpenTracker = _guard("tracker", rig.tracker, made, parts_of(Tracker), _TRACKER)
    return tracker


@contextmanager
def open_sensors(
    parts: Sequence[SensorSection], scenario: Scenario, clock: Clock
) -> Iterator[dict[str, OpenNeedleSensor]]:
    """Open sensors of a rig file, each of which the scenario has (`fit_problems`), and yield them by name.

    Their readings have times on `clock`. Raises as `open_tracker`.
    """
    wanted = {one.title: one for one in scenario.sensor}
    with ExitStack() as stack:
        yield {
            one.name: stack.enter_context(closing(open_sensor(one, wanted[one.name], clock, scenario)))
            for one in parts
        }


def open_sensor(part: SensorSection, sensor: Sensor, clock: Clock, scenario: Scenario) -> OpenNeedleSensor:
    """Return a sensor along the needle, started; `close` stops it. Raises as `open_tracker`."""
    section = f"sensor {part.name}"
    factory = _load_factory(section, SENSORS, part, ("settings", "clock", "sensor"))
    further = {"scenario": scenario} if "scenario" in signature(factory).parameters else {}
    with convert_exceptions(_label(section, part)):
        made = _call_factory(section, part, lambda: factory(part.settings, clock, sensor, **further))
        opened: OpenNeedleSensor = _guard(section, part, made, parts_of(NeedleSensor), _SENSOR)
    return opened


def address_of(part: DeviceSection, motors: Motors) -> str:
    """Return a name of the motors on this machine: the driver's `address`, else its kind and settings."""
    given: str = getattr(motors, "address", "")
    return given or f"{part.kind} {json.dumps(part.settings, sort_keys=True, default=str)}"


def _load_factory(
    section: str, group: str, part: DeviceSection, arguments: tuple[str, ...]
) -> Callable[..., Any]:
    try:
        names = sorted(entry_points(group=group).names)
        found: Callable[..., Any] = load_part(part.kind, names or ("(none is installed)",), group)
        problem = function_rule(found, *arguments)
    except InputError as error:
        raise _refusal(section, part, str(error)) from error
    if problem:
        raise _refusal(section, part, problem)
    return found


def _call_factory(section: str, part: DeviceSection, make: Callable[[], Any]) -> Any:
    """Return the device of a factory. Raises RigError with section and kind before each line of its InputError."""
    try:
        return make()
    except InputError as error:
        raise RigError(*(f"{_label(section, part)}: {line}" for line in str(error).splitlines())) from error


def _check_parts(section: str, part: DeviceSection, made: object, wanted: Sequence[str]) -> None:
    if missing := missing_parts(made, wanted):
        if hasattr(made, "close"):
            made.close()
        raise _refusal(section, part, f"made {name_kind(made)} without {missing}")


def _label(section: str, part: DeviceSection) -> str:
    return make_printable(f"{section} {part.kind}")


def _refusal(section: str, part: DeviceSection, rule: str) -> RigError:
    return RigError(make_printable(f'{section}.kind = "{part.kind}": {rule}'))


@dataclass(frozen=True)
class _Entered:
    """A tracker or sensor that was entered as a context manager."""

    device: Any
    manager: AbstractContextManager[Any]

    def read(self) -> Any:
        return self.device.read()

    @property
    def status(self) -> str:
        status: str = self.device.status
        return status

    def close(self) -> None:
        self.manager.__exit__(None, None, None)


def _guard(
    section: str, part: DeviceSection, made: Any, parts: Sequence[str], rules: Mapping[str, Rule]
) -> Any:
    """Return a tracker or sensor with `close`, guarded. Raises RigError if it lacks a part."""
    opened = _with_close(section, part, made, parts)
    owner = type(opened.device if isinstance(opened, _Entered) else opened).__name__
    return GuardedDevice(_label(section, part), owner, opened, rules)


def _with_close(section: str, part: DeviceSection, made: Any, parts: Sequence[str]) -> Any:
    """Return a device with `close`, of a device or a context manager. Raises RigError for anything else."""
    if hasattr(made, "close"):
        _check_parts(section, part, made, parts)
        return made
    if not isinstance(made, AbstractContextManager):
        rule = f"made {name_kind(made)} that cannot be closed: it needs close(), or to be a context manager"
        raise _refusal(section, part, rule)
    entered = _call_factory(section, part, made.__enter__)
    try:
        _check_parts(section, part, entered, parts)
    except RigError:
        made.__exit__(None, None, None)
        raise
    return _Entered(entered, made)


class GuardedDevice:
    """A device whose failures are all DriverErrors, and whose results are checked.

    Args:
        name: The name of the device, for messages.
        owner: The name of its class, for messages.
        device: The device of a user.
        rules: The rule of each text attribute and of the result of each method.
    """

    def __init__(self, name: str, owner: str, device: Any, rules: Mapping[str, Rule]) -> None:
        self._name, self._owner, self._device, self._rules = name, owner, device, rules

    def __getattr__(self, part: str) -> Any:
        """Return a part of the device, guarded. Raises AttributeError if the device lacks it."""
        with convert_exceptions(f"{self._name}: {part}"):
            value = getattr(self._device, part, _NONE)
        if value is _NONE:
            raise AttributeError(part)
        if self._rules.get(part) is text_rule:
            return self._check_value(part, text_rule, value)
        if callable(value):
            return partial(self._call, part, value)
        if part in self._rules:
            raise self._error(part, f"must be a method, not {name_kind(value)}")
        return value

    def _call(self, part: str, call: Any, *given: Any, **named: Any) -> Any:
        try:
            with convert_exceptions(f"{self._name}: {part}"):
                value = call(*given, **named)
        except DriverError:
            raise
        except FlexneedleError as error:  # of a function of this package that the device calls
            raise DriverError(make_printable(f"{self._name}: {part}: {one_line(error)}")) from error
        rule = self._rules.get(part)
        return value if rule is None else self._check_value(f"{part}()", rule, value)

    def _check_value(self, part: str, rule: Rule, value: Any) -> Any:
        with convert_exceptions(f"{self._name}: {part}"):
            problem = rule(value)
        if problem:
            raise self._error(part, problem)
        return value

    def _error(self, part: str, problem: str) -> DriverError:
        return DriverError(make_printable(f"{self._name}: {self._owner}.{part}: {problem}"))


def text_rule(value: object) -> str:
    """Return the rule that a value breaks that must be text."""
    return "" if isinstance(value, str) else f"must be text, not {_kind(value)}"


def states_rule(value: object) -> str:
    """Return the rule that the result of `Motors.read` breaks."""
    return _mapping_rule(value, MotorState, "channel")


def setups_rule(value: object) -> str:
    """Return the rule that the result of a driver's `setup` breaks."""
    return _mapping_rule(value, MotorSetup, "channel")


def frames_rule(value: object) -> str:
    """Return the rule that the result of `Tracker.read` breaks."""
    if not isinstance(value, tuple | list):
        return f"must be a tuple of Frame, not {_kind(value)}"
    return next(filter(None, map(_frame_rule, value)), "")


def readings_rule(value: object) -> str:
    """Return the rule that the result of `NeedleSensor.read` breaks."""
    if not isinstance(value, tuple | list):
        return f"must be a tuple of Reading, not {_kind(value)}"
    for one in value:
        if not isinstance(one, Reading):
            return f"must be a tuple of Reading, but one is {_kind(one)}"
    problem = next(filter(None, map(_record_rule, value)), "")
    return problem and f"Reading: {problem}"


_MOTORS = {"identity": text_rule, "address": text_rule, "read": states_rule, "setup": setups_rule}
_TRACKER = {"status": text_rule, "read": frames_rule}
_SENSOR = {"status": text_rule, "read": readings_rule}


def _frame_rule(frame: object) -> str:
    if not isinstance(frame, Frame):
        return f"must be a tuple of Frame, but one is {_kind(frame)}"
    problem = _record_rule(frame) or _mapping_rule(frame.readings, SensorReading, "sensor")
    return problem and f"Frame: {problem}"


def _mapping_rule(value: object, wanted: type, key: str) -> str:
    """Return the rule that a mapping of texts to records of a type breaks."""
    if not isinstance(value, Mapping):
        return f"must be a mapping of each {key} to a {wanted.__name__}, not {_kind(value)}"
    for name, record in value.items():
        if not isinstance(name, str):
            return f"must have text as each {key}, not {_kind(name)}"
        if not isinstance(record, wanted):
            return f"must have a {wanted.__name__} for {key} {name}, not {_kind(record)}"
        if problem := _record_rule(record):
            return f"{key} {name}: {problem}"
    return ""


def _record_rule(record: Any) -> str:
    """Return the rule that the first field with a value of another type breaks."""
    for field in fields(record):
        wanted, fits = _TYPES.get(field.type, ("", None))
        value = getattr(record, field.name)
        if fits is not None and not fits(value):
            return f"{field.name} must be {wanted}, not {shorten(value)}"
    turn = getattr(record, "orientation", None)
    if turn is not None and abs((size := hypot(*turn)) - 1.0) > _UNIT:
        return f"orientation must be a unit quaternion w, x, y, z, not one of length {size:g}"
    return ""


def _kind(value: object) -> str:
    return "None" if value is None else "a method" if callable(value) else name_kind(value)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_row(count: int, value: Any) -> bool:
    """Return whether a value is None or this number of numbers."""
    if value is None:
        return True
    return isinstance(value, Sequence | np.ndarray) and len(value) == count and all(map(_is_number, value))


_TYPES: Mapping[Any, tuple[str, Callable[[Any], bool]]] = {
    float: ("a number", _is_number),
    int: ("a number", _is_number),
    bool: ("True or False", lambda value: isinstance(value, Real | np.bool_)),
    str: ("text", lambda value: isinstance(value, str)),
    float | None: ("a number or None", lambda value: value is None or _is_number(value)),
    Point | None: ("3 numbers or None", partial(_is_row, 3)),
    Quaternion | None: ("4 numbers or None", partial(_is_row, 4)),
}
"""Description and check of the values of a field, by its type."""
