"""Trackers of the tip by name, as `module:NAME`, or as factories."""

from collections.abc import Callable

import numpy as np

from flexneedle.phantom.phantom import Phantom
from flexneedle.plugins import find_part, function_rule
from flexneedle.ports import TipTracker
from flexneedle.scenario.model import Scenario

TipTrackerFactory = Callable[[Scenario, Phantom, np.random.Generator], TipTracker]
"""Makes a tracker of the tip, from a scenario, the phantom (tip_at, pose_at, now) and a random generator."""

SCENARIO_TRACKER = "scenario"
"""Name of the tracker that the scenario describes."""

_INCLUDED: dict[str, TipTrackerFactory | None] = {SCENARIO_TRACKER: None}


def find_tracker(given: str | TipTrackerFactory) -> tuple[str, TipTrackerFactory | None]:
    """Return the name of a tracker in records, and its factory; None for the tracker of the scenario.

    Args:
        given: `SCENARIO_TRACKER`, `module:NAME`, or a factory.

    Raises:
        InputError: There is no such tracker.
    """
    return find_part(
        "tracker", given, _INCLUDED, lambda found: function_rule(found, "scenario", "phantom", "rng")
    )
