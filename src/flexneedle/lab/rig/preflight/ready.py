"""Motions that bring the axes of a rig to the start of a scenario. Pure functions."""

from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.errors import RigError
from flexneedle.lab.rig.preflight.fit import axis_stretch
from flexneedle.lab.rig.preflight.moves import AxisMove, plan_jog
from flexneedle.lab.rig.preflight.start import air_margin, withdrawal
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.scenario.model import Scenario
from flexneedle.types import Point

_SDS = 3.0  # standard deviations of the start by which the skin may be nearer than in the scenario
_OFF = 0.2  # largest relative error of a motion forward
_HALF = 0.5  # of the way forward: even an axis that moves twice as far ends at the start


@dataclass(frozen=True)
class WayToStart:
    """Motions to the start, in their order: back, across, forward in two parts; the tip is measured between them."""

    back: tuple[AxisMove, ...]
    across: tuple[AxisMove, ...]
    forward: tuple[AxisMove, ...]

    @property
    def moves(self) -> tuple[AxisMove, ...]:
        """All motions."""
        return (*self.back, *self.across, *self.forward)


def plan_way_to_start(
    rig: RigFile, scenario: Scenario, positions: Mapping[str, float], tip: Point | None
) -> WayToStart:
    """Return the motions from the positions of the axes (mm or rad) and the measured tip (mm) to the scenario's start.

    The insertion axis goes where the tip is at the start, the others to 0. Raises RigError if the tip is not measured
    or may be in tissue, InputError for a start beyond the soft limits.
    """
    if tip is None:
        raise RigError(
            f"tip: not measured: the start of the insertion axis is unknown: flexneedle rig check {rig.source}"
        )
    start, here = scenario.setup.start_tip_x, tip[0]
    require_air(rig, here, air_margin(scenario))
    at = positions["insertion"]
    goal = _within_limits(rig, scenario, at + (start - here) * axis_stretch(scenario.entry.slope))
    across = [_move(rig, name, positions[name], 0.0) for name, _ in rig.axes.items() if name != "insertion"]
    along = _move(rig, "insertion", at, goal)
    if along and along.distance > 0.0:
        middle = at + _HALF * along.distance
        both = _move(rig, "insertion", at, middle), _move(rig, "insertion", middle, goal)
        return WayToStart((), tuple(filter(None, across)), tuple(filter(None, both)))
    return WayToStart((along,) if along else (), tuple(filter(None, across)), ())


def require_air(rig: RigFile, tip_x: float, margin: float) -> None:
    """Raise RigError for a tip that is at x = `tip_x`, less than `margin` mm before the skin."""
    if tip_x > -margin:
        where = f"{tip_x:.1f} mm deep" if tip_x > 0.0 else f"{-tip_x:.1f} mm before the skin"
        rule = f"must be {margin:.2g} mm or more before the skin, so that nothing bends the needle in tissue"
        raise RigError(f"tip: {where}: {rule}: {withdrawal(rig)}")


def _within_limits(rig: RigFile, scenario: Scenario, goal: float) -> float:
    """Return the goal (mm) of the insertion axis, or the soft limit before it if the tip is near enough to the start.

    An axis beyond its limits returns to them.
    """
    low, high = rig.axes.insertion.limits
    nearest = min(max(goal, low), high)
    return nearest if abs(nearest - goal) <= _SDS * scenario.control.start_axial_sd_mm else goal


def check_advance(
    rig: RigFile, scenario: Scenario, move: AxisMove, before: Point | None, after: Point | None
) -> Point:
    """Return the tip (mm) after a motion forward. Raises RigError if it is not as far ahead as its axis has moved."""
    if before is None or after is None:
        raise RigError(
            f"tip: not measured during the motion forward: stopped: flexneedle rig check {rig.source}"
        )
    way = move.distance / axis_stretch(scenario.entry.slope)
    off, limit = after[0] - before[0] - way, max(_OFF * abs(way), _SDS * scenario.tracker.jitter_mm)
    if abs(off) > limit:
        rule = f"must be {way:.2f} mm with {move.name}, limit {limit:.2f} mm off"
        moved = f"tip: moved {after[0] - before[0]:.2f} mm"
        raise RigError(f"{moved}: {rule}: the rig file does not fit: flexneedle rig test {rig.source}")
    return after


def _move(rig: RigFile, name: str, position: float, goal: float) -> AxisMove | None:
    """Return the motion of an axis to a goal (mm or rad); None if it is there within its tolerance."""
    axis = dict(rig.axes.items())[name]
    if abs(goal - position) <= axis.tolerance:
        return None
    return plan_jog(rig, name, axis.to_text(goal), position, to=True)
