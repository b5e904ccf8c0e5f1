"""The start of an insertion on a rig: what will move, where the tip is before, and how far the base may go."""

import math
from collections.abc import Mapping

from flexneedle.errors import RigError
from flexneedle.lab.rig.moves import resting
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.scenario.model import Scenario
from flexneedle.types import Point

_SDS = 3.0  # standard deviations of the start that a tip may be off


def announced(rig: RigFile, scenario: Scenario, positions: Mapping[str, float]) -> list[str]:
    """What an insertion will move, a line for the needle and for each axis: where it is (mm or rad), and its speed."""
    depth, *lateral = scenario.target.position[: 1 + scenario.setup.axes]
    to = f"{depth:g} mm deep, {', '.join(f'{value:g}' for value in lateral)} mm to the side"
    first = f"{rig.name}: the needle will be inserted from where it is, to a target {to}."
    return [first, *resting(rig, positions)]


def checked_start(scenario: Scenario, tip: Point | None) -> Point:
    """The measured tip, if it is where the scenario begins, so that nothing moves in a place that nobody expects.

    It may be as far from there as the first reading may be from its prediction. Raises RigError.
    """
    control, x = scenario.control, scenario.setup.start_tip_x
    at = scenario.entry.lateral(x)
    expected = (x, at.real, at.imag)
    if tip is None:
        raise RigError(f"tip: not measured for {control.hold_limit_s:g} s: it must be before anything moves")
    turned = 1e-3 * control.start_angle_sd_mrad * scenario.needle.length_mm
    sd = math.hypot(control.start_axial_sd_mm, control.start_offset_sd_mm, turned)
    off, limit = math.dist(tip, expected), control.innovation_limit_mm + _SDS * sd
    if off > limit:
        rule = f"must be within {limit:.1f} mm of the scenario's start, {_place(expected)}"
        remedy = "retract the needle, jog the guide, or check the registration"
        raise RigError(f"tip = {_place(tip)}: {rule} (setup.tip_to_skin_mm): {remedy}")
    return tip


def _place(point: Point) -> str:
    return ", ".join(f"{one:.1f}" for one in point) + " mm"


def deepest(scenario: Scenario, target: float, tip: float | None) -> float:
    """Advance (mm) of the base at which a straight needle is as far past a target at this depth (mm) as it may be.

    tip: its measured depth at the start (mm); None: that of a needle which begins within three standard deviations of
    the scenario's.
    """
    start = scenario.setup.start_tip_x - _SDS * scenario.control.start_axial_sd_mm if tip is None else tip
    return (target + scenario.guard.past_target_mm - start) * _stretch(scenario)


def needed(scenario: Scenario, target: float, tip: float | None = None) -> float:
    """Advance (mm) of the base for which an insertion needs room: as `deepest`, within the scenario's stroke."""
    return min(deepest(scenario, target, tip), scenario.setup.stroke_mm * _stretch(scenario))


def _stretch(scenario: Scenario) -> float:
    """Length of the insertion axis for each mm along x."""
    return math.sqrt(1.0 + abs(scenario.entry.slope) ** 2)
