"""Carry out an insertion: the closed loop against a driver and a tracker, by default the virtual phantom's."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.control.estimate import Estimate
from flexneedle.control.interface import Decision, Method, Task, at_depth
from flexneedle.control.methods import DEFAULT, method
from flexneedle.errors import RunError
from flexneedle.phantom import DEFAULT_PLANT, Condition, Phantom, draw
from flexneedle.ports import Clock, Command, Driver, Sample, TipTracker
from flexneedle.scenario import Scenario
from flexneedle.simulator import Simulator
from flexneedle.trace import Insertion, Period, PlanRecord
from flexneedle.tracking import OK, NoisyTracker, judge

_TOO_MANY = 4  # times the planned periods: the loop is not getting there
_STILL: Command = (0.0, 0.0, 0.0, 0.0, -1)
_NO_SAMPLE = Sample(0.0, None, None)


@dataclass(frozen=True)
class Rig:
    """What the closed loop moves and sees; `truth` is for the record alone, None on hardware."""

    clock: Clock
    driver: Driver
    tracker: TipTracker
    truth: Callable[[], Condition] | None = None


def insert(
    scenario: Scenario,
    plan: PlanRecord,
    seed: int = 0,
    *,
    controller: str = DEFAULT,
    phantom: str = DEFAULT_PLANT,
    force: bool = False,
    threads: int | None = None,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` in closed loop against the virtual phantom that `seed` draws; returns the whole record.

    controller: one of `control.methods.METHODS`; phantom: "exact" or "model", the formulation of the plant.
    `threads` is for rollouts (default: all cores) and changes no result. `on_period` gets each control period as
    it ends. Raises InputError for an unknown name, RunError if the plan misses its target by more than 1 mm,
    unless `force`. Same seed, same record, but for wall-clock durations.
    """
    phantom_seed, tracker_seed, control_seed = np.random.SeedSequence(seed).spawn(3)
    rig = virtual_rig(scenario, plan.bevel, phantom_seed, tracker_seed, phantom)
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
    return replace(insertion, phantom=phantom)


def virtual_rig(
    scenario: Scenario,
    bevel: int,
    phantom_seed: np.random.SeedSequence,
    tracker_seed: np.random.SeedSequence,
    phantom: str = DEFAULT_PLANT,
) -> Rig:
    """Return a virtual phantom behind the same ports as a rig."""
    truth = draw(scenario, np.random.default_rng(phantom_seed))
    tank = Phantom(truth, bevel, phantom)
    step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
    tracker = NoisyTracker(
        tank.tip_at,
        tank,
        scenario.tracker.period,
        scenario.tracker.jitter_per_axis,
        np.random.default_rng(tracker_seed),
        delay=scenario.phantom.delay_periods * step,
        missing=scenario.phantom.missing_fraction,
        bias=truth.bias,
    )
    return Rig(tank, tank, tracker, tank.condition)


def run(
    scenario: Scenario,
    plan: PlanRecord,
    rig: Rig,
    rng: np.random.Generator,
    seed: int = 0,
    *,
    controller: str = DEFAULT,
    force: bool = False,
    threads: int | None = None,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` on any rig; as `insert`."""
    chosen = method(controller)
    if not plan.reached and not force:
        raise RunError(
            f"plan misses the target by {plan.error_mm:.2f} mm (limit 1 mm), bound by {plan.limit}; "
            "insert it with force (--force) if it is meant"
        )
    periods: list[Period] = []
    ending = ("failed", "not at the target depth after four times the planned periods")
    for period, so_far in _periods(Task(Simulator(scenario, threads), plan), chosen, rig, rng):
        periods.append(period)
        ending = so_far or ending
        if on_period is not None:
            on_period(period)
    insertion = Insertion(plan, seed, tuple(periods), *ending, controller)
    if insertion.outcome == "done" and insertion.true_error_mm > 1.0:
        missed = f"missed the target by {insertion.true_error_mm:.2f} mm"
        return replace(insertion, reason="; ".join(filter(None, (insertion.reason, missed))))
    return insertion


def _periods(
    task: Task, chosen: Method, rig: Rig, rng: np.random.Generator
) -> Iterator[tuple[Period, tuple[str, str] | None]]:
    """Yield each period, and how the insertion ended with it: (outcome, reason), None while it goes on.

    After the last move the needle rests until the tracker has seen it at rest: readings come late.
    """
    estimate = chosen.beliefs.begin(task.simulator, task.plan.bevel)
    memory = chosen.begin(task)
    held_since: float | None = None
    arrived_at: float | None = None
    sample, moves = _NO_SAMPLE, 0
    for index in itertools.count():
        if moves == _TOO_MANY * len(task.plan.controls):
            return
        clocks = [time.perf_counter()]
        begun, wait = rig.clock.now(), task.scenario.tracker.period
        if held_since is not None:
            decision = Decision(_STILL, "held")
        elif arrived_at is not None:
            decision, wait = Decision(_STILL, "at rest for the last reading"), max(wait, begun - sample.time)
        else:
            decision, memory = chosen.decide(task, memory, estimate, rng)
            moves, wait = moves + 1, 0.0
        clocks.append(time.perf_counter())
        applied = _carry_out(task.scenario, rig, decision.command, wait)
        clocks.append(time.perf_counter())
        estimate, sample, verdict = _see(task.scenario, estimate, applied, begun, rig)
        clocks.append(time.perf_counter())
        now = rig.clock.now()
        held_since = None if verdict == OK else (now if held_since is None else held_since)
        if arrived_at is None and verdict == OK and chosen.arrived(task, memory, estimate):
            arrived_at = now
        seen = arrived_at is not None and verdict == OK and sample.time > arrived_at - 1e-6
        ending = _ending(task, estimate, verdict, 0.0 if held_since is None else now - held_since, seen)
        yield (
            _record(index, now, task.plan, rig, decision, applied, sample, verdict, estimate, clocks),
            ending,
        )
        if ending is not None:
            return


def _carry_out(scenario: Scenario, rig: Rig, command: Command, wait: float) -> Command:
    """Move, for as long as the speed asks, rounded up to whole readings of the tracker; or wait so long (s)."""
    if wait > 0.0:
        rig.clock.wait(wait)
        return command
    reading = scenario.tracker.period
    readings = math.ceil(abs(command[0]) / scenario.setup.insertion_speed_mm_s / reading - 1e-6)
    return rig.driver.apply(command, max(1, readings) * reading)


def _see(
    scenario: Scenario, estimate: Estimate, applied: Command, begun: float, rig: Rig
) -> tuple[Estimate, Sample, str]:
    """Predict, read the tracker, judge its readings, correct by the good ones."""
    control, now = scenario.control, rig.clock.now()
    predicted = estimate.move(applied, begun, now)
    samples = rig.tracker.read()
    if not samples:
        return predicted.unseen(), _NO_SAMPLE, "missing: no reading"
    # All but the newest were on their way while the needle moved.
    ages = [control.stale_after_s + now - begun] * (len(samples) - 1) + [control.stale_after_s]
    verdicts = [
        judge(sample, predicted.tip_at(sample.time), now, age, control.innovation_limit_mm)
        for sample, age in zip(samples, ages, strict=True)
    ]
    good = [sample for sample, verdict in zip(samples, verdicts, strict=True) if verdict == OK]
    corrected = predicted.observe(good)
    return corrected if verdicts[-1] == OK else corrected.unseen(), samples[-1], verdicts[-1]


def _ending(task: Task, estimate: Estimate, verdict: str, held: float, seen: bool) -> tuple[str, str] | None:
    """How the insertion ends after this period, if it does."""
    if not estimate.state.converged:
        return "failed", f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    limit = task.scenario.control.hold_limit_s
    if held > limit - 1e-9:
        return "held", f"held for {held:.2f} s (limit {limit:g} s): {verdict}"
    if not seen:
        return None
    short = task.plan.target[0] - float(estimate.tip[0])
    if short > task.scenario.control.depth_tolerance_mm and at_depth(task, None, estimate):
        return "done", f"the stroke ends {short:.2f} mm before the target depth"
    return "done", ""


def _record(
    index: int,
    now: float,
    plan: PlanRecord,
    rig: Rig,
    decision: Decision,
    applied: Command,
    sample: Sample,
    verdict: str,
    estimate: Estimate,
    clocks: list[float],
) -> Period:
    state, truth = estimate.state, None if rig.truth is None else rig.truth()
    return Period(
        index=index,
        time=now,
        command=decision.command,
        applied=applied,
        sample=sample,
        verdict=verdict,
        innovation=estimate.innovation,
        estimate=_pose(estimate.tip),
        shape=state.nodes,
        base=_pose(state.base),
        guide=state.guide,
        bevel=state.bevel,
        strain_energy=state.strain_energy,
        tip_load=state.tip_load,
        path=_pose([np.interp(state.tip[0], plan.tips[:, 0], plan.tips[:, k]) for k in range(3)]),
        cost=decision.cost,
        spread=decision.spread,
        decision=decision.why,
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
