"""Advance of the needle along its axis, as the tracker measures it: a start error and a scale.

Axial motion is rigid, so that both act on all depths alike. The scale is the ratio of the measured to the commanded
advance: the error of the insertion axis in the rig file, or of the tracker.
"""

from typing import NamedTuple

import numpy as np

from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, Control, Floats

_ANY_SCALE = 100.0  # standard deviation of a scale that may have any value


def axial_prior(control: ControlSettings) -> Floats:
    """Return the prior covariance (2, 2) of the start error (mm) and of the scale."""
    return np.diag([control.start_axial_sd_mm**2, control.axial_scale_sd**2])


def axial_variance(covariance: Floats, travel: float) -> float:
    """Return the variance (mm²) of the needle's depth after an advance of `travel` (mm)."""
    return float(covariance[0, 0] + 2.0 * travel * covariance[0, 1] + travel**2 * covariance[1, 1])


def fit_axial_error(ahead: Floats, travel: Floats, variance: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Return the maximum a posteriori (2,) of the start error (mm) and of the scale's error, and their covariance.

    ahead (r,): readings minus predictions without both, mm, of `variance` (r,); travel (r,): commanded advance, mm;
    prior: its covariance (2, 2), with means 0.
    """
    columns = np.stack([np.ones_like(travel), travel])
    weighted = columns / variance
    covariance: Floats = prior @ np.linalg.inv(np.eye(2) + weighted @ columns.T @ prior)  # a prior of 0 stays
    return covariance @ (weighted @ ahead), covariance


class EvenAdvance(NamedTuple):
    """Advance of a constant scale that fits the readings along the axis best, whatever the prior of the scale.

    misfit: root mean square distance of the readings from it (mm); large if they are late now and then.
    """

    scale: float
    misfit: float


AS_COMMANDED = EvenAdvance(1.0, 0.0)
"""Advance before any reading."""


def fit_even_advance(ahead: Floats, travel: Floats, variance: Floats, prior: Floats) -> EvenAdvance:
    """Return the even advance that fits readings; arguments as for `fit_axial_error`."""
    wide = np.diag([prior[0, 0], _ANY_SCALE**2])
    start, scale = fit_axial_error(ahead, travel, variance, wide)[0].tolist()
    left = ahead - start - scale * travel
    return EvenAdvance(1.0 + scale, float(np.sqrt(np.mean(left**2))) if len(left) else 0.0)


def carry_out(simulator: Simulator, state: State, applied: Control, axial_scale: float = 1.0) -> State:
    """Return the state after a motion as the driver carried it out, which may exceed a limit of commands a little."""
    return replay_scaled(simulator, state, np.array([applied]), axial_scale)[0]


def replay_scaled(
    simulator: Simulator, state: State, rows: Floats, axial_scale: float
) -> tuple[State, Floats]:
    """Return the state and the tips (m, 5) after motions (m, 9) that advance the needle `axial_scale` times as far."""
    scaled, extra = scale_advance(rows, axial_scale)
    after, tips = simulator.replay(state, scaled)
    return after.discount_advance(extra), tips


def scale_advance(rows: Floats, axial_scale: float) -> tuple[Floats, float]:
    """Return motions (m, 9) that advance the needle `axial_scale` times as far, and how much further (mm) in all."""
    scaled = rows.copy()
    scaled[:, DB_X] *= axial_scale
    return scaled, float(scaled[:, DB_X].sum() - rows[:, DB_X].sum())
