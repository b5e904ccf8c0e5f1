"""Whether a rig can do what a scenario needs, before anything is connected. Pure functions.

An insertion starts where base and guide are when it begins. The base needs room for its advance from the tip to as far
past the target as the needle may be, the guide for the travel that the scenario allows to either side; the angle of the
rotation is that of the needle, 0 or 180° at the start.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from flexneedle.lab.rig.rig_file import LoopSettings, RigFile
from flexneedle.lab.rig.start import needed
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.axes import Axis

_ROUNDING = 1e-9
_STILL = "steering"  # the strategy that moves neither guide nor base laterally


@dataclass(frozen=True)
class Need:
    """What a scenario needs of a linear axis.

    travel: largest, to the positive side, or to both (mm); reason: of it, for messages; step_key, step: largest travel
    in a control step (mm); why: the axis is needed.
    """

    axis: str
    travel: float
    reason: str
    step_key: str
    step: float
    why: str
    both: bool = True

    @property
    def back(self) -> float:
        """Travel to the negative side, mm."""
        return self.travel if self.both else 0.0

    @property
    def width(self) -> float:
        """Smallest distance between the soft limits, mm."""
        return self.travel + self.back


def needs(scenario: Scenario, strategy: str, advance: float) -> tuple[Need, ...]:
    """Return what a scenario needs of each linear axis, with the strategy of its plan and this advance (mm)."""
    return (_insertion(scenario, advance), *_guide(scenario, strategy), *_base(scenario, strategy))


def _planned(scenario: Scenario, strategy: str) -> tuple[Need, ...]:
    """What a scenario needs before its tip is measured."""
    return needs(scenario, strategy, needed(scenario, scenario.target.depth_mm))


def fit_problems(rig: RigFile, scenario: Scenario, strategy: str = "manipulation") -> list[str]:
    """Return one line for each thing that the scenario needs and the rig cannot; empty if the rig can all."""
    found = [
        *(problem for need in _planned(scenario, strategy) for problem in _linear(rig, scenario, need)),
        *_turning_base(scenario, strategy),
        *_rotation(rig, scenario),
        *_rate(rig, scenario),
    ]
    return [to_line(problem) for problem in found]


def room_problems(
    rig: RigFile, scenario: Scenario, positions: Mapping[str, float], strategy: str = "manipulation"
) -> list[tuple[str, str]]:
    """Return axis and line for each axis from whose position (mm) the scenario's travel would pass a soft limit."""
    return _rooms(rig, _planned(scenario, strategy), positions)


def start_problems(
    rig: RigFile, scenario: Scenario, positions: Mapping[str, float], strategy: str, advance: float
) -> list[str]:
    """Return one line for each axis that is beyond its soft limits (positions: mm or rad), or has no room from there
    for an insertion with this advance of the base (mm)."""
    outside = [(name, _outside(axis, positions[name])) for name, axis in rig.axes.items()]
    found = [*outside, *_rooms(rig, needs(scenario, strategy, advance), positions)]
    return [f"{name}: {line}" for name, line in found if line]


def _rooms(rig: RigFile, needed: Iterable[Need], positions: Mapping[str, float]) -> list[tuple[str, str]]:
    axes = dict(rig.axes.items())
    return [
        (need.axis, line)
        for need in needed
        if need.axis in positions and need.axis in axes
        for line in _room(axes[need.axis], need, positions[need.axis])
    ]


def _outside(axis: Axis, position: float) -> str:
    low, high = axis.limits
    if low - axis.uncertainty <= position <= high + axis.uncertainty:
        return ""
    limits = f"{axis.shown(low)} to {axis.shown(high)} {axis.unit}"
    return f"at {axis.shown(position)} {axis.unit}: beyond the soft limits, {limits}: jog it back"


def queued(rig: RigFile) -> list[tuple[str, str]]:
    """Return for each axis its name and what it still moves after the computer has stopped, at its largest speed."""
    return [(name, _queued(axis, rig.loop)) for name, axis in rig.axes.items()]


def _queued(axis: Axis, loop: LoopSettings) -> str:
    """Such as `0.375 mm (5 mm/s × 75 ms)`, or `0.5 mm (loop.queue_mm)`."""
    distance, by_time, unit = loop.queue_of(axis, axis.speed), axis.speed * loop.queue, axis.unit
    why = f"{axis.shown(axis.speed)} {unit}/s × {1e3 * loop.queue:g} ms"
    if distance != by_time:
        why = "loop.queue_mm" if distance < by_time else f"twice tolerance_{unit}"
    return f"{axis.shown(distance)} {unit} ({why})"


def _insertion(scenario: Scenario, advance: float) -> Need:
    setup, past = scenario.setup, scenario.guard.past_target_mm
    return Need(
        "insertion",
        advance,
        f"the advance to guard.past_target_mm = {past:g} past the target is {advance:.6g} mm",
        "setup.max_advance_mm",
        setup.max_advance_mm,
        "the base advances",
        both=False,
    )


def _guide(scenario: Scenario, strategy: str) -> Iterator[Need]:
    setup = scenario.setup
    moved = 0 if strategy == _STILL else setup.moved_guide_axes
    why = f"the guide moves on {moved} axes" if moved > 1 else "the guide moves"
    for name in ("guide_y", "guide_z")[:moved]:
        reason = f"setup.max_guide_travel_mm is {setup.max_guide_travel_mm:g}, to either side"
        step = "setup.max_guide_step_mm", setup.max_guide_step_mm
        yield Need(name, setup.max_guide_travel_mm, reason, *step, why)


def _base(scenario: Scenario, strategy: str) -> Iterator[Need]:
    setup, sigma = scenario.setup, scenario.plan.base_sigma_mm
    if sigma == 0.0 or strategy == _STILL:
        return
    why = f"the base moves laterally with plan.base_sigma_mm = {sigma:g}"
    for name in ("base_y", "base_z")[: setup.axes]:
        reason = f"setup.max_base_travel_mm is {setup.max_base_travel_mm:g}, to either side"
        step = "setup.max_base_step_mm", setup.max_base_step_mm
        yield Need(name, setup.max_base_travel_mm, reason, *step, why)


def _linear(rig: RigFile, scenario: Scenario, need: Need) -> Iterator[Problem]:
    axis = dict(rig.axes.items()).get(need.axis)
    if axis is None:
        yield Problem(f"axes.{need.axis}", None, f"missing: {need.why}")
        return
    yield from _too_far(axis, need)
    yield from _too_fast(axis, scenario, need)


def _too_far(axis: Axis, need: Need) -> Iterator[Problem]:
    low, high = axis.limits
    if need.width > high - low + _ROUNDING:
        rule = f"must be at least {need.width:.6g} wide: {need.reason}"
        yield Problem(f"axes.{need.axis}.range_mm", [low, high], rule)


def _too_fast(axis: Axis, scenario: Scenario, need: Need) -> Iterator[Problem]:
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


def _room(axis: Axis, need: Need, position: float) -> Iterator[str]:
    low, high = axis.limits
    for end, at, travel, room in (
        ("low", low, need.back, position - low),
        ("high", high, need.travel, high - position),
    ):
        left = max(room, 0.0)
        if travel > left + axis.tolerance:
            limit = f"{left:.6g} mm to the {end} end of range_mm ({at:g})"
            yield f"at {position:.6g} mm, {limit}: {need.reason}{_remedy(axis, need)}"


def _remedy(axis: Axis, need: Need) -> str:
    """Where to jog an axis that has too little room, if there is such a place, at which it is also found to be.

    There is none of the insertion axis: what is jogged back is to be advanced again.
    """
    low, high = axis.limits[0] + need.back, axis.limits[1] - need.travel
    if not need.both or low > high + _ROUNDING:
        return ""
    unsure = axis.uncertainty - axis.tolerance
    if 0.5 * (high - low) < unsure - axis.tolerance:
        width = need.width + 2.0 * (unsure - axis.tolerance)
        return f"; range_mm must be {width:.6g} mm wide: with its backlash the position is uncertain by {unsure:.6g} mm"
    where = f"to {low:.6g} mm" if high - low <= _ROUNDING else f"between {low:.6g} and {high:.6g} mm"
    return f"; jog it {where}"


def _turning_base(scenario: Scenario, strategy: str) -> Iterator[Problem]:
    turn = scenario.plan.base_turn_sigma_mrad
    if turn > 0.0 and strategy != _STILL:
        yield Problem("plan.base_turn_sigma_mrad", turn, "must be 0: no axis of a rig rotates the base")


def _rotation(rig: RigFile, scenario: Scenario) -> Iterator[Problem]:
    setup, axis = scenario.setup, rig.axes.rotation
    if axis is None:
        yield Problem("axes.rotation", None, f"missing: the needle is rolled ({setup.turns})")
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


def _rate(rig: RigFile, scenario: Scenario) -> Iterator[Problem]:
    tracker, loop = scenario.tracker.rate_hz, rig.loop.rate_hz
    if loop < tracker and not math.isclose(loop, tracker):
        rule = (
            f"must be at least {tracker:g}, tracker.rate_hz of the scenario: readings would wait for a tick"
        )
        yield Problem("loop.rate_hz", loop, rule)
