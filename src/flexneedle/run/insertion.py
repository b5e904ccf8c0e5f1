"""Carry out an insertion: the closed loop against a driver and a tracker, by default the virtual phantom's."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.control import controller, observer
from flexneedle.errors import RunError
from flexneedle.phantom import Phantom, draw
from flexneedle.ports import Clock, Command, Driver, Sample, Tracker
from flexneedle.scenario import Scenario
from flexneedle.simulator import Simulator, State
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
    tracker: Tracker
    truth: Callable[[], State] | None = None


def insert(
    scenario: Scenario,
    plan: PlanRecord,
    seed: int = 0,
    *,
    force: bool = False,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` in closed loop against the virtual phantom that `seed` draws; returns the whole record.

    `on_period` gets each control period as it ends. Raises RunError if the plan misses its target by more than
    1 mm, unless `force`. Same seed, same record, but for wall-clock durations.
    """
    phantom_seed, tracker_seed, control_seed = np.random.SeedSequence(seed).spawn(3)
    rig = virtual_rig(scenario, plan.bevel, phantom_seed, tracker_seed)
    return run(
        scenario, plan, rig, np.random.default_rng(control_seed), seed, force=force, on_period=on_period
    )


def virtual_rig(
    scenario: Scenario, bevel: int, phantom_seed: np.random.SeedSequence, tracker_seed: np.random.SeedSequence
) -> Rig:
    """Return a virtual phantom behind the same ports as a rig."""
    phantom = Phantom(draw(scenario, np.random.default_rng(phantom_seed)), bevel)
    noise = np.random.default_rng(tracker_seed)
    tracker = NoisyTracker(
        phantom.tip_at, phantom, scenario.tracker.period, scenario.tracker.jitter_per_axis, noise
    )
    return Rig(phantom, phantom, tracker, lambda: phantom.state)


def run(
    scenario: Scenario,
    plan: PlanRecord,
    rig: Rig,
    rng: np.random.Generator,
    seed: int = 0,
    *,
    force: bool = False,
    on_period: Callable[[Period], None] | None = None,
) -> Insertion:
    """Carry out `plan` on any rig; as `insert`."""
    if not plan.reached and not force:
        raise RunError(
            f"plan misses the target by {plan.error_mm:.2f} mm (limit 1 mm), bound by {plan.limit}; "
            "insert it with force (--force) if it is meant"
        )
    periods: list[Period] = []
    ending = ("failed", "not at the target depth after four times the planned periods")
    for period, so_far in _periods(scenario, plan, rig, rng):
        periods.append(period)
        ending = so_far or ending
        if on_period is not None:
            on_period(period)
    insertion = Insertion(plan, seed, tuple(periods), *ending)
    if insertion.outcome == "done" and insertion.true_error_mm > 1.0:
        missed = f"missed the target by {insertion.true_error_mm:.2f} mm"
        return replace(insertion, reason="; ".join(filter(None, (insertion.reason, missed))))
    return insertion


def _periods(
    scenario: Scenario, plan: PlanRecord, rig: Rig, rng: np.random.Generator
) -> Iterator[tuple[Period, tuple[str, str] | None]]:
    """Yield each period, and how the insertion ended with it: (outcome, reason), None while it goes on."""
    simulator = Simulator(scenario)
    estimate = observer.begin(simulator, plan.bevel)
    held_since: float | None = None
    moves = 0
    for index in itertools.count():
        if moves == _TOO_MANY * len(plan.controls):
            return
        moves += held_since is None
        clocks = [time.perf_counter()]
        decision = _hold() if held_since is not None else controller.decide(simulator, plan, estimate, rng)
        clocks.append(time.perf_counter())
        begun = rig.clock.now()
        applied = _carry_out(scenario, rig, decision.command, held_since is not None)
        clocks.append(time.perf_counter())
        estimate, sample, verdict = _see(simulator, estimate, applied, begun, rig)
        clocks.append(time.perf_counter())
        now = rig.clock.now()
        held_since = None if verdict == OK else (now if held_since is None else held_since)
        held = 0.0 if held_since is None else now - held_since
        ending = _ending(scenario, plan, estimate, verdict, held)
        yield _record(index, now, plan, rig, decision, applied, sample, verdict, estimate, clocks), ending
        if ending is not None:
            return


def _hold() -> controller.Decision:
    return controller.Decision(_STILL, "held", math.nan, math.nan)


def _carry_out(scenario: Scenario, rig: Rig, command: Command, held: bool) -> Command:
    """Move, for as long as the speed asks, rounded up to whole readings of the tracker; or wait for one."""
    reading = scenario.tracker.period
    if held:
        rig.clock.wait(reading)
        return command
    readings = math.ceil(abs(command[0]) / scenario.setup.insertion_speed_mm_s / reading - 1e-6)
    return rig.driver.apply(command, max(1, readings) * reading)


def _see(
    simulator: Simulator, estimate: observer.Estimate, applied: Command, begun: float, rig: Rig
) -> tuple[observer.Estimate, Sample, str]:
    """Predict, read the tracker, judge its readings, correct by the good ones if the newest is good."""
    control, now = simulator.scenario.control, rig.clock.now()
    predicted = observer.predict(simulator, estimate, applied)

    def verdict_of(sample: Sample) -> str:
        tip = observer.predicted_tip(estimate.tip, predicted.tip, begun, now, sample.time)
        stale = max(control.stale_after_s, now - begun if sample is not samples[-1] else 0.0)
        return judge(sample, tip, now, stale, control.innovation_limit_mm)

    samples = rig.tracker.read()
    verdicts = [verdict_of(sample) for sample in samples]
    good = [sample for sample, verdict in zip(samples, verdicts, strict=True) if verdict == OK]
    if not samples or verdicts[-1] != OK:
        unseen = replace(estimate, state=predicted, innovation=(0.0, 0.0))
        return (
            unseen,
            samples[-1] if samples else _NO_SAMPLE,
            verdicts[-1] if samples else "missing: no reading",
        )
    return observer.observe(simulator, estimate, predicted, begun, now, good), samples[-1], OK


def _ending(
    scenario: Scenario, plan: PlanRecord, estimate: observer.Estimate, verdict: str, held: float
) -> tuple[str, str] | None:
    """How the insertion ends after this period, if it does."""
    if not estimate.state.converged:
        return "failed", f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    limit = scenario.control.hold_limit_s
    if held > limit - 1e-9:
        return "held", f"held for {held:.2f} s (limit {limit:g} s): {verdict}"
    if verdict != OK or not controller.arrived(scenario, plan, estimate):
        return None
    short = plan.target[0] - float(estimate.tip[0])
    if short > scenario.control.depth_tolerance_mm:
        return "done", f"the stroke ends {short:.2f} mm before the target depth"
    return "done", ""


def _record(
    index: int,
    now: float,
    plan: PlanRecord,
    rig: Rig,
    decision: controller.Decision,
    applied: Command,
    sample: Sample,
    verdict: str,
    estimate: observer.Estimate,
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
        estimate=_pose(state.tip),
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
        durations={
            "decide": clocks[1] - clocks[0],
            "apply": clocks[2] - clocks[1],
            "observe": clocks[3] - clocks[2],
            "total": clocks[1] - clocks[0] + clocks[3] - clocks[2],
        },
        converged=state.converged,
    )


def _pose(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, turn = (float(value) for value in values)
    return x, y, turn
