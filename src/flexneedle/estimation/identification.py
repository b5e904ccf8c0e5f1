"""An observer that corrects the model: parameters of start, needle and tissue are fitted to all readings.

Maximum a posteriori by Gauss–Newton, one step a period: the insertion is simulated again with other parameters, which
takes a millisecond, and compared with the lateral readings. Parameters, with normal priors from the scenario:

    base y (mm), base θ (rad), natural bend of the needle (mm), run-out (mm), factor on the bevel offset,
    clearance of the needle in the guide (mm),
    ln of the factor on each layer's modulus, shift (mm) of each boundary between layers,
    ln of a further factor on the modulus in cells along the depth, correlated over a length.

So tissue ahead of the tip is estimated as far as it is correlated with that behind it. The start along the axis is a
shift of all axial readings, fitted separately. The residuals of the fit are low-passed and added as a constant.

The derivative of the lateral position with respect to a parameter is kept as a curve over the depth of the tip, a few
steps ahead of it too. A few of the curves are simulated again each period, so that none is older than `_ROUND`
periods.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexneedle.estimation.estimate import Move, along, assigned, described
from flexneedle.estimation.prior import (
    BASE_TURN,
    BASE_Y,
    BEND,
    BEVEL,
    CLEARANCE,
    LEAST_SD,
    MODULUS,
    RUN_OUT,
    Prior,
    Priors,
    check_cells,
    unexplained,
)
from flexneedle.estimation.readings import MoveMeans, shared
from flexneedle.estimation.task import Task
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import Command, Floats, Measurement

_MOVES_A_SEGMENT = 8  # in tissue; in air there is one segment
_RECENT = 12  # moves whose residuals are low-passed
_SHARES = (1.0, 0.5, 0.2, 0.05, 0.0)  # of a Gauss–Newton step: the first that does not raise the cost
_REST = np.array([[0.0, 0.0, 0.0, 0.0, -1.0]])
_ROUND = 8  # periods in which each curve of derivatives is simulated once;
_LEADING = (BASE_Y, BASE_TURN, BEND, BEVEL, CLEARANCE)  # these are once in
_LEADING_ROUND = 2  # periods
_STILL: Command = (0.0, 0.0, 0.0, 0.0, -1)


@dataclass(frozen=True)
class Identification:
    """The observer of `adaptive-mpc`, whose settings it uses."""

    def begin(self, task: Task) -> "Identified":
        """The estimate before the first reading: the prior's means. Raises ScenarioError for too short cells."""
        simulator, scenario, settings = task.simulator, task.scenario, task.settings
        check_cells(scenario, settings)
        state, prior = simulator.start(task.plan.bevel), Prior.of(scenario, settings, task.plan.target[0])
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
            np.zeros((prior.mean.size, grid.size)),
            prior.precision,
            axial_variance=scenario.control.start_axial_sd_mm**2,
        )
        return start._differentiated(range(prior.mean.size))


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The present needle with one parameter larger by `step`: its model and state."""

    parameter: int
    step: float
    simulator: Simulator
    state: State


@dataclass(frozen=True, eq=False)
class Identified:
    """The estimate. nominal: the scenario's model, to which the prior refers; simulator: that with the parameters (K,);
    state: its present state; tips (m + 1, 3): at the ends of the m moves, the start first; stops: its state before some
    of the moves; grid (g,), curves (K, g): derivatives of the tip's lateral position over its depth (mm);
    precision (K, K): inverse covariance of the parameters; axial: start error along the axis (mm); period: its number.
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
    curves: Floats
    precision: Floats
    axial: float = 0.0
    axial_variance: float = 0.0
    period: int = 0
    perturbed: tuple[Perturbed, ...] = ()
    moves: tuple[Move, ...] = ()
    residual: float = 0.0
    innovation: tuple[float, float] = (0.0, 0.0)
    measured: tuple[float, float] | None = None

    def __repr__(self) -> str:
        return described(self)

    @property
    def tip(self) -> Floats:
        """Tip pose (3,) as measured: that of the model plus the tip's offset from the needle's axis."""
        tip = self.state.tip
        tip[1] += self.off_axis(self.state.bevel)
        return tip

    @property
    def run_out(self) -> float:
        """Lateral offset (mm) of the measured tip from the needle's axis, with the bevel on the side +1."""
        return float(self.parameters[RUN_OUT])

    def off_axis(self, bevel: float) -> float:
        """Lateral offset (mm) of the measured tip from the model's, with the bevel on the side `bevel`."""
        return self.run_out * bevel + self.residual

    def tip_at(self, time: float) -> tuple[float, float]:
        """Estimated position of the tip (mm) at `time`."""
        x, y = along(self.moves, self.tips, time)
        rolls_since = sum(done.applied[4] > 0.0 for done in self.moves if done.begun >= time)
        return x, y + self.off_axis(self.state.bevel * (-1) ** rolls_since)

    def without_reading(self) -> "Identified":
        """The estimate of a period without a good reading: innovation 0."""
        return replace(self, innovation=(0.0, 0.0))

    def move(self, applied: Command, begun: float, ended: float) -> "Identified":
        """Move the estimated needle as the driver did, from `begun` to `ended` (s)."""
        if applied == _STILL and self.moves and self.moves[-1].applied == _STILL:  # one move, however long
            last = replace(self.moves[-1], ended=ended)
            return replace(self, moves=(*self.moves[:-1], last), perturbed=())
        state = self.simulator.step(self.state, Control.from_row(applied))
        tips = np.concatenate([self.tips, state.tip[None]])
        return replace(
            self, state=state, tips=tips, moves=(*self.moves, Move(begun, ended, applied)), perturbed=()
        )

    def observe(self, measurements: Sequence[Measurement]) -> "Identified":
        """Fit the parameters to all readings by one Gauss–Newton step, and simulate the insertion with them."""
        if not measurements or not self.moves:
            return self.without_reading()
        extended = replace(self, moves=assigned(self.moves, measurements))
        readings = extended._readings
        without = readings.ahead(extended.tips[:, 0]) + extended.axial
        prior_sd = max(self.nominal.scenario.control.start_axial_sd_mm, LEAST_SD)
        axial, axial_variance = shared(without, extended.variance(readings), prior_sd)
        extended = replace(extended, axial=axial, axial_variance=axial_variance)
        fitted = improved(extended, readings)._differentiated()
        left, ahead = fitted.left(readings), readings.ahead(fitted.tips[:, 0])
        newest = int(readings.index[-1]) + 1
        x, y = fitted.tips[newest, :2] + (ahead[-1], left[-1] + fitted.run_out * readings.sides[-1])
        inside = fitted.tips[-1, 0] > 0.0
        return replace(
            fitted,
            residual=low_passed(self.settings, left) if inside else 0.0,
            innovation=(float(ahead[-1]), float(left[-1])),
            measured=(float(x), float(y)),
        )

    @cached_property
    def rows(self) -> Floats:
        """The commands of the moves (m, 5)."""
        return np.array([done.applied for done in self.moves], dtype=float).reshape(-1, 5)

    @cached_property
    def _readings(self) -> MoveMeans:
        return MoveMeans.of(self.moves, self.state.bevel)

    def variance(self, readings: MoveMeans) -> Floats:
        """Variances (r,) of the means of readings, mm²: jitter and model error."""
        scenario = self.nominal.scenario
        return readings.variance(scenario.tracker.jitter_per_axis, unexplained(scenario, self.settings))

    def left(self, readings: MoveMeans) -> Floats:
        """Lateral residuals (r,), mm: readings minus those of the model."""
        return readings.left(self.tips[:, 1], self.run_out)

    def _with(self, parameters: Floats) -> "Identified":
        """The estimate with these parameters: the insertion simulated again, in segments."""
        simulator = _adapted(self.nominal, self.settings, parameters)
        state = _started(self, simulator, parameters)
        inside = int(np.argmax(np.append(self.tips[1:, 0], np.inf) > 0.0))
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

    @cached_property
    def covariance(self) -> Floats:
        """Posterior covariance (K, K) of the parameters."""
        inverse: Floats = np.linalg.inv(self.precision).astype(np.float64)
        return inverse

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip."""
        slope = self._slopes(self.state.tip[:1])[0]
        slope[RUN_OUT] = self.state.bevel
        return float(np.sqrt(slope @ self.covariance @ slope + self.axial_variance))

    @property
    def bevel_sd(self) -> float:
        """Standard deviation of the factor on the bevel offset, relative to it."""
        return float(np.sqrt(self.covariance[BEVEL, BEVEL]) / max(self.parameters[BEVEL], LEAST_SD))

    @property
    def lag(self) -> float:
        """Time (s) from the newest reading to the end of the last move."""
        times = (one.time for done in reversed(self.moves) for one in reversed(done.measurements))
        return self.moves[-1].ended - next(times, 0.0) if self.moves else 0.0

    @property
    def roll_sd(self) -> float:
        """Standard deviation (mm) of the tip's lateral motion if the bevel rolls now."""
        slope = np.zeros(self.parameters.size)
        slope[BEND] = 2.0 * self._slopes(self.state.tip[:1])[0, BEND]
        slope[RUN_OUT] = 2.0
        return float(np.sqrt(slope @ self.covariance @ slope))

    def _slopes(self, depth: Floats) -> Floats:
        """Derivatives (n, K) of the tip's lateral position at depths (n,), mm, from the curves; 0 for the run-out."""
        step = self.grid[1] - self.grid[0]
        place = np.clip((depth - self.grid[0]) / step, 0.0, self.grid.size - 1.001)
        left = place.astype(int)
        part = place - left
        slopes: Floats = ((1.0 - part) * self.curves[:, left] + part * self.curves[:, left + 1]).T
        return slopes

    def _differentiated(self, which: Sequence[int] | None = None) -> "Identified":
        """Simulate the curves that are due again, with a few steps ahead."""
        ahead = np.tile([[self.nominal.scenario.setup.max_advance_mm, 0.0, 0.0, 0.0, -1.0]], (_ROUND, 1))
        base = np.concatenate([self.tips, self.simulator.replay(self.state, ahead)[1]])
        depth = np.maximum.accumulate(base[:, 0])
        curves, members = self.curves.copy(), []
        for k in self._due() if which is None else which:
            if k == RUN_OUT:
                continue
            parameters = self.parameters.copy()
            parameters[k] += self.prior.steps[k]
            if depth[-1] < self.prior.begins[k]:
                simulator = _adapted(self.nominal, self.settings, parameters)
                members.append(Perturbed(k, float(self.prior.steps[k]), simulator, self.state))
                continue
            member, tips = _perturbed(self, parameters, k, ahead)
            members.append(member)
            curves[k] = np.interp(self.grid, depth, (tips[:, 1] - base[:, 1]) / self.prior.steps[k])
        return replace(self, curves=curves, perturbed=tuple(members), period=self.period + 1)

    @property
    def reading_variance(self) -> float:
        """Variance of the mean of the readings of a control step (mm²)."""
        scenario = self.nominal.scenario
        step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
        count = max(1.0, step / scenario.tracker.period)
        return float(scenario.tracker.jitter_per_axis**2 / count + unexplained(scenario, self.settings) ** 2)

    def _due(self) -> Iterator[int]:
        """The parameters whose curves are simulated this period."""
        for place, k in enumerate(_LEADING):
            if place % _LEADING_ROUND == self.period % _LEADING_ROUND:
                yield k
        for k in range(MODULUS, self.parameters.size):
            if k % _ROUND == self.period % _ROUND:
                yield k


def _adapted(nominal: Simulator, settings: Priors, parameters: Floats) -> Simulator:
    """The model with these parameters."""
    layers = len(nominal.scenario.tissue)
    shift = MODULUS + layers
    variation = shift + layers - 1
    return nominal.adapted(
        Adaptation(
            shift=parameters[shift:variation],
            stiffness=np.exp(parameters[MODULUS:shift]),
            cell=settings.cell_mm,
            variation=np.exp(parameters[variation:]),
            bevel=float(parameters[BEVEL]),
            bend=float(parameters[BEND]),
            clearance=float(parameters[CLEARANCE]),
        )
    )


def _started(estimate: Identified, simulator: Simulator, parameters: Floats) -> State:
    """The state of the start, settled with these parameters."""
    start = estimate.nominal.start(estimate.stops[0][1].bevel)
    moved = start.with_estimate(
        base_x=float(start.base[0]) + estimate.axial,
        base_y=float(parameters[BASE_Y]),
        base_turn=float(parameters[BASE_TURN]),
    )
    return simulator.replay(moved, _REST)[0]


def improved(estimate: Identified, readings: MoveMeans) -> Identified:
    """One Gauss–Newton step to the maximum a posteriori within the bounds, shortened until the cost does not rise."""
    prior = estimate.prior
    jacobian = jacobian_of(estimate, readings)
    variance = estimate.variance(readings) + readings.bent(estimate.tips[:, 1]) ** 2
    weighted = jacobian.T / variance
    gradient = weighted @ estimate.left(readings) - prior.precision @ (estimate.parameters - prior.mean)
    precision = weighted @ jacobian + prior.precision
    estimate = replace(estimate, precision=precision)
    step = np.linalg.solve(precision, gradient)
    if not np.isfinite(step).all():
        return estimate._with(estimate.parameters)
    goal = np.clip(estimate.parameters + step, *prior.bounds)

    def cost(other: Identified) -> float:
        return float(0.5 * (other.left(readings) ** 2 / variance).sum()) + prior.cost(other.parameters)

    most, fitted = cost(estimate), estimate
    for share in _SHARES:
        fitted = estimate._with(estimate.parameters + share * (goal - estimate.parameters))
        if fitted.state.converged and cost(fitted) <= most:
            break
    return fitted


def jacobian_of(estimate: Identified, readings: MoveMeans) -> Floats:
    """Derivative (r, K) of the predicted readings, from the curves."""
    jacobian = estimate._slopes(readings.between(estimate.tips[:, 0]))
    jacobian[:, RUN_OUT] = readings.sides
    return jacobian


def _perturbed(estimate: Identified, parameters: Floats, k: int, ahead: Floats) -> tuple[Perturbed, Floats]:
    """The needle with another value of parameter k, and its tips (m + 1 + a, 3), the a steps `ahead` included.

    Moves before the parameter has an effect are not simulated again.
    """
    simulator, begins = (
        _adapted(estimate.nominal, estimate.settings, parameters),
        float(estimate.prior.begins[k]),
    )
    reached = int(np.argmax(np.append(estimate.tips[:, 0], np.inf) > begins))  # by the move before this one
    first, state = max(
        (stop for stop in estimate.stops if stop[0] < max(1, reached)), key=lambda stop: stop[0]
    )
    if first == 0:
        state = _started(estimate, simulator, parameters)
    before = np.concatenate([estimate.tips[:first], state.tip[None]])
    now, tips = simulator.replay(state, estimate.rows[first:])
    later = simulator.replay(now, ahead)[1]
    member = Perturbed(k, float(estimate.prior.steps[k]), simulator, now)
    return member, np.concatenate([before, tips, later])


def low_passed(settings: Priors, left: Floats) -> float:
    """Low-pass of the residuals (r,) of the last moves, later ones with more weight."""
    level, gain = 0.0, settings.residual_gain
    for value in left[-_RECENT:].tolist():
        level += gain * (value - level)
    return level
