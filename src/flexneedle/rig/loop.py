"""Closed-loop insertion with a driver and a tracker, by default those of the virtual phantom."""

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
from flexneedle.rig.measuring import Observation, observe, observe_before_start
from flexneedle.rig.monitor.monitor import Monitor
from flexneedle.rig.parts import SCENARIO_TRACKER, TrackerFactory, controller_of, plant_of, tracker_of
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PlantFactory
from flexneedle.rig.virtual import Rig, Seeds, virtual_rig
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Action, Command, Insertion, Outcome, Period, Plan

_MOST_MOVES = 4  # times the planned steps; then the insertion fails
_AT_REST: Command = (0.0, 0.0, 0.0, 0.0, -1)


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
    """Execute `plan` in closed loop in the virtual phantom drawn with `seed`; return the complete record.

    scenario: a scenario, or its name or path as for `load_scenario`. It must be the plan's own, or differ from it only
    in controller, tracker, monitor and phantom.
    controller: one of `control.methods.METHODS`; phantom: "exact" or "model", the formulation of the plant; tracker:
    "scenario", the one that the scenario describes. Each may also be an object of your own or its name `module:NAME`
    (docs/extend.md).
    threads: for rollouts (default: all cores), without effect on the result. on_period: called with each control
    period when it ends.

    The record is the same for the same seed, except for wall-clock durations.

    Raises InputError for an unknown name, an unsuitable object, a plan of another scenario, or a controller that needs
    the guide where it may not move; ScenarioError for a setting that the controllers reject; RunError if the plan
    misses its target by more than 1 mm, unless `force` is set or the controller predicts the miss itself, as the
    default one does.
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
    """As `insert`, on any rig. rng: randomness of the controller; seed: only recorded."""
    scenario, plan, seed = load_scenario(scenario), _planned(plan), whole("seed", seed, 0)
    rig = instance("rig", rig, Rig, "Rig(clock, driver, tracker), parts as in flexneedle.rig.ports")
    rng = instance("rng", rng, np.random.Generator, "such as numpy.random.default_rng(0)")
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
    for period, ended in _periods(task, chosen, rig, rng, force=force):
        periods.append(period)
        ending = ended or ending
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
    """Yield each period with (outcome, reason) of the insertion, None while it continues.

    After the last move the needle rests until the tracker has measured it at rest, since readings are delayed.
    """
    scenario, memory = task.scenario, chosen.begin(task)
    estimate, monitor = chosen.observer.begin(task), Monitor(scenario.monitor)
    start = time.perf_counter()
    observation = observe_before_start(scenario, estimate, monitor, rig.clock.now(), rig.tracker)
    hold, indices = _hold(None, observation, rig.clock.now()), itertools.count()
    if (
        hold is not None or observation.measurement.frame is not None
    ):  # a good reading of a tip alone is not recorded
        clocks = [start, start, start, time.perf_counter()]
        step = _Step(Action.MEASURE, Decision(_AT_REST, "measurement before the first motion"))
        yield (
            _record(next(indices), rig.clock.now(), task.plan, rig, step, _AT_REST, observation, clocks),
            None,
        )
    arrived_at: float | None = None
    no_path = _NoPath()
    moves = in_a_row = 0
    for index in indices:
        if moves == _MOST_MOVES * len(task.plan.controls):
            return
        clocks = [time.perf_counter()]
        begun, reading = rig.clock.now(), scenario.tracker.period
        decides = hold is None and arrived_at is None
        if hold is not None:
            step = _Step(Action.HOLD, Decision(_AT_REST, "held"), reading)
        elif arrived_at is not None:
            delay = begun - observation.measurement.time
            step = _Step(Action.REST, Decision(_AT_REST, "waiting for the last reading"), max(reading, delay))
        else:
            decision, memory = _decided(chosen, task, memory, observation.estimate, rng)
            in_a_row = likely_misses(decision, in_a_row)
            no_path = no_path.after("" if force else hopeless(decision, scenario.control))
            step = _step(decision, no_path.reason, reading)
            moves += not no_path.reason
        clocks.append(time.perf_counter())
        applied = _carry_out(scenario, rig, step.decision.command, step.wait)
        clocks.append(time.perf_counter())
        predicted = observation.estimate.move(applied, begun, rig.clock.now())
        observation = observe(scenario, predicted, observation.monitor, begun, rig.clock.now(), rig.tracker)
        clocks.append(time.perf_counter())
        now, good = rig.clock.now(), observation.verdict.ok
        hold = _hold(hold, observation, now)
        if arrived_at is None and good and chosen.arrived(task, memory, observation.estimate):
            arrived_at = now
        measured = arrived_at is not None and good and observation.has_good_reading_after(arrived_at)
        ending = _ending(
            task, observation, None if hold is None else hold.duration(observation.field), measured
        )
        no_path = no_path.extended(now - begun) if decides else no_path
        ending = ending or no_path.ending(scenario.control.hold_limit_s)
        period = _record(index, now, task.plan, rig, step, applied, observation, clocks)
        yield replace(period, warning=warning(step.decision, in_a_row)), ending
        if ending is not None:
            return


def _decided(
    chosen: Method, task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator
) -> tuple[Decision, Any]:
    """The controller's decision and its memory. Raises InputError if `decide` returns anything else."""
    match answer := chosen.decide(task, memory, estimate, rng):
        case (Decision(), _):
            return answer
    raise InputError(f"controller {chosen.name}: decide must return a Decision and the memory after it")


@dataclass(frozen=True)
class _Step:
    """Action of a period, its decision, and the time (s) to wait in place of a move; 0: a move."""

    action: Action
    decision: Decision
    wait: float = 0.0


def _step(decision: Decision, no_path: str, reading: float) -> _Step:
    """The step for a decision; no_path: reason why no path reaches the target, or ""; reading: tracker period (s)."""
    at_rest = replace(decision, command=_AT_REST)
    if no_path:
        return _Step(Action.HOLD, replace(at_rest, why=f"held: {no_path}"), reading)
    if decision.rest > 0.0:
        return _Step(Action.REST, at_rest, decision.rest)
    return _Step(Action.MOVE, decision)


@dataclass(frozen=True)
class _Hold:
    """A hold of the needle: its time (s) on account of the field and of readings, and its present cause since `at`."""

    at: float
    field: bool
    for_field: float = 0.0
    for_readings: float = 0.0

    def duration(self, field: bool) -> float:
        """Time (s) held on account of the field or of readings."""
        return self.for_field if field else self.for_readings


@dataclass(frozen=True)
class _NoPath:
    """Reason why no path reaches the target, empty if one does, and the time (s) held for it.

    The time does not run while the needle is held on account of the tracker; a decision with a path resets it.
    """

    reason: str = ""
    duration: float = 0.0

    def after(self, reason: str) -> "_NoPath":
        """After a decision."""
        return _NoPath(reason, self.duration) if reason else _NoPath()

    def extended(self, seconds: float) -> "_NoPath":
        """After a period of this length."""
        return _NoPath(self.reason, self.duration + seconds) if self.reason else self

    def ending(self, limit: float) -> tuple[Outcome, str] | None:
        """Outcome and reason once the hold has lasted for `limit` (s)."""
        return (Outcome.HELD, self.reason) if self.reason and self.duration > limit - 1e-9 else None


def _hold(hold: _Hold | None, observation: Observation, now: float) -> _Hold | None:
    """The hold after a verdict; None: not held.

    Each of the two causes has its own clock and limit. A clock stops while the needle is held for the other cause, and
    only a good verdict resets it, so that alternating causes cannot hold the needle forever.
    """
    if observation.verdict.ok:
        return None
    if hold is None:
        return _Hold(now, observation.field)
    passed = now - hold.at
    return _Hold(
        now,
        observation.field,
        hold.for_field + (passed if hold.field else 0.0),
        hold.for_readings + (0.0 if hold.field else passed),
    )


def _carry_out(scenario: Scenario, rig: Rig, command: Command, wait: float) -> Command:
    """Move, within the time at insertion speed, rounded up to whole tracker periods; or wait for `wait` (s)."""
    if wait > 0.0:
        rig.clock.wait(wait)
        return command
    reading = scenario.tracker.period
    readings = math.ceil(abs(command[0]) / scenario.setup.insertion_speed_mm_s / reading - 1e-6)
    return rig.driver.apply(command, max(1, readings) * reading)


def _ending(
    task: Task, observation: Observation, held: float | None, measured: bool
) -> tuple[Outcome, str] | None:
    """Outcome and reason if the insertion ends with this period. held: duration of the hold (s), None: not held;
    measured: whether the needle was measured at rest after its arrival.
    """
    estimate, limit = observation.estimate, observation.hold_limit(task.scenario)
    if not estimate.state.converged:
        return Outcome.FAILED, f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    if held is not None and held > limit - 1e-9:
        return Outcome.HELD, f"held for {held:.2f} s (limit {limit:g} s): {observation.verdict}"
    if not measured:
        return None
    short = task.plan.target[0] - float(estimate.tip[0])
    if short > task.scenario.control.depth_tolerance_mm and at_depth(task, None, estimate):
        return Outcome.DONE, f"stroke ends {short:.2f} mm before the target depth"
    return Outcome.DONE, ""


def _record(
    index: int,
    now: float,
    plan: Plan,
    rig: Rig,
    step: _Step,
    applied: Command,
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
    x, y, theta = (float(value) for value in values)
    return x, y, theta
