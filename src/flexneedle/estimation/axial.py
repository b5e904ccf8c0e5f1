"""Advance of the needle along its axis, as the tracker measures it: a start error, a scale, and a play.

Axial motion is rigid, so that they act on all depths alike. The scale is the ratio of the measured to the commanded
advance: the error of the insertion axis in the rig file, or of the tracker. Where the advance stops in tissue, the
needle springs back by the play. States and tips of a model with play are of the needle at rest: the tip in motion is
ahead by the play, and so is the tip in air.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, Control, Floats

_ANY_SCALE = 100.0  # standard deviation of a scale that may have any value
_PLAY_SD = 0.3  # mm; prior standard deviation of the play
_FULL_PLAY = 10.0  # mm; depth from which a rest shows the whole play, since the tissue pushes the needle back


def axial_prior(control: ControlSettings) -> Floats:
    """Return the prior covariance (2, 2) of the start error (mm) and of the scale."""
    return np.diag([control.start_axial_sd_mm**2, control.axial_scale_sd**2])


def play_prior(control: ControlSettings) -> Floats:
    """Return the prior covariance (3, 3) of the start error (mm) of a needle at rest, the scale, and the play (mm).

    The error at rest is the independent error of the start minus the play.
    """
    prior = np.zeros((3, 3))
    prior[:2, :2] = axial_prior(control)
    prior[::2, ::2] += _PLAY_SD**2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return prior


def axial_errors_prior(scenario: Scenario) -> Floats:
    """Return the prior covariance of start error, scale and play, and of the tracker's constant error where it has one.

    See `play_prior`; (3, 3) or (4, 4).
    """
    prior, bias = play_prior(scenario.control), scenario.tracker.bias_sd_mm
    if bias == 0.0:
        return prior
    wider = np.diag([0.0, 0.0, 0.0, bias**2])
    wider[:3, :3] = prior
    return wider


def rest_variance(depth: Floats, turns: NDArray[np.bool_]) -> Floats:
    """Return the variance (r,), mm², of the play at rests of the tip at a depth (mm), which may not be the whole play.

    turns: whether the needle rolls, at whose start it may not have sprung back yet.
    """
    missing: Floats = np.where(turns, 1.0, np.clip(1.0 - depth / _FULL_PLAY, 0.0, 1.0))
    return (_PLAY_SD * missing) ** 2


def axial_variance(covariance: Floats, derivatives: Sequence[float]) -> float:
    """Return the variance (mm²) of the needle's depth, with its derivatives (p,) as for `fit_axial_error`."""
    return float(derivatives @ covariance @ derivatives)


def fit_axial_error(ahead: Floats, columns: Floats, variance: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Return the maximum a posteriori (p,) of the axial errors, and their covariance (p, p).

    ahead (r,): readings minus predictions without errors, mm, of `variance` (r,); columns (p, r): their derivatives to
    the start error (mm) and the scale: 1 and the commanded advance (mm), and to the play: 1 or, at rest, 0;
    prior: its covariance (p, p), with means 0.
    """
    weighted = columns / variance
    information = weighted @ columns.T
    covariance: Floats = prior @ np.linalg.inv(np.eye(len(prior)) + information @ prior)  # a prior of 0 stays
    return covariance @ (weighted @ ahead), covariance


class EvenAdvance(NamedTuple):
    """Advance of a constant scale that fits the readings along the axis best, whatever the prior of the scale.

    misfit: root mean square distance of the readings from it (mm); large if they are late now and then.
    """

    scale: float
    misfit: float


AS_COMMANDED = EvenAdvance(1.0, 0.0)
"""Advance before any reading."""


def fit_even_advance(ahead: Floats, columns: Floats, variance: Floats, prior: Floats) -> EvenAdvance:
    """Return the even advance that fits readings; arguments as for `fit_axial_error`."""
    wide = prior.copy()
    wide[1, 1] = _ANY_SCALE**2
    found, _ = fit_axial_error(ahead, columns, variance, wide)
    left = ahead - found @ columns
    return EvenAdvance(1.0 + float(found[1]), float(np.sqrt(np.mean(left**2))) if len(left) else 0.0)


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
