"""Fit of a rig to a scenario, before and after the devices are connected. Pure functions.

The base needs room for its advance from the tip to as far past the target as the needle may be; laterally, guide and
base need it for the travel that the scenario allows to either side of 0. The angle of the rotation is the angle of the
needle, 0 or 180° at the start.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from flexneedle.lab.rig.devices.sources import source_problems
from flexneedle.lab.rig.preflight.start import SDS, axis_start_problem
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import LoopSettings, RigFile
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import Problem, to_line

_ROUNDING = 1e-9
_STILL = "steering"  # the strategy that moves neither guide nor base laterally


@dataclass(frozen=True)
class AxisNeed:
    """Requirement of a scenario for a linear axis.

    travel: largest, from the start to the positive side, or of a lateral axis from 0 to both (mm); reason: of it, for
    messages; step_key, step: largest travel in a control step (mm); why: the axis is needed.
    """

    axis: str
    travel: float
    reason: str
    step_key: str
    step: float
    why: str


def _needs(scenario: Scenario, strategy: str) -> tuple[AxisNeed, ...]:
    """Return the requirements for each linear axis, before the tip is measured."""
    advance = needed_advance(scenario, scenario.target.depth_mm)
    return _insertion_need(scenario, advance), *_lateral_needs(scenario, strategy)


def fit_problems(rig: RigFile, scenario: Scenario, strategy: str = "manipulation") -> list[str]:
    """Return one line for each requirement of the scenario that the rig does not meet."""
    found = [
        *(
            problem
            for need in _needs(scenario, strategy)
            for problem in _linear_problems(rig, scenario, need)
        ),
        *_base_turn_problems(scenario, strategy),
        *_rotation_problems(rig, scenario),
        *_rate_problems(rig, scenario),
        *_sensor_problems(rig, scenario),
    ]
    return [to_line(problem) for problem in found]


def _sensor_problems(rig: RigFile, scenario: Scenario) -> Iterator[Problem]:
    """Yield sensors along the needle that only the rig or only the scenario has, or whose data are used twice."""
    wanted, given = [one.title for one in scenario.sensor], [one.name for one in rig.sensor]
    known = f"must be a sensor of the scenario, one of {', '.join(wanted)}"
    for n, name in enumerate(given):
        if name not in wanted:
            yield Problem(("sensor", n, "name"), name, known if wanted else "the scenario has no sensor")
    for name in wanted:
        if name not in given:
            rule = f'the rig has no device for {name}: add [[sensor]] with name = "{name}" to its file'
            yield Problem("sensor", None, rule)
    yield from source_problems(rig)


def room_problem(rig: RigFile, scenario: Scenario, position: float) -> str:
    """Return the problem of an insertion axis from whose position (mm) the travel would pass a soft limit, or ""."""
    return _room_problem(rig, scenario, position, needed_advance(scenario, scenario.target.depth_mm))


def start_problems(
    rig: RigFile, scenario: Scenario, positions: Mapping[str, float], advance: float
) -> list[str]:
    """Return one line for each axis from which an insertion with this advance of the base (mm) cannot start.

    Such an axis is beyond its soft limits (positions: mm or rad), is not at its start, or has no room.
    """
    found = list[str]()
    for name, axis in rig.axes.items():
        at = f"{name}: at {axis.to_text(positions[name])} {axis.unit}"
        if problem := limits_problem(axis, positions[name]):
            found.append(f"{at}: {problem}: flexneedle rig jog {rig.source} {name} --to POSITION")
        elif problem := axis_start_problem(rig, name, axis, positions[name]):
            found.append(f"{at}: {problem}")
    room = _room_problem(rig, scenario, positions["insertion"], advance)
    return [*found, *([f"insertion: {room}"] if room else [])]


def _room_problem(rig: RigFile, scenario: Scenario, position: float, advance: float) -> str:
    axis, need = rig.axes.insertion, _insertion_need(scenario, advance)
    high = axis.limits[1]
    left = max(high - position, 0.0)
    if advance <= left + axis.tolerance:
        return ""
    return f"at {position:.6g} mm, {left:.6g} mm to the high end of range_mm ({high:g}): {need.reason}"


def limits_problem(axis: Axis, position: float) -> str:
    """Return the problem of a position (mm or rad) beyond the soft limits of an axis, or ""."""
    low, high = axis.limits
    if low - axis.uncertainty <= position <= high + axis.uncertainty:
        return ""
    return f"beyond the soft limits, {axis.to_text(low)} to {axis.to_text(high)} {axis.unit}"


def describe_queues(rig: RigFile) -> list[tuple[str, str]]:
    """Return for each axis its name and its motion after a failure of the computer, at its largest speed."""
    return [(name, _describe_queue(axis, rig.loop)) for name, axis in rig.axes.items()]


def _describe_queue(axis: Axis, loop: LoopSettings) -> str:
    """Return a text such as `0.375 mm (5 mm/s × 75 ms)`, or `0.5 mm (loop.queue_mm)`."""
    distance, by_time, unit = loop.queue_of(axis, axis.speed), axis.speed * loop.queue, axis.unit
    why = f"{axis.to_text(axis.speed)} {unit}/s × {1e3 * loop.queue:g} ms"
    if distance != by_time:
        why = "loop.queue_mm" if distance < by_time else f"twice tolerance_{unit}"
    return f"{axis.to_text(distance)} {unit} ({why})"


def _insertion_need(scenario: Scenario, advance: float) -> AxisNeed:
    setup, past = scenario.setup, scenario.guard.past_target_mm
    return AxisNeed(
        "insertion",
        advance,
        f"the advance to guard.past_target_mm = {past:g} past the target is {advance:.6g} mm",
        "setup.max_advance_mm",
        setup.max_advance_mm,
        "the base advances",
    )


def _lateral_needs(scenario: Scenario, strategy: str) -> Iterator[AxisNeed]:
    """Yield the requirements for the axes of guide and base, which a plan that steers does not move."""
    if strategy == _STILL:
        return
    setup, sigma = scenario.setup, scenario.plan.base_sigma_mm
    moved = setup.moved_guide_axes
    on = f" on {moved} axes" if moved > 1 else ""
    for part, axes, why in (
        ("guide", moved, f"the guide moves{on}"),
        ("base", setup.axes if sigma else 0, f"the base moves laterally with plan.base_sigma_mm = {sigma:g}"),
    ):
        travel, step = getattr(setup, f"max_{part}_travel_mm"), getattr(setup, f"max_{part}_step_mm")
        reason = f"setup.max_{part}_travel_mm is {travel:g}, to either side of 0"
        for name in (f"{part}_y", f"{part}_z")[:axes]:
            yield AxisNeed(name, travel, reason, f"setup.max_{part}_step_mm", step, why)


def _linear_problems(rig: RigFile, scenario: Scenario, need: AxisNeed) -> Iterator[Problem]:
    axis = dict(rig.axes.items()).get(need.axis)
    if axis is None:
        yield Problem(f"axes.{need.axis}", None, f"missing: {need.why}")
        return
    if rule := _range_rule(axis, need):
        yield Problem(f"axes.{need.axis}.range_mm", [*axis.limits], rule)
    yield from _speed_problems(axis, scenario, need)


def _range_rule(axis: Axis, need: AxisNeed) -> str:
    """Return the rule that the soft limits of an axis break, or "".

    A lateral axis may start off 0 by half of its backlash.
    """
    low, high = axis.limits
    if need.axis == "insertion":
        short = need.travel > high - low + _ROUNDING
        return f"must be at least {need.travel:.6g} wide: {need.reason}" if short else ""
    slack = max(0.5 * axis.backlash - axis.tolerance, 0.0)
    most = need.travel + slack
    if min(-low, high) >= most - _ROUNDING:
        return ""
    unsure = f", and its backlash leaves the start uncertain by {0.5 * axis.backlash:.6g}" if slack else ""
    return f"must include {-most:.6g} to {most:.6g}: {need.reason}{unsure}"


def _speed_problems(axis: Axis, scenario: Scenario, need: AxisNeed) -> Iterator[Problem]:
    speed = scenario.setup.insertion_speed_mm_s
    if need.axis == "insertion":
        if speed > axis.speed + _ROUNDING:
            rule = f"must be at most {axis.speed:g}, axes.insertion.speed_mm_s"
            yield Problem("setup.insertion_speed_mm_s", speed, rule)
        return
    time = scenario.setup.max_advance_mm / speed
    if need.step > axis.speed * time + _ROUNDING:
        advance = "setup.max_advance_mm at setup.insertion_speed_mm_s"
        rule = f"must be at most {axis.speed * time:g}: axes.{need.axis}.speed_mm_s is {axis.speed:g}, and a step lasts"
        yield Problem(need.step_key, need.step, f"{rule} {time:g} s ({advance})")


def _base_turn_problems(scenario: Scenario, strategy: str) -> Iterator[Problem]:
    turn = scenario.plan.base_turn_sigma_mrad
    if turn > 0.0 and strategy != _STILL:
        yield Problem("plan.base_turn_sigma_mrad", turn, "must be 0: no axis of a rig rotates the base")


def _rotation_problems(rig: RigFile, scenario: Scenario) -> Iterator[Problem]:
    setup, axis = scenario.setup, rig.axes.rotation
    if axis is None:
        yield Problem("axes.rotation", None, "missing: the needle is rolled")
        return
    low, high = axis.range_deg
    shown = f"axes.rotation.range_deg is {low:g} to {high:g}"
    if setup.half_turns:
        if low > 0.0 or high < 180.0:
            rule = f"must include 0 to 180: the needle rolls by half turns ({setup.half_turns_by})"
            yield Problem("axes.rotation.range_deg", [low, high], rule)
        return
    most, free = min(-low, high), setup.max_rotation_deg
    if most <= 0.0:
        yield Problem(
            "axes.rotation.range_deg", [low, high], "must include 0, the needle's angle at the start"
        )
    elif free is None:
        yield Problem("setup.max_rotation_deg", None, f"not set: must be at most {most:g}, {shown}")
    elif free > most + _ROUNDING:
        yield Problem("setup.max_rotation_deg", free, f"must be at most {most:g}, {shown}")


def _rate_problems(rig: RigFile, scenario: Scenario) -> Iterator[Problem]:
    tracker, loop = scenario.tracker.rate_hz, rig.loop.rate_hz
    if loop < tracker and not math.isclose(loop, tracker):
        rule = (
            f"must be at least {tracker:g}, tracker.rate_hz of the scenario: readings would wait for a tick"
        )
        yield Problem("loop.rate_hz", loop, rule)


# The advance


def deepest_advance(scenario: Scenario, target: float, tip: float | None) -> float:
    """Return the advance (mm) of the base at the deepest position that the guard allows, for a straight needle.

    target: depth (mm) of the target, which the needle may pass by guard.past_target_mm; tip: measured depth of the tip
    at the start (mm); None: three standard deviations behind the start of the scenario.
    """
    start = scenario.setup.start_tip_x - SDS * scenario.control.start_axial_sd_mm if tip is None else tip
    return (target + scenario.guard.past_target_mm - start) * axis_stretch(scenario.entry.slope)


def needed_advance(scenario: Scenario, target: float, tip: float | None = None) -> float:
    """Return the advance (mm) of the base for which an insertion needs room.

    It is `deepest_advance` within the scenario's stroke.
    """
    return min(
        deepest_advance(scenario, target, tip), scenario.setup.stroke_mm * axis_stretch(scenario.entry.slope)
    )


def axis_stretch(slope: complex) -> float:
    """Return the length of the insertion axis for each mm along x. slope: dy/dx + i dz/dx of the axis."""
    return math.sqrt(1.0 + abs(slope) ** 2)
