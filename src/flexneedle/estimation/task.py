"""The task of a controller."""

from dataclasses import dataclass
from typing import Any

from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator


@dataclass(frozen=True, eq=False)
class Task:
    """A plan, the scenario's model, and the controller's own settings.

    settings: checked, of the class `Controller.settings`; None for a controller without settings.
    """

    simulator: Simulator
    plan: Plan
    settings: Any = None

    @property
    def scenario(self) -> Scenario:
        """The scenario of model and settings."""
        return self.simulator.scenario

    def __repr__(self) -> str:
        return f"<Task {self.plan!r} in {self.scenario!r}>"
