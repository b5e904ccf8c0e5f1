"""Observer that corrects the model: parameters of start, needle and tissue are fitted to all readings.

Maximum a posteriori by Gauss–Newton, one step a period: the insertion is simulated again with other parameters, which
takes a millisecond, and compared with the lateral readings. Parameters, with normal priors from the scenario:

    base y (mm), base θ (rad), natural bend of the needle (mm), run-out (mm), factor on the bevel offset,
    clearance of the needle in the guide (mm),
    ln of the factor on each layer's modulus, shift (mm) of each boundary between layers,
    ln of a further factor on the modulus in cells along the depth, correlated over a length.

So tissue ahead of the tip is estimated as far as it is correlated with the tissue behind it. The start along the axis
is a shift of all axial readings, fitted separately. The residuals of the fit are low-passed and added as a constant.

The derivative of the lateral position with respect to a parameter is kept as a curve over the depth of the tip, a few
steps ahead of it too. A few of the curves are simulated again each period, so that none is older than `_ROUND` periods.
"""

import cmath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexneedle.estimation.adapted import adapt_model, settle_start
from flexneedle.estimation.estimate import describe_estimate
from flexneedle.estimation.lateral import directions, from_components, variance_of
from flexneedle.estimation.moves import Move, assign_readings, position_along
from flexneedle.estimation.prior import LEAST_SD, Prior, Priors, Slots, check_cells
from flexneedle.estimation.readings import MoveMeans, fit_constant
from flexneedle.estimation.sensor import Sensor
from flexneedle.estimation.sensors import sensors_of
from flexneedle.estimation.task import Task
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL, Floats, Laterals, Measurement, Motion, Point, X, Y, Z, laterals

_MOVES_A_SEGMENT = 8  # in tissue; in air there is one segment
_RECENT = 12  # moves whose residuals are low-passed
_SHARES = (1.0, 0.5, 0.2, 0.05, 0.0)  # of a Gauss–Newton step: the first that does not raise the cost
_UNEVEN = (
    0.2  # of an offset that turns with the bevel: error of its mean in a roll, whose motor starts and stops
)
_ROUND = 8  # periods in which each curve of derivatives is simulated once;
_LEADING_ROUND = 2  # periods in which those of base, bend, bevel and clearance are


@dataclass(frozen=True)
class Identification:
    """The observer of `adaptive-mpc`, whose settings it uses."""

    def begin(self, task: Task) -> "Identified":
        """Return the estimate before the first reading, the prior's means. Raises ScenarioError for too short cells."""
        simulator, scenario, settings = task.simulator, task.scenario, task.settings
        check_cells(scenario, settings)
        state, prior = simulator.start(task.plan.roll), Prior.of(scenario, settings, task.plan.target[0])
        step = scenario.setup.max_advance_mm
        grid = np.arange(
            scenario.setup.start_tip_x - 5 * step, scenario.setup.max_depth + (_ROUND + 6) * step, step
        )
        start = Identified(
            simulator,
            settings,
            prior,
            simulator,
            prior.mean,
            state,
            state.tip[None],
            ((0, state),),
            grid,
            np.zeros(
                (len(sensors_of(scenario)), prior.mean.size, grid.size),
                dtype=float if scenario.setup.axes == 1 else complex,
            ),
            prior.precision,
            axial_variance=scenario.control.start_axial_sd_mm**2,
        )
        return start._differentiate(range(prior.mean.size))


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The present needle with one parameter larger by `step`: its model and state."""

    parameter: int
    step: float
    simulator: Simulator
    state: State


@dataclass(frozen=True, eq=False)
class Identified:
    """An `Estimate` with fitted parameters.

    Attributes:
        nominal: The scenario's model, to which the prior refers.
        settings: Settings of the observer.
        prior: Prior of the parameters.
        simulator: The model with the parameters.
        parameters: Posterior means (K,).
        state: Present state of the model.
        tips: Tip poses (m + 1, 5) at the ends of the m moves, the start first.
        stops: State before some of the moves.
        grid: Depths of the tip (g,), mm.
        curves: Derivatives (S, K, g) of the sensors' quantities over the depths, the lateral position first.
        precision: Inverse covariance (K, K) of the parameters.
        axial: Start error along the axis (mm).
        axial_variance: Its variance (mm²).
        period: Number of the period.
        perturbed: The present needle with one parameter changed, for some parameters.
        moves: All moves.
        residual: Low-passed residual (mm).
        innovation: The last reading minus its prediction (mm).
        measured: Tip measured at the end of the last move with a reading (mm), None before the first.
    """

    nominal: Simulator
    settings: Priors
    prior: Prior
    simulator: Simulator
    parameters: Floats
    state: State
    tips: Floats
    stops: tuple[tuple[int, State], ...]
    grid: Floats
    curves: Laterals
    precision: Floats
    axial: float = 0.0
    axial_variance: float = 0.0
    period: int = 0
    perturbed: tuple[Perturbed, ...] = ()
    moves: tuple[Move, ...] = ()
    residual: complex = 0.0
    innovation: Point = (0.0, 0.0, 0.0)
    measured: Point | None = None

    def __repr__(self) -> str:
        return describe_estimate(self)

    @property
    def tip(self) -> Floats:
        """Tip pose (5,) as measured: the model's, plus the tip's offset from the needle's axis."""
        tip, off = self.state.tip, self.off_axis(self.state.bevel)
        tip[Y] += off.real
        tip[Z] += off.imag
        return tip

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return self.nominal.scenario.setup.axes

    @cached_property
    def slots(self) -> Slots:
        """Places of the parameters."""
        return Slots.of(self.nominal.scenario)

    @property
    def run_out(self) -> complex:
        """Lateral offset (mm) of the measured tip from the needle's axis, relative to the bevel's direction."""
        return from_components(self.parameters[self.slots.run_out])

    def off_axis(self, bevel: complex) -> complex:
        """Return the lateral offset (mm) of the measured tip from the model's, with the bevel in this direction."""
        return self.run_out * bevel + self.residual

    def tip_at(self, time: float) -> Point:
        """Return the estimated position of the tip (mm) at `time`."""
        x, y, z = position_along(self.moves, self.tips, time)
        left = sum(done.left_to_turn(time) for done in self.moves if time < done.ended)
        off = self.off_axis(self.state.bevel * cmath.exp(-1j * left))
        return x, y + off.real, z + (off.imag if self.axes > 1 else 0.0)

    def without_reading(self) -> "Identified":
        """Return the estimate of a period without a good reading: innovation 0."""
        return replace(self, innovation=(0.0, 0.0, 0.0))

    def move(self, motion: Motion) -> "Identified":
        """Move the estimated needle as the driver did."""
        rested = self.moves and self.moves[-1].applied == STILL
        if motion.control == STILL and rested:  # one move, however long
            last = replace(self.moves[-1], ended=motion.ended)
            return replace(self, moves=(*self.moves[:-1], last), perturbed=())
        new = Move.parts_of(motion)
        state, tips = self.simulator.replay(self.state, np.array([done.applied for done in new]))
        tips = np.concatenate([self.tips, tips])
        return replace(self, state=state, tips=tips, moves=(*self.moves, *new), perturbed=())

    def observe(self, measurements: Sequence[Measurement]) -> "Identified":
        """Fit the parameters to all readings by one Gauss–Newton step, and simulate the insertion with them."""
        if not measurements or not self.moves:
            return self.without_reading()
        extended = replace(self, moves=assign_readings(self.moves, measurements))
        readings = extended._readings[0]
        without = readings.ahead(extended.tips[:, X]) + extended.axial
        prior_sd = max(self.nominal.scenario.control.start_axial_sd_mm, LEAST_SD)
        axial, axial_variance = fit_constant(without, extended.axial_variances(), prior_sd)
        extended = replace(extended, axial=axial, axial_variance=axial_variance)
        fitted = improve_fit(extended)._differentiate()
        left, ahead = fitted.left[0], readings.ahead(fitted.tips[:, X])
        newest = int(readings.index[-1]) + 1
        since = sum(done.applied.roll + done.applied.spin for done in fitted.moves[newest:])
        bevel = fitted.state.bevel * cmath.exp(-1j * since)
        y = complex(fitted.laterals[0][newest] + left[-1] + fitted.run_out * bevel)
        inside = fitted.tips[-1, X] > 0.0
        return replace(
            fitted,
            residual=low_pass(self.settings, left) if inside else 0.0,
            innovation=(float(ahead[-1]), float(left[-1].real), float(left[-1].imag)),
            measured=(float(fitted.tips[newest, X] + ahead[-1]), y.real, y.imag if self.axes > 1 else 0.0),
        )

    @cached_property
    def rows(self) -> Floats:
        """The commands of the moves (m, 9)."""
        return np.array([done.applied for done in self.moves], dtype=float).reshape(-1, len(STILL))

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors in use, the tip's position first."""
        return sensors_of(self.nominal.scenario)

    @cached_property
    def _readings(self) -> tuple[MoveMeans, ...]:
        return tuple(MoveMeans.of(self.moves, one.name, self.state.bevel, self.axes) for one in self.sensors)

    def variances(self) -> list[Floats]:
        """Return variances (r,) of the means of each sensor's readings: jitter, model error, angle error in a roll."""
        scenario, sd = self.nominal.scenario, 1.0 / np.sqrt(np.diag(self.prior.precision))
        return [
            readings.variance(sensor.sd(scenario) or 0.0, sensor.unexplained(scenario, self.settings))
            + np.where(readings.turns, (_UNEVEN * sd[getattr(self.slots, sensor.offset).start]) ** 2, 0.0)
            for sensor, readings in zip(self.sensors, self._readings, strict=True)
        ]

    def axial_variances(self) -> Floats:
        """Return variances (r,) of the means of the tip's x: jitter and model error."""
        scenario, position = self.nominal.scenario, self.sensors[0]
        unexplained = position.unexplained(scenario, self.settings)
        return self._readings[0].axial_variance(position.sd(scenario) or 0.0, unexplained)

    @property
    def laterals(self) -> list[Laterals]:
        """Lateral quantity (m + 1,) of the tips for each sensor; the first is their position (mm)."""
        return [laterals(self.tips, sensor.column, self.axes) for sensor in self.sensors]

    @property
    def left(self) -> list[Laterals]:
        """Lateral residuals (r,) of each sensor: readings minus the model's quantities."""
        return [
            readings.left(tips, from_components(self.parameters[getattr(self.slots, sensor.offset)]))
            for sensor, readings, tips in zip(self.sensors, self._readings, self.laterals, strict=True)
        ]

    def _simulate_with(self, parameters: Floats) -> "Identified":
        """Return the estimate with these parameters: the insertion is simulated again, in segments."""
        simulator = adapt_model(self.nominal, self.settings, parameters)
        state = self._settle_start(simulator, parameters)
        inside = int(np.argmax(np.append(self.tips[1:, X], np.inf) > 0.0))
        ends = [*range(min(inside, len(self.rows)), len(self.rows), _MOVES_A_SEGMENT), len(self.rows)]
        stops, parts, first = [], [state.tip[None]], 0
        for last in ends:
            stops.append((first, state))
            if last > first:
                state, tips = simulator.replay(state, self.rows[first:last])
                parts.append(tips)
            first = last
        return replace(
            self,
            simulator=simulator,
            parameters=parameters,
            state=state,
            tips=np.concatenate(parts),
            stops=tuple(stops),
        )

    def _settle_start(self, simulator: Simulator, parameters: Floats) -> State:
        """Return the state of the start with these parameters."""
        return settle_start(self.nominal, simulator, parameters, self.stops[0][1].roll, self.axial)

    @cached_property
    def covariance(self) -> Floats:
        """Posterior covariance (K, K) of the parameters."""
        inverse: Floats = np.linalg.inv(self.precision).astype(np.float64)
        return inverse

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip."""
        slope = self._slopes(self.state.tip[:1])[0]
        slope[self.slots.run_out] = directions(self.state.bevel, self.axes)
        return float(np.sqrt(variance_of(slope, self.covariance) + self.axial_variance))

    def shape_sd(self, nodes: Floats) -> Floats:
        """Return standard deviations (n, 2), mm, of y and z at nodes (n, 5), as of a tip that passes there."""
        slopes = self._slopes(nodes[:, 0])
        parts = np.stack([slopes.real, slopes.imag])
        sd: Floats = np.sqrt(np.einsum("ank,kl,anl->na", parts, self.covariance, parts))
        return sd

    @property
    def bevel_sd(self) -> float:
        """Standard deviation of the factor on the bevel offset, relative to it."""
        k = self.slots.bevel
        return float(np.sqrt(self.covariance[k, k]) / max(self.parameters[k], LEAST_SD))

    @property
    def lag(self) -> float:
        """Time (s) from the newest reading to the end of the last move."""
        times = (one.time for done in reversed(self.moves) for one in reversed(done.measurements))
        return self.moves[-1].ended - next(times, 0.0) if self.moves else 0.0

    @property
    def roll_sd(self) -> float:
        """Standard deviation (mm) of the tip's lateral motion if the bevel rolls now."""
        bend, run_out = self.slots.bend, self.slots.run_out
        slope = np.zeros(self.parameters.size, dtype=self.curves.dtype)
        slope[bend] = 2.0 * self._slopes(self.state.tip[:1])[0, bend]
        slope[run_out] = 2.0 * directions(1.0, self.axes)
        return float(np.sqrt(variance_of(slope, self.covariance)))

    def _slopes(self, depth: Floats, sensor: int = 0) -> Laterals:
        """Return derivatives (n, K) of a sensor's quantity at depths (n,), mm, from the curves; 0 for its offset."""
        step = self.grid[1] - self.grid[0]
        place = np.clip((depth - self.grid[0]) / step, 0.0, self.grid.size - 1.001)
        left = place.astype(int)
        part = place - left
        curves = self.curves[sensor]
        slopes: Laterals = ((1.0 - part) * curves[:, left] + part * curves[:, left + 1]).T
        return slopes

    def _differentiate(self, which: Sequence[int] | None = None) -> "Identified":
        """Simulate the curves that are due again, with a few steps ahead."""
        ahead = controls(_ROUND, db_x=self.nominal.scenario.setup.max_advance_mm)
        base = np.concatenate([self.tips, self.simulator.replay(self.state, ahead)[1]])
        depth = np.maximum.accumulate(base[:, X])
        curves, members = self.curves.copy(), []
        for k in self._due_parameters() if which is None else which:
            if self.slots.is_offset(k):
                continue
            parameters = self.parameters.copy()
            parameters[k] += self.prior.steps[k]
            if depth[-1] < self.prior.begins[k]:
                simulator = adapt_model(self.nominal, self.settings, parameters)
                members.append(Perturbed(k, float(self.prior.steps[k]), simulator, self.state))
                continue
            member, tips = _perturb(self, parameters, k, ahead)
            members.append(member)
            for curve, sensor in zip(curves[:, k], self.sensors, strict=True):
                moved = laterals(tips, sensor.column, self.axes) - laterals(base, sensor.column, self.axes)
                curve[:] = np.interp(self.grid, depth, moved / self.prior.steps[k])
        return replace(self, curves=curves, perturbed=tuple(members), period=self.period + 1)

    @property
    def reading_variance(self) -> float:
        """Variance of the mean of the readings of a control step (mm²)."""
        scenario = self.nominal.scenario
        step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
        count = max(1.0, step / scenario.tracker.period)
        unexplained = self.sensors[0].unexplained(scenario, self.settings)
        return float(scenario.tracker.jitter_per_axis**2 / count + unexplained**2)

    def _due_parameters(self) -> Iterator[int]:
        """Yield the parameters whose curves are simulated this period."""
        leading = (*range(self.slots.run_out.start), self.slots.bevel, self.slots.clearance)
        for place, k in enumerate(leading):
            if place % _LEADING_ROUND == self.period % _LEADING_ROUND:
                yield k
        for k in range(self.slots.modulus, self.parameters.size):
            if k % _ROUND == self.period % _ROUND:
                yield k


def improve_fit(estimate: Identified) -> Identified:
    """Return the estimate after a Gauss–Newton step to the maximum a posteriori within the bounds.

    The step is shortened until the cost does not rise.
    """
    prior = estimate.prior
    jacobian = jacobian_of(estimate)
    both = zip(estimate.variances(), estimate._readings, estimate.laterals, strict=True)
    variance = np.concatenate([noise + readings.bent(tips) ** 2 for noise, readings, tips in both])
    weighted = jacobian.conj().T / variance
    off = estimate.parameters - prior.mean
    gradient = (weighted @ np.concatenate(estimate.left)).real - prior.precision @ off
    precision = (weighted @ jacobian).real + prior.precision
    estimate = replace(estimate, precision=precision)
    step = np.linalg.solve(precision, gradient)
    if not np.isfinite(step).all():
        return estimate._simulate_with(estimate.parameters)
    goal = np.clip(estimate.parameters + step, *prior.bounds)

    def cost(other: Identified) -> float:
        squares = np.abs(np.concatenate(other.left)) ** 2
        return float(0.5 * (squares / variance).sum()) + prior.cost(other.parameters)

    most, fitted = cost(estimate), estimate
    for share in _SHARES:
        fitted = estimate._simulate_with(estimate.parameters + share * (goal - estimate.parameters))
        if fitted.state.converged and cost(fitted) <= most:
            break
    return fitted


def jacobian_of(estimate: Identified) -> Laterals:
    """Return the derivative (r, K) of the predicted readings of all sensors, from the curves."""
    parts = []
    for k, (sensor, readings) in enumerate(zip(estimate.sensors, estimate._readings, strict=True)):
        part = estimate._slopes(readings.between(estimate.tips[:, X]), k)
        offset = np.multiply.outer(readings.bevel, directions(1.0, estimate.axes))
        part[:, getattr(estimate.slots, sensor.offset)] = offset
        parts.append(part)
    return np.concatenate(parts)


def _perturb(estimate: Identified, parameters: Floats, k: int, ahead: Floats) -> tuple[Perturbed, Floats]:
    """Return the needle with another value of parameter k, and its tips (m + 1 + a, 5), including a steps `ahead`.

    Moves before the parameter has an effect are not simulated again.
    """
    simulator, begins = (
        adapt_model(estimate.nominal, estimate.settings, parameters),
        float(estimate.prior.begins[k]),
    )
    reached = int(np.argmax(np.append(estimate.tips[:, X], np.inf) > begins))  # by the move before this one
    first, state = max(
        (stop for stop in estimate.stops if stop[0] < max(1, reached)), key=lambda stop: stop[0]
    )
    if first == 0:
        state = estimate._settle_start(simulator, parameters)
    before = np.concatenate([estimate.tips[:first], state.tip[None]])
    now, tips = simulator.replay(state, estimate.rows[first:])
    later = simulator.replay(now, ahead)[1]
    member = Perturbed(k, float(estimate.prior.steps[k]), simulator, now)
    return member, np.concatenate([before, tips, later])


def low_pass(settings: Priors, left: Laterals) -> complex:
    """Return the low-pass of the residuals (r,) of the last moves, later ones with more weight."""
    level, gain = 0.0, settings.residual_gain
    for value in left[-_RECENT:].tolist():
        level += gain * (value - level)
    return level
