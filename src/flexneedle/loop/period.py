"""The record of a control period."""

import cmath

import numpy as np

from flexneedle.loop.measuring import Observation
from flexneedle.loop.rig import Rig
from flexneedle.loop.step import Step
from flexneedle.results import Period, Plan
from flexneedle.types import UNKNOWN, Control, Lateral, Pose, X


def make_period(
    index: int,
    now: float,
    plan: Plan,
    rig: Rig,
    step: Step,
    applied: Control,
    observation: Observation,
    clocks: list[float],
) -> Period:
    """Return the period that ended at `now` (s).

    clocks: wall clock (s) at its start and after decision, motion and measurement.
    """
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
        late=step.late,
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


def _pair(miss: float | complex) -> Lateral:
    """Return y, z of a miss (mm); z is 0 in the plane."""
    return UNKNOWN if cmath.isnan(miss) else (complex(miss).real, complex(miss).imag)
