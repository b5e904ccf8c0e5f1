"""What the controller believes: the model's state, corrected by the tracker so that its prediction has no offset.

In air the free end is short and stiff, and noise reads as force: there the start offset and angle of the base
are fitted (recursive least squares with a prior). In tissue the measured tip is an essential condition, and the
force that it needs, low-passed, stays as a tip load in the prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.ports import Command, Sample
from flexneedle.simulator import Control, Simulator, State

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """The believed state; covariance (2, 2) of base y (mm) and turn (rad); the last innovation (mm)."""

    state: State
    covariance: Floats
    innovation: tuple[float, float] = (0.0, 0.0)

    @property
    def tip(self) -> Floats:
        """Tip pose (3,)."""
        return self.state.tip


def begin(simulator: Simulator, bevel: int) -> Estimate:
    """Believe in a straight start, with the prior of the scenario."""
    control = simulator.scenario.control
    prior = np.diag([control.start_offset_sd_mm**2, control.start_angle_sd**2])
    return Estimate(simulator.start(bevel), prior)


def predict(simulator: Simulator, estimate: Estimate, applied: Command) -> State:
    """Move the believed needle as the driver did."""
    return simulator.step(estimate.state, Control.from_row(applied))


def observe(
    simulator: Simulator,
    estimate: Estimate,
    predicted: State,
    begun: float,
    ended: float,
    samples: Sequence[Sample],
) -> Estimate:
    """Correct the prediction by good samples, taken while the tip went from the estimate to `predicted`.

    begun, ended: when the move did (s). The innovations are averaged over the samples of the period.
    """
    innovation = np.mean([_innovation(estimate.tip, predicted.tip, begun, ended, s) for s in samples], axis=0)
    seen = (float(innovation[0]), float(innovation[1]))
    if predicted.tip[0] <= 0.0:
        noise = simulator.scenario.tracker.jitter_per_axis / np.sqrt(len(samples))
        return _fit_start(simulator, estimate, predicted, seen, float(noise))
    return _learn_load(simulator, estimate, predicted, seen)


def predicted_tip(
    before: Floats, after: Floats, begun: float, ended: float, time: float
) -> tuple[float, float]:
    """Where the model had its tip (mm) at `time` within a move, assumed even."""
    part = 1.0 if ended <= begun else min(1.0, max(0.0, (time - begun) / (ended - begun)))
    x, y = before[:2] + part * (after[:2] - before[:2])
    return float(x), float(y)


def _innovation(
    before: Floats, after: Floats, begun: float, ended: float, sample: Sample
) -> tuple[float, float]:
    if sample.x is None or sample.y is None:
        raise ValueError("an empty sample was not sorted out")
    x, y = predicted_tip(before, after, begun, ended, sample.time)
    return sample.x - x, sample.y - y


def _fit_start(
    simulator: Simulator, estimate: Estimate, predicted: State, seen: tuple[float, float], noise: float
) -> Estimate:
    """One step of recursive least squares on base y and turn; linear, since nothing but the guide touches."""
    sensitivity = np.array(
        [_tip_shift(simulator, predicted, 1.0, 0.0), _tip_shift(simulator, predicted, 0.0, 1e-3) / 1e-3]
    )
    spread = estimate.covariance @ sensitivity
    gain = spread / (sensitivity @ spread + noise**2 + 1e-12)
    base_y, base_turn = predicted.base[1:] + gain * seen[1]
    corrected = simulator.step(
        predicted.believing(base_y=float(base_y), base_turn=float(base_turn)), Control()
    )
    return Estimate(corrected, estimate.covariance - np.outer(gain, spread), seen)


def _tip_shift(simulator: Simulator, state: State, base_y: float, base_turn: float) -> float:
    """Lateral shift of the tip (mm) for a shift of the base (mm, rad)."""
    _, y, turn = state.base
    moved = state.believing(base_y=float(y) + base_y, base_turn=float(turn) + base_turn)
    return float(simulator.step(moved, Control()).tip[1] - state.tip[1])


def _learn_load(
    simulator: Simulator, estimate: Estimate, predicted: State, seen: tuple[float, float]
) -> Estimate:
    measured = predicted.tip[:2] + seen
    held = simulator.assimilate(predicted, measured.tolist()).state
    gain = simulator.scenario.control.load_gain
    load = held.tip_load + gain * held.reactions.tip_force
    return replace(estimate, state=held.believing(tip_load=load), innovation=seen)
