"""Limits on the guide's motion: it moves if there is one, and if the plan's strategy moves it."""

from flexneedle.control.interface import Controller
from flexneedle.errors import InputError
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup

_STILL = "steering"  # the strategy with the bevel as the only input


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
