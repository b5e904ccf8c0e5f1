"""Observer that corrects the state of the model by the readings, so that its prediction has no offset.

Readings are late. Each belongs to the move in which it was taken; the estimate is corrected there, and the moves since
are predicted again (a fixed-lag filter).

The start error along the axis and the scale of the advance are estimated from all readings (a Kalman filter). In air
the free end is short and stiff, so that noise would act as a force: there the start offset and angle of the base are
fitted (recursive least squares with a prior). In tissue the measured tip is an essential condition, and the force that
it needs, low-passed, remains as a tip load in the prediction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexneedle.estimation.axial import (
    EvenAdvance,
    axial_prior,
    axial_variance,
    carry_out,
    fit_even_advance,
)
from flexneedle.estimation.estimate import NONE, describe_estimate
from flexneedle.estimation.moves import Move, assign_readings, drop_roll_readings, position_along, tip_of
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, ORIGIN, STILL, THETA, Floats, Measurement, Motion, Point, Reading, X, Y, Z

_APART_MM = 1.0  # least distance along x of points that hold the needle, and of the last from the tip
_DRIFT = 0.5  # of the path that the bevel bends: standard deviation of a model's error


@dataclass(frozen=True)
class StateCorrection:
    """Observer that estimates the pose of the base clamp in air, and a tip load in tissue.

    Without the load the prediction releases the measured tip, as in the paper. It uses the position of the tip with the
    scenario's noise, not the direction, points and covariances that a measurement may have.
    """

    fits_start: bool = True
    estimates_load: bool = True

    def begin(self, task: Task) -> "Corrected":
        """Return the estimate before the first reading: a straight needle, and the scenario's prior."""
        simulator, control = task.simulator, task.scenario.control
        prior = np.diag([control.start_offset_sd_mm**2, control.start_angle_sd**2])
        state = simulator.start(task.plan.roll)
        drift = _DRIFT * _bevel_reach(simulator, task.plan.target[0]) / task.plan.target[0] ** 2
        return Corrected(simulator, self, state, state, prior, axial_prior(control), state.tip[None], drift)


@dataclass(frozen=True, eq=False)
class Corrected:
    """An `Estimate`."""

    simulator: Simulator
    correction: StateCorrection  # quantities that are estimated
    state: State  # present state
    past: State  # state before the first of `moves`
    covariance: Floats  # covariance (2, 2) of base y (mm) and θ (rad) before `moves`
    axial: Floats  # covariance (2, 2) of the start along the axis (mm) and of the scale of the advance before `moves`
    tips: Floats  # estimated tip poses (k + 1, 5) at the ends of the moves, the start first
    drift: float  # standard deviation of the path's curvature (1/mm)
    axial_start: float = 0.0  # start error along the axis (mm), of the tip
    axial_scale: float = 1.0  # advance of the needle over the commanded advance
    # commanded advance, readings minus it (mm), and their variance (mm²), of the moves before `moves`
    advances: tuple[tuple[float, float, float], ...] = ()
    moves: tuple[Move, ...] = ()  # moves whose readings may still arrive
    innovation: Point = (0.0, 0.0, 0.0)  # the last reading minus its prediction (mm)
    # tip measured at the end of the last move with a reading (mm), None before the first
    measured: Point | None = None

    def __repr__(self) -> str:
        return describe_estimate(self)

    @property
    def tip(self) -> Floats:
        """Tip pose (5,)."""
        return self.state.tip

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip.

        A path that leaves the model's by drift · x² below the skin leaves it by drift · (x² − s²) after a reading at s.
        """
        arm = np.array([self.simulator.scenario.needle.length_mm])
        axes = self.simulator.scenario.setup.axes
        axial = axial_variance(self.axial, (1.0, float(self.state.travel[DB_X])))
        return float(np.sqrt(axes * self._across(self.state.tip[:1], arm)[0] + axial))

    @property
    def even_advance(self) -> EvenAdvance:
        """Advance of a constant scale that fits the readings along the axis best, whatever the prior of the scale."""
        travel, ahead, variance = np.array(self.advances).reshape(-1, 3).T
        columns = np.stack([np.ones_like(travel), travel])
        return fit_even_advance(ahead, columns, variance, axial_prior(self.simulator.scenario.control))

    def _across(self, x: Floats, arms: Floats) -> Floats:
        """Return the variance (n,), mm², of positions on a lateral axis at x (n,), mm, `arms` (n,) from the base."""
        arm = np.stack([np.ones_like(arms), arms])
        measured = max(0.0, self.measured[0] if self.measured else 0.0)
        off_path = self.drift * np.maximum(0.0, np.maximum(x, 0.0) ** 2 - measured**2)
        variance: Floats = np.einsum("kn,kl,ln->n", arm, self.covariance, arm) + off_path**2
        return variance

    def shape_sd(self, nodes: Floats) -> Floats:
        """Return standard deviations (n, 2), mm, of y and z at predicted nodes (n, 5), the same on each axis."""
        sd = np.sqrt(self._across(nodes[:, 0], nodes[:, 0] - nodes[0, 0]))[:, None]
        return sd * ([1.0, 0.0] if self.simulator.scenario.setup.axes == 1 else [1.0, 1.0])

    def tip_at(self, time: float) -> Point:
        """Return the estimated position of the tip (mm) at `time`."""
        return position_along(self.moves, self.tips, time)

    def without_reading(self) -> "Corrected":
        """Return the estimate of a period without a good reading: innovation 0."""
        return replace(self, innovation=(0.0, 0.0, 0.0))

    def move(self, motion: Motion) -> "Corrected":
        """Move the estimated needle as the driver did."""
        if motion.control == STILL and self._rests_unread:  # one move, however long
            return replace(self, moves=(*self.moves[:-1], self.moves[-1].extend(motion.ended)))
        state = carry_out(self.simulator, self.state, motion.control, self.axial_scale)
        tips = np.concatenate([self.tips, state.tip[None]])
        return replace(self, state=state, tips=tips, moves=(*self.moves, Move.of(motion)))

    @property
    def _rests_unread(self) -> bool:
        """True if the last move was a rest, and no reading of it has arrived."""
        return bool(self.moves) and self.moves[-1].applied == STILL and not self.moves[-1].measurements

    def observe(
        self, measurements: Sequence[Measurement], along: Mapping[str, Sequence[Reading]] = NONE
    ) -> "Corrected":
        """Correct by good measurements (newest last); a move is closed once a reading of its end has arrived.

        With `control.essential_points` the newest points of sensors along the needle hold it, too, in the last move
        with a reading.
        """
        used = drop_roll_readings(self.moves, measurements)
        moves = assign_readings(self.moves, used)
        newest = max((one.time for one in used), default=-np.inf)
        at = replace(self, state=self.past, moves=moves)
        past, closed, tips = at, 0, [at.tip]
        points = _newest_points(along) if self.simulator.scenario.control.essential_points else ()
        last = max((k for k, done in enumerate(moves) if done.measurements), default=-1)
        for k, done in enumerate(moves):
            at = _follow(at, done, points if k == last else ())
            tips.append(at.tip)
            if closed == k and newest >= done.motion.ended - 1e-9:
                past, closed = at, k + 1
        return replace(
            at,
            past=past.state,
            covariance=past.covariance,
            axial=past.axial,
            axial_start=past.axial_start,
            axial_scale=past.axial_scale,
            advances=past.advances,
            moves=moves[closed:],
            tips=np.array(tips[closed:]),
        )


def _newest_points(along: Mapping[str, Sequence[Reading]]) -> tuple[Point, ...]:
    """Return x, y, z (mm) of the newest reading of each sensor that has them."""
    rows = (row for readings in along.values() if readings for row in readings[-1].rows)
    return tuple((row[0], row[1], row[2]) for row in rows if len(row) == len(ORIGIN))


def _follow(at: Corrected, done: Move, points: Sequence[Point] = ()) -> Corrected:
    """Return the estimate after a move: predicted, and corrected by the mean innovation of its readings.

    points: that hold the needle in tissue.
    """
    before, predicted = at.tip, carry_out(at.simulator, at.state, done.applied, at.axial_scale)
    if not done.measurements:
        return replace(at, state=predicted)
    innovation = np.mean([_innovation(before, predicted.tip, done, one) for one in done.measurements], axis=0)
    measured = predicted.tip[: Z + 1] + innovation
    noise = float(at.simulator.scenario.tracker.jitter_per_axis / np.sqrt(len(done.measurements)))
    at, predicted = _correct_axially(at, done, float(innovation[0]), noise)
    at = replace(
        at,
        innovation=_as_point(innovation),
        measured=_as_point(measured),
    )
    if predicted.tip[0] > 0.0:
        return replace(at, state=_hold_tip(at, predicted, measured, points))
    if not at.correction.fits_start:
        return replace(at, state=_assimilate(at, predicted, measured))
    return _fit_start(at, predicted, measured[Y:] - predicted.tip[Y : Z + 1], noise)


def _innovation(before: Floats, after: Floats, done: Move, measurement: Measurement) -> Floats:
    """Return the reading minus the prediction at its time (3,), mm, for an even move."""
    here, there = before[: Z + 1], after[: Z + 1]
    expected: Floats = here + done.part(measurement.time) * (there - here)
    return np.asarray(tip_of(measurement)) - expected


def _as_point(values: Floats) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def _assimilate(at: Corrected, predicted: State, measured: Floats, points: Sequence[Point] = ()) -> State:
    """Return the state with the tip held where it was measured, and the needle at points in the tissue behind it."""
    axes = at.simulator.scenario.setup.axes
    held: list[Point] = []
    for point in sorted(points):
        if (
            max(0.0, held[-1][0] if held else 0.0) + _APART_MM
            < point[0]
            < float(predicted.tip[X]) - _APART_MM
        ):
            held.append(point)
    inside = [point[: 1 + axes] for point in held]
    return at.simulator.assimilate(predicted, measured[: 1 + axes].tolist(), inside).state


def _correct_axially(at: Corrected, done: Move, off: float, noise: float) -> tuple[Corrected, State]:
    """Return start and scale along the axis corrected by a Kalman filter's step, and the move predicted again.

    Prediction and correction are one step, so that the cut of the move still follows the measured tip.
    """
    before = float(at.state.travel[DB_X])
    part = np.mean([done.part(one.time) for one in done.measurements])
    sensitivity = np.array([1.0, before + part * done.applied.db_x])
    spread = at.axial @ sensitivity
    gain = spread / (sensitivity @ spread + noise**2 + 1e-12)
    start, scale = (gain * off).tolist()
    ahead = at.axial_start + (at.axial_scale - 1.0) * float(sensitivity[1]) + off
    moved = at.state.with_estimate(base_x=float(at.state.base[X]) + start + scale * before)
    corrected = replace(
        at,
        axial=at.axial - np.outer(gain, spread),
        axial_start=at.axial_start + start,
        axial_scale=at.axial_scale + scale,
        advances=(*at.advances, (float(sensitivity[1]), ahead, noise**2)),
    )
    return corrected, carry_out(at.simulator, moved, done.applied, corrected.axial_scale)


def _bevel_reach(simulator: Simulator, depth: float) -> float:
    """Return the lateral distance (mm) of the tip from the entry's axis at `depth` (mm), without rolls."""
    setup = simulator.scenario.setup
    travel = min(depth + setup.tip_to_skin_mm, setup.stroke_mm)
    steps = int(np.ceil(travel / setup.max_advance_mm - 1e-9))
    straight = controls(1, steps, db_x=travel / steps)
    x, y, z, *_ = simulator.rollout(simulator.start(), straight).tips[0, -1].tolist()
    return abs(complex(y, z) - simulator.scenario.entry.lateral(x))


def _fit_start(at: Corrected, predicted: State, innovation: Floats, noise: float) -> Corrected:
    """Return the estimate after a step of recursive least squares on base position and slope.

    The gain is the same on both axes. The problem is linear, since only the guide touches the needle. innovation (2,):
    y, z.
    """
    simulator = at.simulator
    sensitivity = np.array(
        [_tip_shift(simulator, predicted, 1.0, 0.0), _tip_shift(simulator, predicted, 0.0, 1e-3) / 1e-3]
    )
    spread = at.covariance @ sensitivity
    gain = spread / (sensitivity @ spread + noise**2 + 1e-12)
    axes = simulator.scenario.setup.axes
    base, slope = (
        (predicted.base[first : first + axes] + one * innovation[:axes]).tolist()
        for first, one in zip((Y, THETA), gain.tolist(), strict=True)
    )
    turned = predicted.with_estimate(base=base, slope=slope)
    # An oblique needle that is turned moves along the axis, too, but the readings along it say where its tip is.
    along = _read_share(at) * float(predicted.tip[X] - simulator.step(turned, STILL).tip[X])
    corrected = simulator.step(turned.with_estimate(base_x=float(turned.base[X]) + along), STILL)
    return replace(at, state=corrected, covariance=at.covariance - np.outer(gain, spread))


def _read_share(at: Corrected) -> float:
    """Return the share of the start's variance along the axis that readings have removed; 0 for a known start."""
    prior = at.simulator.scenario.control.start_axial_sd_mm**2
    return 1.0 - float(at.axial[0, 0]) / prior if prior else 0.0


def _tip_shift(simulator: Simulator, state: State, base_y: float, base_turn: float) -> float:
    """Return the shift of the tip (mm) along y for a shift of the base along it (mm, rad)."""
    _, y, z, theta, psi = state.base.tolist()
    moved = state.with_estimate(base=(y + base_y, z), slope=(theta + base_turn, psi))
    return float(simulator.step(moved, STILL).tip[Y] - state.tip[Y])


def _hold_tip(at: Corrected, predicted: State, measured: Floats, points: Sequence[Point]) -> State:
    """Return the state with the tip held at its measured position and, if estimated, the low-passed load."""
    held = _assimilate(at, predicted, measured, points)
    if not at.correction.estimates_load:
        return held
    gain = at.simulator.scenario.control.load_gain
    load = np.add(held.tip_load, gain * np.array(held.reactions.tip_force))
    return held.with_estimate(tip_load=load.tolist())
