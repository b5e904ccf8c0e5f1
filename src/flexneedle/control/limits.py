"""Limits of guide and rolls: the guide moves if the strategy moves it, the needle within the driver's range."""

import math

import numpy as np

from flexneedle.control.interface import Controller
from flexneedle.errors import InputError
from flexneedle.planning import STRATEGIES
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Floats

_TURN = 2.0 * math.pi
_NEAR = 1e-9  # rad: beyond the range by rounding
_STILL = STRATEGIES[1]


def guide_may_move(setup: Setup, strategy: str) -> bool:
    """Return whether the guide may move in an insertion that was planned with this strategy."""
    return setup.has_guide and strategy != _STILL


def largest_guide_step(setup: Setup, strategy: str) -> float:
    """Return the largest lateral travel (mm) of the guide in a control step; 0 if it may not move."""
    return setup.max_guide_step_mm if guide_may_move(setup, strategy) else 0.0


def guide_reach(scenario: Scenario, axis: int) -> tuple[float, float]:
    """Return the range (mm) of the guide's position on an axis, 0 or 1."""
    home, reach = scenario.guide_home, scenario.setup.max_guide_travel_mm
    middle = home.imag if axis else home.real
    return middle - reach, middle + reach


def guide_axes(setup: Setup, strategy: str) -> int:
    """Return the number of lateral axes on which the guide may move."""
    return setup.moved_guide_axes if strategy != _STILL else 0


def check_guide(controller: Controller, setup: Setup, strategy: str) -> None:
    """Raise InputError if a controller needs the guide and may not move it."""
    if not controller.needs_guide or guide_may_move(setup, strategy):
        return
    name = f"controller = {controller.name!r}: needs a guide that moves"
    if not setup.has_guide:
        raise InputError(f"{name}: set setup.guide_to_skin_mm")
    raise InputError(f"{name}, strategy = {strategy!r} does not move it: use 'manipulation'")


def check_tracker(controller: Controller, scenario: Scenario) -> None:
    """Raise InputError if a controller that does not fuse sensors along the needle has no tracker."""
    if not scenario.tracker.enabled and not controller.fuses:
        raise InputError(
            f"controller = {controller.name!r}: needs the tracker, and tracker.enabled = false: use 'adaptive-mpc'"
        )


def shorten_roll(setup: Setup, angle: Floats, roll: Floats) -> Floats:
    """Return the shortest rolls (rad) that turn bevels of needles at `angle` (rad) as `roll` does, within the range.

    They differ from `roll` by whole turns; where none of them ends in the range, `roll` is returned.
    """
    most = setup.max_rotation + _NEAR
    short = roll - _TURN * np.rint(roll / _TURN)
    long = short - np.copysign(_TURN, short)
    fits: Floats = np.where(
        np.abs(angle + short) <= most, short, np.where(np.abs(angle + long) <= most, long, roll)
    )
    return fits


def limit_roll(setup: Setup, angle: float, roll: float) -> float:
    """Return the shortest roll (rad) of a needle at `angle` (rad) that turns its bevel as `roll` does.

    Where no angle in the driver's range has that direction, the nearest possible roll; with half turns, `roll`.
    """
    if roll == 0.0 or setup.half_turns:
        return roll
    most, found = setup.max_rotation, float(shorten_roll(setup, np.asarray(angle), np.asarray(roll)))
    after = angle + found
    if abs(after) > most + _NEAR:
        after -= _TURN * round(after / _TURN)
    return min(most, max(-most, after)) - angle
