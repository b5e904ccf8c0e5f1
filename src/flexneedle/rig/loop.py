"""Closed-loop insertion with a driver and a tracker, by default those of the virtual phantom."""

import cmath
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.arguments import instance, whole
from flexneedle.control import tables
from flexneedle.control.ahead import along_plan
from flexneedle.control.forecast import hopeless, likely_misses, missed, warning
from flexneedle.control.guide import check_guide
from flexneedle.control.interface import Decision, Method, at_depth
from flexneedle.control.methods import DEFAULT, used
from flexneedle.errors import InputError, RunError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.planning.origin import check_origin, placed
from flexneedle.rig.measuring import Observation, observe, observe_before_start
from flexneedle.rig.monitor.monitor import Monitor
from flexneedle.rig.pace import travel_time
from flexneedle.rig.parts import controller_of
from flexneedle.rig.progress import Progress, hold_after
from flexneedle.rig.virtual import Rig
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import (
    STILL,
    UNKNOWN,
    Action,
    Control,
    Insertion,
    Lateral,
    Motion,
    Outcome,
    Period,
    Plan,
    Pose,
    X,
)

_MOST_MOVES = 4  # times the planned steps; then the insertion fails


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
    """Execute `plan` in closed loop on any rig; return the complete record.

    scenario, controller, force, threads, on_period: as for `insert`. rng: randomness of the controller; seed: only
    recorded.

    The driver is stopped at the end, after an error and after an interrupt.
    """
    scenario, plan, seed = load_scenario(scenario), planned(plan), whole("seed", seed, 0)
    rig = instance("rig", rig, Rig, "Rig(clock, driver, tracker), parts as in flexneedle.rig.ports")
    rng = instance("rng", rng, np.random.Generator, "such as numpy.random.default_rng(0)")
    scenario = placed(scenario, plan)
    check_origin(plan, scenario)
    name, chosen = controller_of(controller)
    check_guide(chosen, scenario.setup, plan.strategy)
    if not (plan.reached or force or chosen.predicts):
        raise RunError(
            f"plan misses the target by {plan.error_mm:.2f} mm (limit 1 mm), limited by {plan.limit}; "
            "use --force (force=True) to insert anyway"
        )
    scenario = used(scenario, chosen)
    task = tables.task(chosen, Simulator(scenario, threads), plan)
    periods: list[Period] = []
    ending = (Outcome.FAILED, f"target depth not reached within {_MOST_MOVES} times the planned steps")
    try:
        for period, ended in _periods(task, chosen, rig, rng, force=force):
            periods.append(period)
            ending = ended or ending
            if on_period is not None:
                on_period(period)
    finally:  # also after an error or an interrupt no motor goes on
        rig.driver.stop()
    insertion = Insertion(plan, seed, tuple(periods), *ending, name, scenario=scenario)
    if insertion.outcome is Outcome.DONE:
        line = missed(insertion.true_error_mm, math.dist(periods[-1].estimate.point, plan.target))
        return replace(insertion, reason="; ".join(filter(None, (insertion.reason, line))))
    return insertion


def planned(plan: object) -> Plan:
    return instance("plan", plan, Plan, "make one with flexneedle.plan(scenario)")


def _periods(
    task: Task, chosen: Method, rig: Rig, rng: np.random.Generator, *, force: bool
) -> Iterator[tuple[Period, tuple[Outcome, str] | None]]:
    """Yield each period with (outcome, reason) of the insertion, None while it continues.

    After the last move the needle rests until the tracker has measured it at rest, since readings are delayed.
    """
    memory, estimate, indices = chosen.begin(task), chosen.observer.begin(task), itertools.count()
    start = time.perf_counter()
    progress = _before_start(task.scenario, memory, estimate, rig)
    if (first := _first_step(progress)) is not None:
        clocks, observation = [start, start, start, time.perf_counter()], progress.observation
        yield (
            _record(next(indices), rig.clock.now(), task.plan, rig, first, STILL, observation, clocks),
            None,
        )
    for index in indices:
        if progress.moves == _MOST_MOVES * len(task.plan.controls):
            return
        clocks, begun = [time.perf_counter()], rig.clock.now()
        step, decided = _next_step(progress, task, chosen, rng, begun, force=force)
        clocks.append(time.perf_counter())
        if rig.expect is not None:
            rig.expect(progress.observation.estimate, step.decision.command)
        motion = _carry_out(task.scenario, rig, step.decision.command, step.wait)
        clocks.append(time.perf_counter())
        observation = _observed(progress.observation, task.scenario, rig, motion, begun)
        clocks.append(time.perf_counter())
        now = rig.clock.now()
        progress = _progress_after(decided, observation, task, chosen, begun, now)
        ending = _ending(task, progress)
        period = _record(index, now, task.plan, rig, step, motion.control, observation, clocks)
        yield replace(period, warning=warning(step.decision, progress.in_a_row)), ending
        if ending is not None:
            return


def _before_start(scenario: Scenario, memory: Any, estimate: Estimate, rig: Rig) -> Progress:
    """The progress after the measurement before the first motion."""
    monitor = Monitor(scenario.monitor, scenario.setup.axes)
    observation = observe_before_start(scenario, estimate, monitor, rig.clock.now(), rig.tracker)
    return Progress(observation, memory, hold_after(None, observation, rig.clock.now()))


def _first_step(progress: Progress) -> "_Step | None":
    """The step of the measurement before the first motion; None for a good reading of a tip alone: not recorded."""
    if progress.hold is None and progress.observation.measurement.frame is None:
        return None
    return _Step(Action.MEASURE, Decision(STILL, "measurement before the first motion"))


def _next_step(
    progress: Progress, task: Task, chosen: Method, rng: np.random.Generator, begun: float, *, force: bool
) -> tuple["_Step", Progress]:
    """The step of the period that begins at `begun` (s), and the progress with the controller's decision."""
    reading = task.scenario.tracker.period
    if progress.hold is not None:
        return _Step(Action.HOLD, Decision(STILL, "held", predicted=progress.predicted), reading), progress
    if progress.arrived_at is not None:
        delay = begun - progress.observation.measurement.time
        waiting = Decision(STILL, "waiting for the last reading", predicted=progress.predicted)
        return _Step(Action.REST, waiting, max(reading, delay)), progress
    decision, memory = _decided(chosen, task, progress.memory, progress.observation.estimate, rng)
    no_path = progress.no_path.after("" if force else hopeless(decision, task.scenario.control))
    moves, in_a_row = progress.moves + (not no_path.reason), likely_misses(decision, progress.in_a_row)
    decided = replace(
        progress,
        memory=memory,
        no_path=no_path,
        moves=moves,
        in_a_row=in_a_row,
        predicted=decision.predicted,
    )
    return _step(decision, no_path.reason, reading), decided


def _observed(before: Observation, scenario: Scenario, rig: Rig, motion: Motion, begun: float) -> Observation:
    """The observation after the motion of a period that began at `begun` (s)."""
    predicted = before.estimate.move(motion)
    return observe(scenario, predicted, before.monitor, begun, rig.clock.now(), rig.tracker)


def _progress_after(
    decided: Progress, observation: Observation, task: Task, chosen: Method, begun: float, now: float
) -> Progress:
    """The progress after a period from `begun` to `now` (s)."""
    arrived_at, arrived = decided.arrived_at, chosen.arrived
    if arrived_at is None and observation.verdict.ok and arrived(task, decided.memory, observation.estimate):
        arrived_at = now
    return replace(
        decided,
        observation=observation,
        hold=hold_after(decided.hold, observation, now),
        no_path=decided.no_path.extended(now - begun) if decided.decides else decided.no_path,
        arrived_at=arrived_at,
    )


def _decided(
    chosen: Method, task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator
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


@dataclass(frozen=True)
class _Step:
    """Action of a period, its decision, and the time (s) to wait in place of a move; 0: a move."""

    action: Action
    decision: Decision
    wait: float = 0.0


def _step(decision: Decision, no_path: str, reading: float) -> _Step:
    """The step for a decision; no_path: reason why no path reaches the target, or ""; reading: tracker period (s)."""
    at_rest = replace(decision, command=STILL)
    if no_path:
        return _Step(Action.HOLD, replace(at_rest, why=f"held: {no_path}"), reading)
    if decision.rest > 0.0:
        return _Step(Action.REST, at_rest, decision.rest)
    return _Step(Action.MOVE, decision)


def _carry_out(scenario: Scenario, rig: Rig, command: Control, wait: float) -> Motion:
    """Move, the travel in the time of its slowest axis, rounded up to whole tracker periods; or wait for `wait` (s)."""
    if wait > 0.0:
        begun = rig.clock.now()
        rig.clock.wait(wait)
        return Motion(command, begun, rig.clock.now())
    reading = scenario.tracker.period
    readings = math.ceil(travel_time(scenario.setup, command) / reading - 1e-6)
    motion = rig.driver.apply(command, max(1, readings) * reading)
    return instance("result of driver.apply", motion, Motion, "Motion(control, begun, ended, turned)")


def _pair(miss: float | complex) -> Lateral:
    """y, z of a miss (mm); z is 0 in the plane."""
    return UNKNOWN if cmath.isnan(miss) else (complex(miss).real, complex(miss).imag)


def _ending(task: Task, progress: Progress) -> tuple[Outcome, str] | None:
    """Outcome and reason if the insertion ends with this period."""
    observation, held = progress.observation, progress.held
    estimate, limit = observation.estimate, observation.hold_limit(task.scenario)
    if not estimate.state.converged:
        return Outcome.FAILED, f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    if held is not None and held > limit - 1e-9:
        return Outcome.HELD, f"held for {held:.2f} s (limit {limit:g} s): {observation.verdict}"
    if not progress.measured_at_rest:
        return progress.no_path.ending(task.scenario.control.hold_limit_s)
    short = task.plan.target[0] - float(estimate.tip[X])
    if short > task.scenario.control.depth_tolerance_mm and at_depth(task, None, estimate):
        return Outcome.DONE, f"stroke ends {short:.2f} mm before the target depth"
    return Outcome.DONE, ""


def _record(
    index: int,
    now: float,
    plan: Plan,
    rig: Rig,
    step: _Step,
    applied: Control,
    observation: Observation,
    clocks: list[float],
) -> Period:
    estimate = observation.estimate
    state, truth = estimate.state, None if rig.truth is None else rig.truth()
    return Period(
        index=index,
        time=now,
        command=step.decision.command,
        applied=applied,
        measurement=observation.measurement,
        verdict=observation.verdict,
        readings=observation.readings,
        innovation=estimate.innovation,
        estimate=Pose.of(estimate.tip),
        shape=state.nodes,
        base=Pose.of(state.base),
        guide=state.guide,
        roll=state.roll,
        strain_energy=state.strain_energy,
        tip_load=state.tip_load,
        path=Pose.of(np.interp(state.tip[X], plan.tips[:, X], column) for column in plan.tips.T),
        cost=step.decision.cost,
        spread=step.decision.spread,
        action=step.action,
        decision=step.decision.why,
        miss=_pair(step.decision.miss),
        miss_sd=step.decision.miss_sd,
        predicted=step.decision.predicted,
        true_tip=None if truth is None else Pose.of(truth.tip),
        true_strain_energy=None if truth is None else truth.strain_energy,
        true_stretch=None if truth is None else truth.least_stretch,
        true_shape=None if truth is None else truth.shape,
        durations={
            "decide": clocks[1] - clocks[0],
            "apply": clocks[2] - clocks[1],
            "observe": clocks[3] - clocks[2],
            "total": clocks[1] - clocks[0] + clocks[3] - clocks[2],
        },
        converged=state.converged and (truth is None or truth.converged),
    )
