"""`open-loop`: the plan replayed, without regard to the tracker."""

import numpy as np

from flexneedle.control.interface import Controller, Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import MOVES, Limits
from flexneedle.types import DB_X, Control

_ARRIVED = 0.5  # of a step


def decide(task: Task, done: int, estimate: Estimate, _rng: np.random.Generator) -> tuple[Decision, int]:
    """Move base and guide to their positions after `done` + 1 planned steps.

    Positions are replayed, not steps: the rounding of a step by the motors is corrected in the next.
    """
    limits, controls = Limits.of(task.scenario), task.plan.controls
    done = min(done, len(controls) - 1)
    goal = np.clip(controls[: done + 1, :MOVES].sum(axis=0), *limits.travel.T)
    moves = np.clip(goal - estimate.state.travel, -limits.step, limits.step)
    command = Control(*moves.tolist(), *controls[done, MOVES:].tolist())
    return Decision(command, f"planned step {done + 1}"), done + 1


def has_arrived(task: Task, done: int, estimate: Estimate) -> bool:
    """Return whether all planned steps are done, and the base has advanced as planned: it may have been held."""
    controls, setup = task.plan.controls, task.scenario.setup
    left = min(float(controls[:, DB_X].sum()), setup.stroke_mm) - float(estimate.state.travel[DB_X])
    return done >= len(controls) and left <= _ARRIVED * setup.max_advance_mm


CONTROLLER = Controller(
    "open-loop",
    "the plan replayed, without feedback",
    StateCorrection(),
    begin=lambda _task: 0,
    decide=decide,
    arrived=has_arrived,
)
