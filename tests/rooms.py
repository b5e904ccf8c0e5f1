"""Environments and clocks for the tests of simulated trackers."""

from typing import Any

from flexneedle import load_scenario
from flexneedle.scenario.sections.environment import Environment

STILL: dict[str, Any] = {
    "name": "still",
    "tilt_mrad_per_mm": 0.0,
    "tilt_jitter_mrad": 0.0,
    "tip": {"bias_mm": 0.0, "jitter_mm": 0.0},
    "reference": {"bias_mm": 0.0, "jitter_mm": 0.0, "coils_mm": 0.0, "spacing_mm": 10.0},
}
"""A tracker without an error."""


def environment(**values: Any) -> Environment:
    """One that errs in nothing but `values`; tables go into the tables of `STILL`."""
    mixed = {
        key: STILL[key] | value if isinstance(value, dict) and key in STILL else value
        for key, value in values.items()
    }
    return Environment.model_validate(STILL | mixed)


def shipped(name: str) -> Environment:
    found = load_scenario("phantom").with_values({"tracker.environment": name}).tracker.environment
    assert found is not None
    return found


class ManualClock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def wait(self, seconds: float) -> None:
        self.time += seconds
