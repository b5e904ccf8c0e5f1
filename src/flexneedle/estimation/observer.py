"""An observer that corrects the state of the model to the readings, so that its prediction has no offset.

Readings come late. Each belongs to the move in which it was taken; the estimate is corrected there, and the moves
since are predicted again (a fixed-lag filter).

The start error along the axis is estimated from all readings (a scalar Kalman filter): axial motion is rigid.
In air the free end is short and stiff, so that noise would act as a force: there the start offset and angle of the base
are fitted (recursive least squares with a prior). In tissue the measured tip is an essential condition, and the
force that it needs, low-passed, stays as a tip load in the prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.estimation.estimate import Move, along, assigned, described, place
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import Command, Floats, Measurement

_DRIFT = 0.5  # of the path that the bevel bends: standard deviation of a model's error


@dataclass(frozen=True)
class StateCorrection:
    """Quantities that this observer estimates: in air the pose of the base clamp, in tissue a tip load.

    Without the load the prediction releases the measured tip, as in the paper.
    """

    fits_start: bool = True
    estimates_load: bool = True

    def begin(self, task: Task) -> "Corrected":
        """The estimate before the first reading: a straight needle, and the scenario's prior."""
        simulator, control = task.simulator, task.scenario.control
        prior = np.diag([control.start_offset_sd_mm**2, control.start_angle_sd**2])
        state = simulator.start(task.plan.bevel)
        axial = control.start_axial_sd_mm**2
        drift = _DRIFT * _bevel_reach(simulator, task.plan.target[0]) / task.plan.target[0] ** 2
        return Corrected(simulator, self, state, state, prior, axial, state.tip[None], drift)


@dataclass(frozen=True, eq=False)
class Corrected:
    """An `Estimate`; `state` is the present one.

    past: the state before the first of `moves`, those whose readings may still arrive; tips (k + 1, 3): estimated
    tip pose at their ends, the start first; covariance (2, 2) of base y (mm) and θ (rad), and axial, the variance of
    the start along the axis (mm²), before `moves`; drift: standard deviation of the path's curvature (1/mm).
    """

    simulator: Simulator
    correction: StateCorrection
    state: State
    past: State
    covariance: Floats
    axial: float
    tips: Floats
    drift: float
    moves: tuple[Move, ...] = ()
    innovation: tuple[float, float] = (0.0, 0.0)
    measured: tuple[float, float] | None = None

    def __repr__(self) -> str:
        return described(self)

    @property
    def tip(self) -> Floats:
        """Tip pose (3,)."""
        return self.state.tip

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip.

        A path that leaves the model's by drift · x² below the skin leaves it by drift · (x² − s²) after a reading at s.
        """
        arm = np.array([1.0, self.simulator.scenario.needle.length_mm])
        depth, measured = (
            max(0.0, float(self.state.tip[0])),
            max(0.0, self.measured[0] if self.measured else 0.0),
        )
        off_path = self.drift * max(0.0, depth**2 - measured**2)
        return float(np.sqrt(arm @ self.covariance @ arm + self.axial + off_path**2))

    def tip_at(self, time: float) -> tuple[float, float]:
        """Estimated position of the tip (mm) at `time`."""
        return along(self.moves, self.tips, time)

    def without_reading(self) -> "Corrected":
        """The estimate of a period without a good reading: innovation 0."""
        return replace(self, innovation=(0.0, 0.0))

    def move(self, applied: Command, begun: float, ended: float) -> "Corrected":
        """Move the estimated needle as the driver did, from `begun` to `ended` (s)."""
        state = self.simulator.step(self.state, Control.from_row(applied))
        tips = np.concatenate([self.tips, state.tip[None]])
        return replace(self, state=state, tips=tips, moves=(*self.moves, Move(begun, ended, applied)))

    def observe(self, measurements: Sequence[Measurement]) -> "Corrected":
        """Correct by good measurements (newest last); a move is closed once a reading of its end has arrived."""
        moves = assigned(self.moves, measurements)
        newest = max((one.time for one in measurements), default=-np.inf)
        at = replace(self, state=self.past, moves=moves)
        past, closed, tips = at, 0, [at.tip]
        for k, done in enumerate(moves):
            at = _followed(at, done)
            tips.append(at.tip)
            if closed == k and newest >= done.ended - 1e-9:
                past, closed = at, k + 1
        return replace(
            at,
            past=past.state,
            covariance=past.covariance,
            axial=past.axial,
            moves=moves[closed:],
            tips=np.array(tips[closed:]),
        )


def _followed(at: Corrected, done: Move) -> Corrected:
    """The estimate after a move: predicted, and corrected by the mean innovation of its readings."""
    before, predicted = at.tip, at.simulator.step(at.state, Control.from_row(done.applied))
    if not done.measurements:
        return replace(at, state=predicted)
    innovation = np.mean([_innovation(before, predicted.tip, done, one) for one in done.measurements], axis=0)
    measured = predicted.tip[:2] + innovation
    noise = float(at.simulator.scenario.tracker.jitter_per_axis / np.sqrt(len(done.measurements)))
    at, predicted = _moved_along(at, done, float(innovation[0]), noise)
    at = replace(
        at,
        innovation=(float(innovation[0]), float(innovation[1])),
        measured=(float(measured[0]), float(measured[1])),
    )
    if predicted.tip[0] > 0.0:
        return replace(at, state=_held(at, predicted, measured))
    if not at.correction.fits_start:
        return replace(at, state=at.simulator.assimilate(predicted, measured.tolist()).state)
    return _fit_start(at, predicted, float(measured[1] - predicted.tip[1]), noise)


def _innovation(before: Floats, after: Floats, done: Move, measurement: Measurement) -> Floats:
    """Reading (mm) less prediction at its time, the move taken as even, shape (2,)."""
    expected: Floats = before[:2] + done.part(measurement.time) * (after[:2] - before[:2])
    return np.asarray(place(measurement)) - expected


def _moved_along(at: Corrected, done: Move, off: float, noise: float) -> tuple[Corrected, State]:
    """One step of a Kalman filter on the start along the axis, and the move predicted again with it.

    In one step with the correction: its cut can still follow the measured tip.
    """
    gain = at.axial / (at.axial + noise**2 + 1e-12)
    moved = at.state.with_estimate(base_x=float(at.state.base[0]) + gain * off)
    predicted = at.simulator.step(moved, Control.from_row(done.applied))
    return replace(at, axial=(1.0 - gain) * at.axial), predicted


def _bevel_reach(simulator: Simulator, depth: float) -> float:
    """Lateral distance (mm) of the tip from the straight at `depth` (mm), with the bevel never rolled."""
    setup = simulator.scenario.setup
    travel = min(depth + setup.tip_to_skin_mm, setup.stroke_mm)
    steps = int(np.ceil(travel / setup.max_advance_mm - 1e-9))
    controls = np.zeros((1, steps, 5))
    controls[:, :, 0], controls[:, :, 4] = travel / steps, -1.0
    return abs(float(simulator.rollout(simulator.start(), controls).tips[0, -1, 1]))


def _fit_start(at: Corrected, predicted: State, innovation: float, noise: float) -> Corrected:
    """One step of recursive least squares on base y and θ; linear, since only the guide touches the needle."""
    simulator = at.simulator
    sensitivity = np.array(
        [_tip_shift(simulator, predicted, 1.0, 0.0), _tip_shift(simulator, predicted, 0.0, 1e-3) / 1e-3]
    )
    spread = at.covariance @ sensitivity
    gain = spread / (sensitivity @ spread + noise**2 + 1e-12)
    base_y, base_turn = predicted.base[1:] + gain * innovation
    corrected = simulator.step(
        predicted.with_estimate(base_y=float(base_y), base_turn=float(base_turn)), Control()
    )
    return replace(at, state=corrected, covariance=at.covariance - np.outer(gain, spread))


def _tip_shift(simulator: Simulator, state: State, base_y: float, base_turn: float) -> float:
    """Lateral shift of the tip (mm) for a shift of the base (mm, rad)."""
    _, y, turn = state.base
    moved = state.with_estimate(base_y=float(y) + base_y, base_turn=float(turn) + base_turn)
    return float(simulator.step(moved, Control()).tip[1] - state.tip[1])


def _held(at: Corrected, predicted: State, measured: Floats) -> State:
    """The state with the tip held at its measured position and, if it is estimated, the low-passed load of that."""
    held = at.simulator.assimilate(predicted, measured.tolist()).state
    if not at.correction.estimates_load:
        return held
    gain = at.simulator.scenario.control.load_gain
    return held.with_estimate(tip_load=held.tip_load + gain * held.reactions.tip_force)
