"""Carry out an insertion: the closed loop against a driver and a tracker, by default the virtual phantom's."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.arguments import instance, whole
from flexneedle.control import tables
from flexneedle.control.forecast import hopeless, likely_misses, missed, warning
from flexneedle.control.guide import check_guide
from flexneedle.control.interface import Decision, Method, at_depth
from flexneedle.control.methods import DEFAULT, used
from flexneedle.errors import InputError, RunError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.planning.origin import check_origin
from flexneedle.rig.measuring import Observation, look_around, see
from flexneedle.rig.monitor.watch import Watch
from flexneedle.rig.parts import SCENARIO_TRACKER, TrackerFactory, controller_of, plant_of, tracker_of
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PlantFactory
from flexneedle.rig.virtual import Rig, Seeds, virtual_rig
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Action, Command, Insertion, Outcome, Period, Plan

_TOO_MANY = 4  # times the planned periods: the loop is not getting there
_STILL: Command = (0.0, 0.0, 0.0, 0.0, -1)


def insert(
    scenario: str | Path | Scenario,
    plan: Plan,
    seed: int = 0,
    *,
    controller: str | Method = DEFAULT,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    tracker: str | TrackerFactory = SCENARIO_TRACKER,
    force: bool = False,
    threads: int | None = None,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` in closed loop against the virtual phantom that `seed` draws; returns the whole record.

    scenario: also by its name or path, as for `load_scenario`; the one that the plan was made for, or one that differs
    in no more than controller, tracker, monitor and phantom.
    controller: one of `control.methods.METHODS`; phantom: "exact" or "model", the formulation of the plant; tracker:
    "scenario", the one that is described there. Each may be an object of your own, too, or its name `module:NAME`
    (docs/extend.md).
    `threads` is for rollouts (default: all cores) and changes no result. `on_period` gets each control period as
    it ends. Raises InputError for an unknown name or an object that is none, for a plan of another scenario, and for a
    controller that needs the guide where it may not move, ScenarioError for a setting that the controllers refuse,
    RunError if the plan misses its target by more than 1 mm, unless `force` or the controller predicts the miss itself,
    as the default does. Same seed, same record, but for wall-clock durations.
    """
    scenario, plan, seed = load_scenario(scenario), _planned(plan), whole("seed", seed, 0)
    phantom_seed, tracker_seed, control_seed, room_seed = np.random.SeedSequence(seed).spawn(4)
    plant_name, plant = plant_of(phantom)
    tracker_name, own_tracker = tracker_of(tracker)
    seeds = Seeds(phantom_seed, tracker_seed, room_seed)
    rig = virtual_rig(scenario, plan.bevel, seeds, plant, tracker=own_tracker)
    rng = np.random.default_rng(control_seed)
    insertion = run(
        scenario,
        plan,
        rig,
        rng,
        seed,
        controller=controller,
        force=force,
        threads=threads,
        on_period=on_period,
    )
    return replace(insertion, phantom=plant_name, tracker=tracker_name)


def run(
    scenario: str | Path | Scenario,
    plan: Plan,
    rig: Rig,
    rng: np.random.Generator,
    seed: int = 0,
    *,
    controller: str | Method = DEFAULT,
    force: bool = False,
    threads: int | None = None,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` on any rig; as `insert`.

    rng: for the controller; seed: for the record alone.
    """
    scenario, plan, seed = load_scenario(scenario), _planned(plan), whole("seed", seed, 0)
    rig = instance("rig", rig, Rig, "Rig(clock, driver, tracker), of what flexneedle.rig.ports describes")
    rng = instance("rng", rng, np.random.Generator, "such as numpy.random.default_rng(0)")
    check_origin(plan, scenario)
    name, chosen = controller_of(controller)
    check_guide(chosen, scenario.setup, plan.strategy)
    if not (plan.reached or force or chosen.predicts):
        raise RunError(
            f"plan misses the target by {plan.error_mm:.2f} mm (limit 1 mm), bound by {plan.limit}; "
            "use --force (force=True) to insert anyway"
        )
    scenario = used(scenario, chosen)
    task = tables.task(chosen, Simulator(scenario, threads), plan)
    periods: list[Period] = []
    ending = (Outcome.FAILED, "not at the target depth after four times the planned periods")
    for period, so_far in _periods(task, chosen, rig, rng, force=force):
        periods.append(period)
        ending = so_far or ending
        if on_period is not None:
            on_period(period)
    insertion = Insertion(plan, seed, tuple(periods), *ending, name, scenario=scenario)
    if insertion.outcome is Outcome.DONE:
        line = missed(insertion.true_error_mm, math.dist(periods[-1].estimate[:2], plan.target))
        return replace(insertion, reason="; ".join(filter(None, (insertion.reason, line))))
    return insertion


def _planned(plan: object) -> Plan:
    return instance("plan", plan, Plan, "make one with flexneedle.plan(scenario)")


def _periods(
    task: Task, chosen: Method, rig: Rig, rng: np.random.Generator, *, force: bool
) -> Iterator[tuple[Period, tuple[Outcome, str] | None]]:
    """Yield each period, and how the insertion ended with it: (outcome, reason), None while it goes on.

    After the last move the needle rests until the tracker has measured it at rest: readings come late.
    """
    scenario, memory = task.scenario, chosen.begin(task)
    belief = chosen.observer.begin(task)
    start = time.perf_counter()
    sight = look_around(scenario, belief, Watch(scenario.monitor), rig.clock.now(), rig.tracker)
    held, indices = _held(None, sight, rig.clock.now()), itertools.count()
    if (
        held is not None or sight.sample.frame is not None
    ):  # a tip alone that is where it should be is no news
        clocks = [start, start, start, time.perf_counter()]
        step = _Step(Action.MEASURE, Decision(_STILL, "measures before it moves"))
        yield _record(next(indices), rig.clock.now(), task.plan, rig, step, _STILL, sight, clocks), None
    arrived_at: float | None = None
    lost = _Lost()
    moves = in_a_row = 0
    for index in indices:
        if moves == _TOO_MANY * len(task.plan.controls):
            return
        clocks = [time.perf_counter()]
        begun, reading = rig.clock.now(), scenario.tracker.period
        decides = held is None and arrived_at is None
        if held is not None:
            step = _Step(Action.HOLD, Decision(_STILL, "held"), reading)
        elif arrived_at is not None:
            late = begun - sight.sample.time
            step = _Step(Action.REST, Decision(_STILL, "at rest for the last reading"), max(reading, late))
        else:
            decision, memory = _decided(chosen, task, memory, sight.estimate, rng)
            in_a_row = likely_misses(decision, in_a_row)
            lost = lost.after("" if force else hopeless(decision, scenario.control))
            step = _step(decision, lost.why, reading)
            moves += not lost.why
        clocks.append(time.perf_counter())
        applied = _carry_out(scenario, rig, step.decision.command, step.wait)
        clocks.append(time.perf_counter())
        moved = sight.estimate.move(applied, begun, rig.clock.now())
        sight = see(scenario, moved, sight.watch, begun, rig.clock.now(), rig.tracker)
        clocks.append(time.perf_counter())
        now, good = rig.clock.now(), sight.verdict.ok
        held = _held(held, sight, now)
        if arrived_at is None and good and chosen.arrived(task, memory, sight.estimate):
            arrived_at = now
        seen = arrived_at is not None and good and sight.saw_after(arrived_at)
        ending = _ending(task, sight, None if held is None else held.lasted(sight.field), seen)
        lost = lost.lasting(now - begun) if decides else lost
        ending = ending or lost.ending(scenario.control.hold_limit_s)
        period = _record(index, now, task.plan, rig, step, applied, sight, clocks)
        yield replace(period, warning=warning(step.decision, in_a_row)), ending
        if ending is not None:
            return


def _decided(
    chosen: Method, task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator
) -> tuple[Decision, Any]:
    """What the controller decides. Raises InputError if that is nothing to carry out."""
    match answer := chosen.decide(task, memory, estimate, rng):
        case (Decision(), _):
            return answer
    raise InputError(f"controller {chosen.name}: decide must return a Decision and the memory after it")


@dataclass(frozen=True)
class _Step:
    """What a period does: its action, the decision behind it, and for how long it waits instead of a move (s)."""

    action: Action
    decision: Decision
    wait: float = 0.0


def _step(decision: Decision, lost: str, reading: float) -> _Step:
    """What follows from a decision; lost: why no path leads to the target, or ""; reading: the tracker's period (s)."""
    still = replace(decision, command=_STILL)
    if lost:
        return _Step(Action.HOLD, replace(still, why=f"held: {lost}"), reading)
    if decision.rest > 0.0:
        return _Step(Action.REST, still, decision.rest)
    return _Step(Action.MOVE, decision)


@dataclass(frozen=True)
class _Held:
    """A needle that is held: for how long (s) for the field and for readings, and for which of them since `at`."""

    at: float
    field: bool
    for_field: float = 0.0
    for_readings: float = 0.0

    def lasted(self, field: bool) -> float:
        """For how long it has been held for one of the two causes (s)."""
        return self.for_field if field else self.for_readings


@dataclass(frozen=True)
class _Lost:
    """Why no path leads to the target, empty if one does, and for how long (s) the needle has been held for that.

    The clock stands while the needle is held for the tracker; a decision that finds a path sets it back.
    """

    why: str = ""
    lasted: float = 0.0

    def after(self, why: str) -> "_Lost":
        """After a decision."""
        return _Lost(why, self.lasted) if why else _Lost()

    def lasting(self, seconds: float) -> "_Lost":
        """After a period that was held, or that was not."""
        return _Lost(self.why, self.lasted + seconds) if self.why else self

    def ending(self, limit: float) -> tuple[Outcome, str] | None:
        """How the insertion ends, if it has lasted for `limit` (s)."""
        return (Outcome.HELD, self.why) if self.why and self.lasted > limit - 1e-9 else None


def _held(held: _Held | None, sight: Observation, now: float) -> _Held | None:
    """The hold after a verdict. Each of the two causes has a clock and a limit of its own; a clock stops while the
    needle is held for the other cause, and only a good verdict sets it back: alternating causes do not hold forever.
    """
    if sight.verdict.ok:
        return None
    if held is None:
        return _Held(now, sight.field)
    passed = now - held.at
    return _Held(
        now,
        sight.field,
        held.for_field + (passed if held.field else 0.0),
        held.for_readings + (0.0 if held.field else passed),
    )


def _carry_out(scenario: Scenario, rig: Rig, command: Command, wait: float) -> Command:
    """Move, for as long as the speed asks, rounded up to whole readings of the tracker; or wait so long (s)."""
    if wait > 0.0:
        rig.clock.wait(wait)
        return command
    reading = scenario.tracker.period
    readings = math.ceil(abs(command[0]) / scenario.setup.insertion_speed_mm_s / reading - 1e-6)
    return rig.driver.apply(command, max(1, readings) * reading)


def _ending(task: Task, sight: Observation, held: float | None, seen: bool) -> tuple[Outcome, str] | None:
    """How the insertion ends after this period, if it does; held: for how long it has been (s), None if it is not."""
    estimate, limit = sight.estimate, sight.limit(task.scenario)
    if not estimate.state.converged:
        return Outcome.FAILED, f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    if held is not None and held > limit - 1e-9:
        return Outcome.HELD, f"held for {held:.2f} s (limit {limit:g} s): {sight.verdict}"
    if not seen:
        return None
    short = task.plan.target[0] - float(estimate.tip[0])
    if short > task.scenario.control.depth_tolerance_mm and at_depth(task, None, estimate):
        return Outcome.DONE, f"the stroke ends {short:.2f} mm before the target depth"
    return Outcome.DONE, ""


def _record(
    index: int,
    now: float,
    plan: Plan,
    rig: Rig,
    step: _Step,
    applied: Command,
    sight: Observation,
    clocks: list[float],
) -> Period:
    estimate = sight.estimate
    state, truth = estimate.state, None if rig.truth is None else rig.truth()
    return Period(
        index=index,
        time=now,
        command=step.decision.command,
        applied=applied,
        sample=sight.sample,
        verdict=sight.verdict,
        readings=sight.readings,
        innovation=estimate.innovation,
        estimate=_pose(estimate.tip),
        shape=state.nodes,
        base=_pose(state.base),
        guide=state.guide,
        bevel=state.bevel,
        strain_energy=state.strain_energy,
        tip_load=state.tip_load,
        path=_pose([np.interp(state.tip[0], plan.tips[:, 0], plan.tips[:, k]) for k in range(3)]),
        cost=step.decision.cost,
        spread=step.decision.spread,
        action=step.action,
        decision=step.decision.why,
        miss=step.decision.miss,
        miss_sd=step.decision.miss_sd,
        true_tip=None if truth is None else _pose(truth.tip),
        true_strain_energy=None if truth is None else truth.strain_energy,
        true_stretch=None if truth is None else truth.least_stretch,
        durations={
            "decide": clocks[1] - clocks[0],
            "apply": clocks[2] - clocks[1],
            "observe": clocks[3] - clocks[2],
            "total": clocks[1] - clocks[0] + clocks[3] - clocks[2],
        },
        converged=state.converged and (truth is None or truth.converged),
    )


def _pose(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, turn = (float(value) for value in values)
    return x, y, turn
