"""`open-loop`: the plan replayed, without regard to the tracker."""

import numpy as np

from flexneedle.control.interface import Controller, Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import MOVES, Limits
from flexneedle.types import Control


def decide(task: Task, done: int, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, int]:
    """Move base and guide to their positions after `done` + 1 planned steps.

    Positions are replayed, not steps: the rounding of a step by the motors is corrected in the next.
    """
    limits, controls = Limits.of(task.scenario), task.plan.controls
    goal = np.clip(controls[: done + 1, :MOVES].sum(axis=0), *limits.travel.T)
    moves = np.clip(goal - estimate.state.travel, -limits.step, limits.step)
    command = Control(*moves.tolist(), *controls[done, MOVES:].tolist())
    return Decision(command, f"planned step {done + 1}"), done + 1


def has_arrived(task: Task, done: int, _estimate: Estimate) -> bool:
    """Return whether all planned steps are done."""
    return done >= len(task.plan.controls)


CONTROLLER = Controller(
    "open-loop",
    "the plan replayed, without feedback",
    StateCorrection(),
    begin=lambda _task: 0,
    decide=decide,
    arrived=has_arrived,
)
