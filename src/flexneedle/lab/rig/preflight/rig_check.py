"""Comparison of a rig with its file: each device is read; nothing is moved, powered or changed."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain
from math import isfinite
from statistics import median
from typing import Any

from flexneedle.errors import FlexneedleError, one_line
from flexneedle.lab.rig.devices.opening import (
    OpenNeedleSensor,
    OpenTracker,
    open_motors,
    open_sensor,
    open_tracker,
)
from flexneedle.lab.rig.preflight.fit import describe_queues, fit_problems, limits_problem, room_problem
from flexneedle.lab.rig.preflight.moves import describe_uncertainty
from flexneedle.lab.rig.preflight.speeds import describe_speed, step_time
from flexneedle.lab.rig.preflight.start import axis_start_problem, tip_problems, with_registration
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import RigFile, SensorSection
from flexneedle.lab.rig.supervisor.checks import active_switches, resting_switch_problem
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.loop.virtual import to_stage
from flexneedle.phantom.tracking.stage import median_pose, tip_on_stage
from flexneedle.ports import Clock, Motors, MotorSetup, MotorState
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import TIP, VISIBLE, Frame, Point, Reading, is_reference

_PAUSE_S = 0.01
_READINGS = 5  # of the motors, for the time of a reply
_MOST_UNMEASURED = (
    0.1  # share of the frames in which a sensor has no position; one such frame is always allowed
)
_RATE_TOLERANCE = 0.1


@dataclass(frozen=True)
class Finding:
    """One line of the check: the part of the rig, the item, the value found, and the problem, "" if there is none."""

    part: str
    item: str
    found: str
    problem: str = ""


class UncheckedFinding(Finding):
    """A line where nothing could be compared."""


@dataclass(frozen=True)
class IntendedInsertion:
    """Scenario, and strategy of its plan, that the rig is checked for."""

    scenario: Scenario
    strategy: str = "manipulation"


def check_rig(
    rig: RigFile, clock: Clock, seconds: float, wanted: IntendedInsertion | None = None
) -> list[Finding]:
    """Return the findings at each device. seconds: for which frames of the tracker are counted; clock: real time.

    A device that cannot be reached is a finding, too. A registration in the rig file replaces the scenario's.
    """
    if wanted is not None:
        wanted = replace(wanted, scenario=with_registration(rig, wanted.scenario))
    rolls = [0.0]

    def read_motors(device: Motors) -> list[Finding]:
        findings = check_motors(rig, device, clock, wanted)
        rolls.append(_read_roll(rig, device))
        return findings

    found = [Finding(name, "queued motion", distance) for name, distance in describe_queues(rig)]
    found += [Finding(name, "speed", describe_speed(rig, axis)) for name, axis in rig.axes.items()]
    found += _scenario_findings(rig, wanted) if wanted is not None else ()
    found += check_device("driver", rig.driver.kind, lambda: open_motors(rig), read_motors)
    found += check_device(
        "tracker",
        rig.tracker.kind,
        lambda: open_tracker(rig, clock),
        lambda t: check_tracker(rig, t, clock, seconds, wanted, rolls[-1]),
    )
    if wanted is not None:
        for part in rig.sensor:
            found += _sensor_part_findings(part, wanted.scenario, clock, seconds)
    return found


def _sensor_part_findings(
    part: SensorSection, scenario: Scenario, clock: Clock, seconds: float
) -> list[Finding]:
    """Return the findings of a sensor along the needle, none if it is no sensor of the scenario."""
    wanted = next((one for one in scenario.sensor if one.title == part.name), None)
    if wanted is None:
        return []
    name = f"sensor {part.name}"
    return check_device(
        name,
        part.kind,
        lambda: open_sensor(part, wanted, clock, scenario),
        lambda device: check_sensor(name, wanted, device, clock, seconds),
    )


def check_device(
    part: str, kind: str, connect: Callable[[], Any], read: Callable[[Any], list[Finding]]
) -> list[Finding]:
    """Return the findings of one device; after a failure its error replaces the findings that are missing."""
    connected: list[Finding] = []
    try:
        with closing(connect()) as device:
            identity = getattr(device, "identity", "")
            connected = [Finding(part, "connection", ", ".join(filter(None, (kind, identity))))]
            return connected + read(device)
    except FlexneedleError as error:
        problem = one_line(error)
        for label in (f"{part} {kind}: ", f'{part}.kind = "{kind}": '):  # in each line of the error
            problem = problem.replace(label, "")
        return [*connected, Finding(part, "reading" if connected else "connection", kind, problem)]


def _scenario_findings(rig: RigFile, wanted: IntendedInsertion) -> list[Finding]:
    problems = fit_problems(rig, wanted.scenario, wanted.strategy)
    name = wanted.scenario.name
    found = [Finding("scenario", "fit", name, line) for line in problems or [""]]
    return [*found, _step_finding(rig, wanted.scenario)]


def _step_finding(rig: RigFile, scenario: Scenario) -> Finding:
    """Return the time of the largest step: with a slow acceleration an insertion is slower than its scenario."""
    way, planned = scenario.setup.max_advance_mm, scenario.setup.step_time
    time = step_time(rig.axes.insertion, rig.loop, way, planned)
    return Finding("insertion", "largest step", f"{way:g} mm in {time:.2g} s, planned for {planned:.2g} s")


# Motors


def check_motors(
    rig: RigFile, device: Motors, clock: Clock, wanted: IntendedInsertion | None = None
) -> list[Finding]:
    """Return the findings of a few readings of the motors. Raises DriverError if they cannot be read."""
    states, seconds = _read_motors(device, clock)
    tick = 1.0 / rig.loop.rate_hz
    late = f"longer than a tick of the loop, {1e3 * tick:.4g} ms" if seconds > tick else ""
    found = [Finding("driver", "reply", f"{1e3 * seconds:.1f} ms", late)]
    # Not every driver reports the setup of its controller.
    setups: Mapping[str, MotorSetup] = device.setup() if hasattr(device, "setup") else {}
    for name, axis in rig.axes.items():
        state = states.get(axis.channel)
        if state is None:
            rule = f"the driver has no channel {axis.channel}; it has {', '.join(states) or 'none'}"
            found.append(Finding(name, "motor", axis.channel, rule))
            continue
        found += _axis_findings(name, axis, state)
        if axis.channel in setups:
            found += _setup_findings(name, axis, setups[axis.channel])
        if wanted is not None:
            found.append(_start_finding(rig, name, axis, state.position / axis.scale, wanted.scenario))
    return found


def _start_finding(rig: RigFile, name: str, axis: Axis, position: float, scenario: Scenario) -> Finding:
    """Return the finding of an axis (position: mm or rad) as the start of an insertion."""
    shown = f"at {axis.to_text(position)} {axis.unit}"
    if name == "insertion":
        return Finding(name, "room", "from here", room_problem(rig, scenario, position))
    if name == "rotation":
        return Finding(name, "start", f"{shown}, rolled to the plan's angle before the insertion")
    return Finding(name, "start", shown, axis_start_problem(rig, name, axis, position))


def _read_roll(rig: RigFile, device: Motors) -> float:
    """Return the angle of the needle (rad), 0 without its motor."""
    axis = rig.axes.rotation
    state = None if axis is None else device.read().get(axis.channel)
    return 0.0 if axis is None or state is None else state.position / axis.scale


def _read_motors(device: Motors, clock: Clock) -> tuple[Mapping[str, MotorState], float]:
    """Return the last of a few readings, and the median time (s) of one."""
    states: Mapping[str, MotorState] = {}
    times = []
    for _ in range(_READINGS):
        begun = clock.now()
        states = device.read()
        times.append(clock.now() - begun)
    return states, median(times)


def _axis_findings(name: str, axis: Axis, state: MotorState) -> Iterator[Finding]:
    known = "reported as moving, as also at rest after its program was killed"
    moving = f"{known}; this command does not move it" if state.moving else ""
    problem = "; ".join(filter(None, (moving, state.stopped)))
    yield Finding(name, "motor", f"{axis.channel}, {'on' if state.on else 'off'}", problem)
    position = state.position / axis.scale
    problem = limits_problem(axis, position) if isfinite(position) else "is not a number"
    slack = f", {describe_uncertainty(axis)}" if axis.backlash else ""
    shown = f"{axis.to_text(position)} {axis.unit} ({state.position:.10g} counts){slack}"
    yield Finding(name, "position", shown, problem)
    active = " and ".join(sorted(active_switches(state), reverse=True)) or "none active"
    problem = resting_switch_problem(Drive(name, axis), state).removeprefix(f"{name}: ")
    yield Finding(name, "limit switches", active, problem)
    if state.on:
        yield _following_finding(name, axis, state)


def _setup_findings(name: str, axis: Axis, setup: MotorSetup) -> Iterator[Finding]:
    """Yield the controller's own reactions to limits and errors, compared with the rig file."""
    off = f"{setup.disabled} disabled in the controller: it does not stop the motor" if setup.disabled else ""
    yield Finding(name, "switches in use", "all" if not off else "not all", off)
    low, high = sorted((setup.lowest / axis.scale, setup.highest / axis.scale))
    narrow = low > axis.limits[0] + axis.tolerance or high < axis.limits[1] - axis.tolerance
    held = ", also while its home is searched" if axis.to_home and (isfinite(low) or isfinite(high)) else ""
    limits = f"{axis.to_text(axis.limits[0])} to {axis.to_text(axis.limits[1])} {axis.unit}"
    rule = f"narrower than range_{axis.unit}, {limits}: motions would end there" if narrow else ""
    yield Finding(name, "controller's limits", _format_limits(axis, low, high) + held, rule)
    yield _error_limit_finding(name, axis, setup)


def _format_limits(axis: Axis, low: float, high: float) -> str:
    if not (isfinite(low) or isfinite(high)):
        return "none"
    ends = (axis.to_text(end) if isfinite(end) else "none" for end in (low, high))
    return f"{' to '.join(ends)} {axis.unit}"


def _error_limit_finding(name: str, axis: Axis, setup: MotorSetup) -> Finding:
    """Return the controller's own reaction to an error, which must not come before the supervisor's."""
    error = setup.most_error / abs(axis.scale)
    if not (setup.off_on_error and isfinite(error)):
        return Finding(name, "motor off on error", "no")
    most = axis.to_text(axis.max_error)
    rule = (
        f"below max_error_{axis.unit} ({most}): it would act before the fault"
        if error < axis.max_error
        else ""
    )
    return Finding(name, "motor off on error", f"beyond {axis.to_text(error)} {axis.unit}", rule)


def _following_finding(name: str, axis: Axis, state: MotorState) -> Finding:
    error = abs((state.commanded - state.position) / axis.scale)
    most = axis.max_error
    limit = f"must be at most max_error_{axis.unit} ({axis.to_text(most)})"
    rule = "" if error <= most else f"{limit}: free the axis; the next motion begins at its position then"
    return Finding(name, "commanded - measured", f"{axis.to_text(error)} {axis.unit}", rule)


# Tracker


def check_tracker(
    rig: RigFile,
    device: OpenTracker,
    clock: Clock,
    seconds: float,
    wanted: IntendedInsertion | None = None,
    roll: float = 0.0,
) -> list[Finding]:
    """Return the findings of the frames of `seconds`. roll: of the needle (rad). Raises RunError after a failure."""
    frames: list[Frame] = _collect(device, clock, seconds)
    if not frames:
        reason = "no frame" if device.status == VISIBLE else f"no frame: {device.status}"
        return [Finding("tracker", "frames", f"none in {seconds:g} s", reason)]
    status = device.status
    return [
        _rate_finding(frames, wanted),
        Finding("tracker", "status", status, "" if status == VISIBLE else "must be ok while frames arrive"),
        *_sensor_findings(frames),
        *_needed_sensor_findings(frames, wanted),
        *_tip_findings(rig, frames, wanted, roll),
    ]


def check_sensor(
    name: str, wanted: Sensor, device: OpenNeedleSensor, clock: Clock, seconds: float
) -> list[Finding]:
    """Return the findings of the readings of `seconds` of a sensor along the needle."""
    readings: list[Reading] = _collect(device, clock, seconds)
    rate, status = len(readings) / seconds, device.status
    slow = rate < (1.0 - _RATE_TOLERANCE) * wanted.rate_hz
    measured = [one for one in readings if any(isfinite(value) for row in one.rows for value in row)]
    factor, unit = wanted.unit
    rows = [", ".join(f"{factor * value:.4g}" for value in row) for one in measured[-1:] for row in one.rows]
    shown = f"{'; '.join(rows)} {unit}".rstrip() if rows else "none"
    few = 2 * len(measured) <= len(readings)
    said = readings[-1].status if readings else "no reading"
    problem = f"in less than half of the readings: {said}" if few else _find_dead(measured, wanted)
    values = Finding(name, "values", shown, problem)
    if readings and not measured and type(wanted).sees is not Sensor.sees:
        values = UncheckedFinding(name, "values", f"none, as of an image without the needle: {said}")
    return [
        Finding(name, "readings", f"{rate:.1f} Hz", f"rate_hz of the scenario is {wanted.rate_hz:g}" * slow),
        Finding(name, "status", status, "must be ok while readings arrive" * (status != VISIBLE)),
        values,
    ]


def _find_dead(measured: Sequence[Reading], wanted: Sensor) -> str:
    """Return the problem of rows without a value in any reading, such as sites of a fibre; images may have such."""
    rows = zip(*(one.rows for one in measured), strict=False) if type(wanted).sees is Sensor.sees else ()
    dead = [str(k) for k, each in enumerate(rows, 1) if not any(map(isfinite, chain.from_iterable(each)))]
    return f"no value in any reading: row {', '.join(dead)}" if dead else ""


def _collect(device: Any, clock: Clock, seconds: float) -> list[Any]:
    """Return what a device measures in `seconds`."""
    begun, found = clock.now(), list[Any]()
    while clock.now() - begun < seconds:
        found += device.read()
        clock.wait(_PAUSE_S)
    return found


def _rate_finding(frames: Sequence[Frame], wanted: IntendedInsertion | None) -> Finding:
    span, missed = frames[-1].time - frames[0].time, frames[-1].number - frames[0].number + 1 - len(frames)
    rate = (len(frames) - 1) / span if span > 0.0 else 0.0
    shown = f"{rate:.1f} Hz, {len(frames)} frames, {missed} missed"
    if rate == 0.0:
        return Finding("tracker", "frames", shown, "too few for a rate")
    expected = None if wanted is None else wanted.scenario.tracker.rate_hz
    if expected is not None and abs(rate / expected - 1.0) > _RATE_TOLERANCE:
        return Finding("tracker", "frames", shown, f"tracker.rate_hz of the scenario is {expected:g}")
    return Finding("tracker", "frames", shown)


def _sensor_findings(frames: Sequence[Frame]) -> Iterator[Finding]:
    names = dict.fromkeys(name for frame in frames for name in frame.readings)
    for name in names:
        readings = [frame.readings[name] for frame in frames if name in frame.readings]
        measured = [reading for reading in readings if not reading.fault]
        share, unmeasured, at = len(measured) / len(frames), len(frames) - len(measured), ""
        if measured and (position := measured[-1].position) is not None:
            at = " at {:.2f}, {:.2f}, {:.2f} mm".format(*position)
        last = next((r.fault for r in reversed(readings) if r.fault), "not in every frame")
        enough = measured and unmeasured <= max(1.0, _MOST_UNMEASURED * len(frames))
        problem = "" if enough else f"measured in too few frames: {last}"
        yield Finding("tracker", f"sensor {name}", f"measured in {share:.0%}{at}", problem)


def _needed_sensor_findings(frames: Sequence[Frame], wanted: IntendedInsertion | None) -> Iterator[Finding]:
    names = {name for frame in frames for name in frame.readings}
    if TIP not in names:
        yield Finding(
            "tracker", f"sensor {TIP}", "not found", f"the needle's sensor must have the name {TIP}"
        )
    if wanted is None or not wanted.scenario.monitor.enabled:
        return
    references, needed = sum(map(is_reference, names)), wanted.scenario.monitor.references
    if references < needed:
        rule = f"monitor.references of the scenario is {needed}: references have names that begin with ref"
        yield Finding("tracker", "reference sensors", str(references), rule)


def _tip_findings(
    rig: RigFile, frames: Sequence[Frame], wanted: IntendedInsertion | None, roll: float
) -> Iterator[Finding]:
    """Yield the findings of the tip as the start of an insertion."""
    if wanted is None:
        return
    settings = wanted.scenario.tracker
    to, offset = to_stage(settings.registration), settings.tip_offset_mm
    measured = [one for one in frames if TIP in one.readings and _is_finite(one.readings[TIP].position)]
    tip = median_pose(tip_on_stage(frame, to, offset) for frame in measured)
    if tip is None:
        if measured:
            rule = f"tracker.tip_offset_mm is {offset:g}: the sensor must have an orientation"
            yield Finding("tip", "start", "not known", rule)
        return
    place = "{:.2f}, {:.2f}, {:.2f} mm in the frame of the insertion".format(*tip.point)
    for line in tip_problems(rig, wanted.scenario, tip, roll) or [""]:
        yield Finding("tip", "start", place, line)


def _is_finite(position: Point | None) -> bool:
    return position is not None and all(map(isfinite, position))
