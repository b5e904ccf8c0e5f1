"""The closed loop: decide, move, measure, until the needle rests at its target."""

import cmath
import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from flexneedle.arguments import check_instance
from flexneedle.control.forecast import describe_miss, warn_of_miss
from flexneedle.control.interface import Decision, is_at_depth
from flexneedle.errors import CommandError, DriverError, RefusedError, StoppedError, one_line
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.loop.events import PeriodEnded
from flexneedle.loop.loop_state import LoopState, hold_after
from flexneedle.loop.measuring import Observation, observe_all, observe_before_start
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.rig import Rig
from flexneedle.loop.step import Steering, Step
from flexneedle.ports import Driver
from flexneedle.results import Action, Insertion, Outcome, Period, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.control import ROUNDING_S, travel_time
from flexneedle.simulator.state import State
from flexneedle.simulator.zones import ZoneMap
from flexneedle.types import STILL, UNKNOWN, Control, Lateral, Matrix, Motion, Pose, X

_MOST_MOVES = 4  # times the planned steps; then the insertion fails
_TOLERANCE_MM = 0.1  # by which a margin may be entered without a warning
_Ending = tuple[Outcome, str]


def run(steering: Steering, rig: Rig) -> Insertion:
    """Execute the plan of `steering` on the ports of a rig: see `flexneedle.insert`.

    A DriverError is raised only if the driver cannot be stopped after another error or an interrupt.
    """
    task, choices = steering.task, steering.choices
    periods, ending = _run_to_end(steering, rig)
    insertion = Insertion(
        task.plan, choices.seed, tuple(periods), *ending, choices.name, scenario=task.scenario
    )
    if insertion.outcome is Outcome.DONE:
        line = describe_miss(insertion.true_error_mm, math.dist(periods[-1].estimate.point, task.plan.target))
        return replace(insertion, reason="; ".join(filter(None, (insertion.reason, line))))
    return insertion


def _run_to_end(steering: Steering, rig: Rig) -> tuple[list[Period], _Ending]:
    """Return all periods, and (outcome, reason), once the driver is stopped. Raises as `run`."""
    periods: list[Period] = []
    ending = (Outcome.FAILED, f"target depth not reached within {_MOST_MOVES} times the planned steps")
    try:
        for period, ended in _periods(steering, rig):
            periods.append(period)
            ending = ended or ending
            steering.stream.send(PeriodEnded(period))
    except DriverError as error:
        ending = Outcome.FAILED, one_line(error)
    except RefusedError as error:
        ending = Outcome.HELD, one_line(error)
    except StoppedError as error:
        ending = Outcome.INTERRUPTED, one_line(error)
    except BaseException as error:  # no motor keeps moving after an interrupt or another error
        _, still_on = _stop_driver(rig.driver, (Outcome.INTERRUPTED, ""))
        if still_on:
            raise DriverError(f"{str(error) or 'interrupted'}; {still_on}") from error
        raise
    return periods, _stop_driver(rig.driver, ending)


def _stop_driver(driver: Driver, ending: _Ending) -> _Ending:
    """Stop the driver and return the ending: failed if it cannot be stopped."""
    try:
        driver.stop()
    except DriverError as error:
        return Outcome.FAILED, "; ".join(
            filter(None, (ending[1], f"the driver was not stopped: {one_line(error)}"))
        )
    return ending


def _periods(steering: Steering, rig: Rig) -> Iterator[tuple[Period, _Ending | None]]:
    """Yield each period with (outcome, reason) of the insertion, None while it continues.

    After the last move the needle rests until the tracker has measured it at rest, since readings are delayed.
    """
    task = steering.task
    start, indices = time.perf_counter(), itertools.count()
    memory, estimate = steering.controller.begin(task), steering.controller.observer.begin(task)
    state = _measure_before_start(task.scenario, memory, estimate, rig)
    if (first := _first_step(state)) is not None:
        clocks, observation = [start, start, start, time.perf_counter()], state.observation
        yield (
            _make_period(next(indices), rig.clock.now(), task, rig, first, STILL, observation, clocks),
            None,
        )
    for index in indices:
        if state.moves == _MOST_MOVES * len(task.plan.controls):
            return
        clocks, begun = [time.perf_counter()], rig.clock.now()
        step, decided = steering.next_step(state, rig, begun)
        clocks.append(time.perf_counter())
        if rig.expect is not None:
            sensed = state.observation.sensed_at(task.scenario, begun)
            rig.expect(state.observation.estimate, step.decision.command, sensed)
        motion = _carry_out(task.scenario, rig, step, begun)
        clocks.append(time.perf_counter())
        predicted = state.observation.estimate.move(motion)
        observation = observe_all(task.scenario, state.observation, predicted, begun, rig.clock.now(), rig)
        clocks.append(time.perf_counter())
        now = rig.clock.now()
        if motion.held:
            decided, step = decided.hold_back(motion.held, state), step.hold_back(motion.held)
        state = _advance(decided, step, observation, steering, begun, now)
        ending = _ending(task, state, now)
        period = _make_period(index, now, task, rig, step, motion.control, observation, clocks)
        warning = warn_of_miss(step.decision, state.in_a_row) or step.decision.doubt
        warning = warning or _warn_of_zone(steering.guard.zones, observation.estimate.state)
        yield replace(period, warning=warning, **_clearances(steering, period, observation)), ending
        if ending is not None:
            return


def _measure_before_start(scenario: Scenario, memory: Any, estimate: Estimate, rig: Rig) -> LoopState:
    """Return the state after the measurement before the first motion."""
    monitor = Monitor(scenario.monitor, scenario.setup.axes)
    observation = observe_before_start(scenario, estimate, monitor, rig.clock.now(), rig.tracker)
    return LoopState(observation, memory, hold_after(None, observation, rig.clock.now()))


def _first_step(state: LoopState) -> Step | None:
    """Return the step of the measurement before the first motion; a good reading of a tip alone is not recorded."""
    if state.hold is None and state.observation.measurement.frame is None:
        return None
    return Step(Action.MEASURE, Decision(STILL, "measurement before the first motion"))


def _advance(
    decided: LoopState, step: Step, observation: Observation, steering: Steering, begun: float, now: float
) -> LoopState:
    """Return the state after a period from `begun` to `now` (s)."""
    arrived_at, arrived = decided.arrived_at, steering.controller.arrived
    if (
        arrived_at is None
        and observation.verdict.ok
        and arrived(steering.task, decided.memory, observation.estimate)
    ):
        arrived_at = now
    return replace(
        decided,
        observation=observation,
        hold=hold_after(decided.hold, observation, now),
        refused=decided.refused.extend(now - begun) if decided.decides else decided.refused,
        arrived_at=arrived_at,
        held_in_all=decided.held_in_all + (now - begun if step.action is Action.HOLD else 0.0),
    )


def _carry_out(scenario: Scenario, rig: Rig, step: Step, begun: float) -> Motion:
    """Move, in the time of the slowest axis rounded up to whole tracker periods; or wait.

    begun: start of the period (s), from which a needle that does not move is at rest.
    """
    command = step.decision.command
    if step.wait is not None:
        if step.wait > 0.0:
            rig.clock.wait(step.wait)
        return Motion(command, begun, rig.clock.now())
    reading = scenario.tracker.period
    readings = math.ceil((travel_time(scenario.setup, command) - ROUNDING_S) / reading)
    try:
        motion = rig.driver.apply(command, max(1, readings) * reading)
    except CommandError as error:  # of a controller: refused, with a record of all before
        raise RefusedError(one_line(error)) from error
    motion = check_instance("result of driver.apply", motion, Motion, "Motion(control, begun, ended, turned)")
    if motion.held:  # a refused decision takes no time: wait for a reading before the next
        rig.clock.wait(reading)
    return motion


def _ending(task: Task, state: LoopState, now: float) -> _Ending | None:
    """Return outcome and reason if the insertion ends with this period, at a time (s)."""
    estimate = state.observation.estimate
    if not estimate.state.converged:
        return Outcome.FAILED, f"the model did not converge: residual {estimate.state.residual:.3g} mm"
    if not state.measured_at_rest:
        return _hold_ending(task.scenario, state) or _blind_ending(task.scenario, state, now)
    short = task.plan.target[0] - float(estimate.tip[X])
    if short > task.scenario.control.depth_tolerance_mm and is_at_depth(task, None, estimate):
        return Outcome.DONE, f"stroke ends {format_mm(short)} before the target depth"
    return Outcome.DONE, ""


def _hold_ending(scenario: Scenario, state: LoopState) -> _Ending | None:
    """Return outcome and reason once a hold has reached its limit, alone or all holds together."""
    observation, held, refused = state.observation, state.held, state.refused
    limit, total = observation.hold_limit(scenario), scenario.control.hold_total_s
    if held is not None and held > limit - 1e-9:
        return Outcome.HELD, f"held for {held:.2f} s (limit {limit:.2f} s): {observation.verdict}"
    if state.held_in_all > total - 1e-9 and (held is not None or state.asked or refused.reason):
        why = state.asked or refused.reason if held is None else observation.verdict
        return Outcome.HELD, f"held for {state.held_in_all:.2f} s in all (limit {total:.2f} s): {why}"
    return refused.ending(scenario.control.hold_limit_s)


def _blind_ending(scenario: Scenario, state: LoopState, now: float) -> _Ending | None:
    """Return outcome and reason if no sensor measures the needle at rest, since all images are elsewhere."""
    rested = 0.0 if state.arrived_at is None else now - state.arrived_at
    limit = scenario.control.hold_limit_s + scenario.longest_wait
    if not scenario.sensor or state.hold is not None or rested <= limit:
        return None
    return Outcome.HELD, f"not measured at rest for {rested:.2f} s (limit {limit:.2f} s)"


def _make_period(
    index: int,
    now: float,
    task: Task,
    rig: Rig,
    step: Step,
    applied: Control,
    observation: Observation,
    clocks: list[float],
) -> Period:
    """Return the period that ended at `now` (s).

    clocks: wall clock (s) at its start and after decision, motion and measurement.
    """
    plan, estimate = task.plan, observation.estimate
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
        energy_scale=task.scenario.energy_scale(plan.target[X]),
        tip_load=state.tip_load,
        path=Pose.of(np.interp(estimate.tip[X], plan.tips[:, X], column) for column in plan.tips.T),
        cost=step.decision.cost,
        spread=step.decision.spread,
        action=step.action,
        late=step.late,
        decision=step.decision.why,
        miss=_pair(step.decision.miss),
        miss_sd=step.decision.miss_sd,
        predicted=step.decision.predicted,
        stretch=state.least_stretch,
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
        sensors=observation.sensors,
        tip_covariance=_covariance(estimate)
        if task.scenario.sensor or task.scenario.tracker.bias_sd_mm
        else None,
    )


def _covariance(estimate: Estimate) -> Matrix | None:
    """Return the covariance (3, 3) of the estimated tip (mm²), None for an estimate without one."""
    covariance = getattr(estimate, "tip_covariance", None)
    return None if covariance is None else tuple(map(tuple, covariance.tolist()))


def _clearances(steering: Steering, period: Period, observation: Observation) -> dict[str, Any]:
    """Return the fields of a period with the clearances from zones."""
    zones, true = steering.guard.zones, period.true_shape
    return {
        "clearance": zones.clearance_of(observation.estimate.state),
        "true_clearance": None if true is None else float(zones.shape_clearances(true)),
    }


def _warn_of_zone(zones: ZoneMap, state: State) -> str:
    """Return a warning if the estimated needle is in the margin of a zone by more than a tolerance, else ""."""
    if not zones or not (body := state.body).size:
        return ""
    near = zones.nearest(body)
    if near.clearance >= near.margin - _TOLERANCE_MM:
        return ""
    return f"{format_mm(near.clearance)} from zone {near.zone}, in its margin of {near.margin:g} mm"


def _pair(miss: float | complex) -> Lateral:
    """Return y, z of a miss (mm); z is 0 in the plane."""
    return UNKNOWN if cmath.isnan(miss) else (complex(miss).real, complex(miss).imag)
