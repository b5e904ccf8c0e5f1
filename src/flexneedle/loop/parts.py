"""Controller, plant and tracker of an insertion: by name, as `module:NAME`, or as an object."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.interface import Controller
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS, PlantFactory
from flexneedle.plugins import find_part, function_rule, is_own, missing_parts, name_kind
from flexneedle.ports import TipTracker
from flexneedle.scenario.model import Scenario

TrackerFactory = Callable[[Scenario, Phantom, np.random.Generator], TipTracker]
"""Makes a tracker of the tip, from a scenario, the phantom (tip_at, pose_at, now) and a random generator."""

SCENARIO_TRACKER = "scenario"
"""Name of the tracker described by the scenario."""


def _controller_rule(found: Any) -> str:
    if isinstance(found, Controller):
        return ""
    missing = missing_parts(found, ("name", "summary", "decide"))
    return f"is {name_kind(found)}, not a flexneedle.Controller" + (
        f", missing: {missing}" if missing else ""
    )


def controller_of(given: str | Controller) -> tuple[str, Controller]:
    """Return a controller and its name in the record. Raises InputError if it is no controller."""
    return find_part("controller", given, CONTROLLERS, _controller_rule)


def plant_of(given: str | PlantFactory) -> tuple[str, PlantFactory]:
    """Return the name of a plant in the record, and its factory. Raises InputError if it is no factory."""
    return find_part("phantom", given, PLANTS, lambda found: function_rule(found, "truth", "roll"))


def tracker_of(given: str | TrackerFactory) -> tuple[str, TrackerFactory | None]:
    """Return the name of a tracker in the record, and its factory, None for the scenario's own.

    Raises InputError if it is no factory.
    """
    included: dict[str, TrackerFactory | None] = {SCENARIO_TRACKER: None}
    return find_part(
        "tracker", given, included, lambda found: function_rule(found, "scenario", "phantom", "rng")
    )


def own_controllers(given: Iterable[object]) -> tuple[Controller, ...]:
    """Return the controllers given as `module:NAME`, without duplicates. Raises InputError for an unsuitable object."""
    return tuple(dict.fromkeys(controller_of(str(name))[1] for name in given if is_own(name)))
