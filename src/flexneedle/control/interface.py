"""What every controller gets and gives; a method is a `begin` and a `decide`, in one file of `methods`."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexneedle.control.estimate import Estimate
from flexneedle.ports import Command
from flexneedle.scenario import Scenario
from flexneedle.simulator import Simulator, State
from flexneedle.trace import PlanRecord


@dataclass(frozen=True)
class Decision:
    """A command, why, its predicted cost, and the standard deviation left in the guide step (mm; NaN: none)."""

    command: Command
    why: str
    cost: float = math.nan
    spread: float = math.nan


@dataclass(frozen=True, eq=False)
class Task:
    """What a controller is to carry out, and its model as the scenario has it."""

    simulator: Simulator
    plan: PlanRecord

    @property
    def scenario(self) -> Scenario:
        """The scenario of model and settings."""
        return self.simulator.scenario


def travel_left(scenario: Scenario, plan: PlanRecord, state: State) -> float:
    """Advance (mm) to the target depth, or to the end of the stroke if that comes first."""
    stroke_left = scenario.start_base_x + scenario.setup.stroke_mm - float(state.base[0])
    return max(0.0, min(plan.target[0] - float(state.tip[0]), stroke_left))


def at_depth(task: Task, _memory: Any, estimate: Estimate) -> bool:
    """Whether the believed tip is at the target depth, within the tolerance, or past it, or the stroke is used up."""
    return travel_left(task.scenario, task.plan, estimate.state) <= task.scenario.control.depth_tolerance_mm


class Observer(Protocol):
    """What a controller lets be believed."""

    def begin(self, simulator: Simulator, bevel: int) -> Estimate:
        """The belief before the first reading."""
        ...


@dataclass(frozen=True)
class Method:
    """A controller. Memory is a frozen value of its own kind: what it carries from one period to the next.

    name: as in `--controller`; summary: one line for lists; beliefs: its observer;
    begin: memory at the start; decide: the next command and the memory after it; arrived: whether it is done;
    needs_guide: whether it is refused where the guide may not move.
    """

    name: str
    summary: str
    beliefs: Observer
    begin: Callable[[Task], Any]
    decide: Callable[[Task, Any, Estimate, np.random.Generator], tuple[Decision, Any]]
    arrived: Callable[[Task, Any, Estimate], bool] = at_depth
    needs_guide: bool = False
