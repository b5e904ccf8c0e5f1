"""What a controller is to carry out."""

from dataclasses import dataclass
from typing import Any

from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Plan


@dataclass(frozen=True, eq=False)
class Task:
    """A plan, the model as the scenario has it, and the controller's own settings.

    settings: of the class that the `Method` names, checked; None for a controller without any.
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
