"""Conformance kit of `Controller`."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from flexneedle.control.controllers import check_tables
from flexneedle.control.interface import Controller, Decision
from flexneedle.errors import CommandError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.loop.insertions import insert
from flexneedle.loop.virtual import VirtualRig
from flexneedle.planning.planner import plan
from flexneedle.results import Insertion, Outcome, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.control import MOVES, Limits
from flexneedle.testing.checks import require, require_finite, short_scenario
from flexneedle.types import X

_ARRAYS = ("controls", "tips", "guide", "strain_energy", "least_stretch", "shapes")
_MOST_CALLS = 300
_DEPTH_MM = 0.5


@dataclass(frozen=True, eq=False)
class _Call:
    """One call of `decide`, with the randomness before it."""

    task: Task
    memory: Any
    estimate: Estimate
    rng: np.random.Generator
    decision: Decision
    after: Any


@dataclass(frozen=True, eq=False)
class _Run:
    """An insertion, the calls of its controller, and the arrays of the plan before it."""

    insertion: Insertion
    before: dict[str, Any]
    calls: tuple[_Call, ...]


class ControllerConformance:
    """Checks of a controller, by insertions into a virtual phantom without errors. `make` returns the controller.

    Attributes:
        scenario: Scenario of the insertions (default: the shipped phantom with a target at 10 mm).
        strategy: Strategy of the plan.
        error_mm: Largest distance of the tip from the target at the end (mm).
    """

    scenario: Scenario | None = None
    strategy = "manipulation"
    error_mm = 2.0

    def make(self) -> Controller:
        """Return the controller."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def _plan(self) -> Plan:
        return _make_plan(self.scenario, self.strategy)

    @classmethod
    @cache
    def _run(cls, seed: int = 0, repeat: int = 0) -> _Run:
        """Return an insertion with a seed, made once for each number of its repetition."""
        del repeat
        kit = cls()
        return _insert(kit.make(), kit.scenario or short_scenario(), kit._plan(), seed)

    def test_is_a_controller(self) -> None:
        """Require a `Controller` whose settings have valid defaults in the scenario."""
        made = self.make()
        require(isinstance(made, Controller), f"make must return a Controller, not {type(made).__name__}")
        check_tables(self.scenario or short_scenario(), made)

    def test_decides_with_a_reason(self) -> None:
        """Require decisions, each with a reason in one line."""
        for call in self._run().calls:
            require(
                isinstance(call.decision, Decision), f"decide must return a Decision, not {call.decision!r}"
            )
            why = call.decision.why
            require(why.isprintable() and why.strip(), f"why must be one line of text, not {why!r}")

    def test_commands_keep_the_limits(self) -> None:
        """Require commands within the limits of `[setup]`, in steps and in sum."""
        run = self._run()
        limits = Limits.of(run.calls[0].task.scenario)
        moved, rolled = np.zeros(MOVES), self._plan().roll
        for call in run.calls:
            row = np.array(call.decision.command)
            try:
                limits.check(moved, row[None, :], rolled)
            except CommandError as error:
                raise AssertionError(f"a command must keep the limits of the setup: {error}") from error
            moved, rolled = moved + row[:MOVES], rolled + float(row[MOVES:].sum())

    def test_ends_at_the_target(self) -> None:
        """Require the outcome "done", at the target depth and within `error_mm` of the target."""
        insertion = self._run().insertion
        require(
            insertion.outcome is Outcome.DONE, f"the insertion ended {insertion.outcome}: {insertion.reason}"
        )
        tip = insertion.periods[-1].true_tip
        depth = float("nan") if tip is None else tip[X]
        off = abs(depth - insertion.target[X])
        require(
            off <= _DEPTH_MM, f"the insertion ended at {depth} mm, the target is at {insertion.target[X]} mm"
        )
        error = insertion.true_error_mm
        require(
            error <= self.error_mm, f"the tip ended {error} mm off the target, at most {self.error_mm} mm"
        )

    def test_same_seed_same_decisions(self) -> None:
        """Require equal insertions with the same seed, whatever the state of global generators and before it."""
        state = np.random.get_state()  # noqa: NPY002  shall have no effect
        try:
            np.random.seed(1)  # noqa: NPY002
            again = self._run(repeat=1)
        finally:
            np.random.set_state(state)  # noqa: NPY002
        first, second = ([call.decision.command for call in run.calls] for run in (self._run(), again))
        require(first == second, "the same seed must give the same commands: keep nothing between insertions")

    def test_decision_follows_from_its_arguments(self) -> None:
        """Require that a repeated call with equal arguments returns an equal decision, and changes none of them."""
        calls = self._run().calls
        for call in (calls[0], calls[len(calls) // 2], calls[-1]):
            made = self.make()
            memory = copy.deepcopy(call.memory)
            decision, _ = made.decide(call.task, call.memory, call.estimate, copy.deepcopy(call.rng))
            same = (decision.command, decision.why) == (call.decision.command, call.decision.why)
            require(
                same,
                f"decide must depend on its arguments alone: {call.decision.command}, {decision.command}",
            )
            require(
                repr(memory) == repr(call.memory),
                "decide must return a new memory, and not change the old one",
            )

    def test_plan_is_not_changed(self) -> None:
        """Require that the arrays of the plan are as before."""
        run = self._run()
        for name, before in run.before.items():
            same = np.array_equal(before, getattr(run.insertion.plan, name))
            require(same, f"decide must not change plan.{name}")

    def test_predictions_are_numbers(self) -> None:
        """Require a predicted miss in each decision of a controller with `predicts`."""
        if self.make().predicts:
            for call in self._run().calls:
                require_finite("miss", [complex(call.decision.miss).real, complex(call.decision.miss).imag])
                require_finite("miss_sd", call.decision.miss_sd)


@cache
def _make_plan(scenario: Scenario | None, strategy: str) -> Plan:
    return plan(scenario or short_scenario(), strategy=strategy, seed=0)


def _insert(controller: Controller, scenario: Scenario, planned: Plan, seed: int) -> _Run:
    planned = copy.deepcopy(planned)  # a controller may change it
    arrays = {name: getattr(planned, name).copy() for name in _ARRAYS}
    with _record_calls(controller) as calls:
        insertion = insert(
            scenario, planned, seed, controller=controller, rig=VirtualRig("model"), force=True, threads=1
        )
    return _Run(insertion, arrays, tuple(calls))


@contextmanager
def _record_calls(controller: Controller) -> Iterator[list[_Call]]:
    """Record the calls of `decide`, of the object itself: a copy would be another controller of this name."""
    calls: list[_Call] = []
    original = controller.decide

    def decide(task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator) -> tuple[Decision, Any]:
        require(
            len(calls) < _MOST_CALLS,
            f"the insertion must end: {_MOST_CALLS} decisions did not reach the target",
        )
        before = copy.deepcopy(rng)
        decision, after = original(task, memory, estimate, rng)
        calls.append(_Call(task, memory, estimate, before, decision, after))
        return decision, after

    object.__setattr__(controller, "decide", decide)
    try:
        yield calls
    finally:
        object.__setattr__(controller, "decide", original)
