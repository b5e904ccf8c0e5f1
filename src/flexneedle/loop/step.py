"""What the needle does in a control period: it moves as decided, rests, or is held."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexneedle.control.ahead import along_plan
from flexneedle.control.forecast import hopeless, likely_misses
from flexneedle.control.interface import Controller, Decision
from flexneedle.errors import InputError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import Decided, Stream
from flexneedle.loop.guard import Guard
from flexneedle.loop.progress import Late, Progress
from flexneedle.loop.rig import Rig
from flexneedle.types import STILL, Action


@dataclass(frozen=True)
class Step:
    """Action of a period, its decision, and the time (s) to wait in place of a move; None: a move.

    late: whether the decision took longer than the deadline.
    """

    action: Action
    decision: Decision
    wait: float | None = None
    late: bool = False

    def withheld(self, reason: str) -> "Step":
        """As the rig has not carried it out to its end."""
        return replace(self, decision=replace(self.decision, why=f"held by the rig: {reason}"))


@dataclass(frozen=True, eq=False)
class Steering:
    """What the steps of an insertion follow from.

    With `choices.force` it continues although a miss is predicted; the guard's limits hold in any case. Each decision
    of the controller, and the estimate that it is based on, goes to the stream before anything moves.
    """

    task: Task
    choices: Choices
    guard: Guard
    rng: np.random.Generator
    stream: Stream

    @property
    def controller(self) -> Controller:
        """Controller that decides."""
        return self.choices.controller

    def next_step(self, progress: Progress, rig: Rig, begun: float) -> tuple[Step, Progress]:
        """The step of the period that begins at `begun` (s), and the progress with the controller's decision."""
        reading = self.task.scenario.tracker.period
        if progress.hold is not None:
            why = f"held: measurement {progress.observation.verdict}"
            held = Decision(STILL, why, predicted=progress.predicted)
            return Step(Action.HOLD, held, reading), replace(progress, late=None)
        if progress.arrived_at is not None:
            delay = begun - progress.observation.measurement.time
            waiting = Decision(STILL, "waiting for the last reading", predicted=progress.predicted)
            return Step(Action.REST, waiting, max(reading, delay)), progress
        asked = self.stream.gate.hold()
        if not asked:
            step, decided = self._decided(replace(progress, asked=""), rig, begun)
            asked = self.stream.gate.hold()  # which may have come up while the controller decided
            if not asked:
                return step, decided
        held = Decision(STILL, f"held: {asked}", predicted=progress.predicted)
        return Step(Action.HOLD, held, reading), replace(progress, late=None, asked=asked)

    def _decided(self, progress: Progress, rig: Rig, begun: float) -> tuple[Step, Progress]:
        """The step of a decision: of the one that came late in the period before, if it still holds, or of a new one.

        While the controller decides, the needle rests. A decision later than the deadline ends the period, so that the
        tracker is read again before the needle moves.
        """
        estimate, late = progress.observation.estimate, progress.late
        if late is not None and late.holds_for(estimate):
            return self._carried_out(replace(progress, late=None), late.decision, late.memory)
        decision, memory = _decision(self.controller, self.task, progress.memory, estimate, self.rng)
        self.stream.send(Decided(decision, estimate))
        counted, taken = replace(progress, late=None, moves=progress.moves + 1), rig.clock.now() - begun
        if rig.deadline is None or taken <= rig.deadline:
            return self._carried_out(counted, decision, memory)
        why = f"late: decided in {taken:.3f} s, limit {rig.deadline:g} s"
        resting = Step(Action.REST, replace(decision, command=STILL, why=why), 0.0, late=True)
        return resting, replace(counted, late=Late.of(decision, memory, estimate))

    def _carried_out(self, progress: Progress, decision: Decision, memory: Any) -> tuple[Step, Progress]:
        """The step of a decision that is in time: a move, a rest, or a hold if it must not be carried out."""
        reason = self._refusal(progress.observation.estimate, decision)
        decided = replace(
            progress,
            memory=memory,
            refused=progress.refused.after(reason),
            moves=progress.moves - bool(reason),
            in_a_row=likely_misses(decision, progress.in_a_row),
            predicted=decision.predicted,
        )
        resting = replace(decision, command=STILL)
        if reason:
            held = replace(resting, why=f"held: {reason}")
            return Step(Action.HOLD, held, self.task.scenario.tracker.period), decided
        if decision.rest > 0.0:
            return Step(Action.REST, resting, decision.rest), decided
        return Step(Action.MOVE, decision), decided

    def _refusal(self, estimate: Estimate, decision: Decision) -> str:
        """Why a decision must not be carried out, or ""."""
        reason = "" if self.choices.force else hopeless(decision, self.task.scenario.control)
        if reason or decision.rest > 0.0:
            return reason
        return self.guard.refusal(estimate, decision.command)


def _decision(
    chosen: Controller, task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator
) -> tuple[Decision, Any]:
    """The controller's decision and its memory. Raises InputError if `decide` returns anything else."""
    match chosen.decide(task, memory, estimate, rng):
        case (Decision() as decision, after):
            return _with_shape(decision, task, estimate), after
    raise InputError(f"controller {chosen.name}: decide must return a Decision and the memory after it")


def _with_shape(decision: Decision, task: Task, estimate: Estimate) -> Decision:
    """The decision with a predicted shape: its own, or that at the end of the plan."""
    return (
        decision
        if decision.predicted is not None
        else replace(decision, predicted=along_plan(task, estimate))
    )
