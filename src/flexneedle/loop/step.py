"""The step of a control period: the needle moves as decided, rests, or is held."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexneedle.control.ahead import predict_planned_shape
from flexneedle.control.forecast import count_likely_misses, reason_to_hold
from flexneedle.control.interface import Controller, Decision
from flexneedle.errors import InputError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import Decided, Stream
from flexneedle.loop.guard import Guard
from flexneedle.loop.loop_state import LateDecision, LoopState
from flexneedle.loop.rig import Rig
from flexneedle.results import Action
from flexneedle.types import STILL


@dataclass(frozen=True)
class Step:
    """Action of a period, its decision, and the time (s) to wait in place of a move; None: a move.

    late: true if the decision took longer than the deadline.
    """

    action: Action
    decision: Decision
    wait: float | None = None
    late: bool = False

    def hold_back(self, reason: str) -> "Step":
        """Return this step with the reason of the rig, which has not carried it out to its end."""
        return replace(self, decision=replace(self.decision, why=f"held by the rig: {reason}"))


@dataclass(frozen=True, eq=False)
class Steering:
    """Task, choices, guard and randomness of an insertion, and the stream of its events.

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

    def next_step(self, state: LoopState, rig: Rig, begun: float) -> tuple[Step, LoopState]:
        """Return the step of the period that begins at `begun` (s), and the state with the controller's decision."""
        reading = self.task.scenario.tracker.period
        if state.hold is not None:
            why = f"held: measurement {state.observation.verdict}"
            held = Decision(STILL, why, predicted=state.predicted)
            return Step(Action.HOLD, held, reading), replace(state, late=None)
        if state.arrived_at is not None:
            delay = begun - state.observation.newest
            if self.task.scenario.sensor:
                delay = min(delay, self.task.scenario.longest_wait)
            waiting = Decision(STILL, "waiting for the last reading", predicted=state.predicted)
            return Step(Action.REST, waiting, max(reading, delay)), state
        asked = self.stream.gate.hold()
        if not asked:
            step, decided = self._decide(replace(state, asked=""), rig, begun)
            asked = self.stream.gate.hold()  # which may have come up while the controller decided
            if not asked:
                return step, decided
        held = Decision(STILL, f"held: {asked}", predicted=state.predicted)
        return Step(Action.HOLD, held, reading), replace(state, late=None, asked=asked)

    def _decide(self, state: LoopState, rig: Rig, begun: float) -> tuple[Step, LoopState]:
        """Return the step of a late decision that still holds, or of a new one; a rest if that comes late."""
        estimate, late = state.observation.estimate, state.late
        if late is not None and late.holds_for(estimate):
            return self._act_on(replace(state, late=None), late.decision, late.memory)
        decision, memory = _ask_controller(self.controller, self.task, state.memory, estimate, self.rng)
        self.stream.send(Decided(decision, estimate))
        counted, taken = replace(state, late=None, moves=state.moves + 1), rig.clock.now() - begun
        if rig.deadline is None or taken <= rig.deadline:
            return self._act_on(counted, decision, memory)
        why = f"late: decided in {taken:.3f} s, limit {rig.deadline:.3f} s"
        resting = Step(Action.REST, replace(decision, command=STILL, why=why), 0.0, late=True)
        return resting, replace(counted, late=LateDecision.of(decision, memory, estimate))

    def _act_on(self, state: LoopState, decision: Decision, memory: Any) -> tuple[Step, LoopState]:
        """Return the step of a decision that is in time: a move, a rest, or a hold if it must not be carried out."""
        reason = self._refusal(state.observation.estimate, decision)
        decided = replace(
            state,
            memory=memory,
            refused=state.refused.after(reason),
            moves=state.moves - bool(reason),
            in_a_row=count_likely_misses(decision, state.in_a_row),
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
        """Return the reason to refuse a decision, "" for none."""
        reason = "" if self.choices.force else reason_to_hold(decision, self.task.scenario.control)
        if reason or decision.rest > 0.0:
            return reason
        return self.guard.refusal(estimate, decision.command)


def _ask_controller(
    chosen: Controller, task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator
) -> tuple[Decision, Any]:
    """Return the controller's decision, with the planned shape if it predicts none, and its memory.

    Raises InputError if `decide` returns anything else.
    """
    match chosen.decide(task, memory, estimate, rng):
        case (Decision() as decision, after):
            if decision.predicted is None:
                decision = replace(decision, predicted=predict_planned_shape(task, estimate))
            return decision, after
    raise InputError(f"controller {chosen.name}: decide must return a Decision and the memory after it")
