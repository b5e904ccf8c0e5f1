"""Fit of the sensors' errors, and of the needle's start, to a run in air.

Least squares with normal priors over single readings: tracker and sensors are compared with the model's needle, which
is simulated with the motions as they were carried out. The priors of the sensors' errors are wide; a quantity whose
standard deviation stays near its prior is not found. Times are relative to the tracker's; without one, to the motors'.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flexneedle.estimation.along import SensorFit, SensorPriors, Timeline
from flexneedle.estimation.lateral import components, from_components
from flexneedle.estimation.prior import LEAST_SD, Priors
from flexneedle.lab.rig.sensor_check.air_run import AirRun
from flexneedle.mechanics.model import adapt_needle
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import Sensor, read_values
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL, Flags, Floats, Needles, X, Y, Z

GAIN_SD = 0.3
"""Prior standard deviation of gain errors."""
TURN_SD = 1.0
"""Prior standard deviation of turns (rad)."""
CLOCK_SD = 0.2
"""Prior standard deviation of errors of time stamps (s)."""
OFFSET_SDS = 10.0
"""Prior standard deviation of offsets, over the scenario's and over the noise."""
_LAG_SD = 0.1  # of the tracker's time stamps (s)
_BIAS_MM = 1.0  # of the tracker
_STEPS = {"base": 0.05, "slope": 3e-4, "bend": 0.05, "clearance": 0.01, "axial": 0.1}
"""Steps of differences, mm and rad."""
_FARTHEST_S, _GRID_S = 0.4, 0.005  # clock errors at which a fit may begin
_OUTLIER = 5.0  # standard deviations
_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation


class NeedleSlots:
    """Places of the parameters of needle and tracker."""

    def __init__(self, axes: int) -> None:
        self.base, self.slope, self.bend, self.run_out = (slice(k * axes, (k + 1) * axes) for k in range(4))
        self.clearance = 4 * axes
        self.axial = self.clearance + 1
        self.bias = slice(self.axial + 1, self.axial + 2 + axes)
        self.lag = self.bias.stop
        self.end = self.lag + 1
        self.simulated = [*range(self.run_out.start), self.clearance, self.axial]


@dataclass(frozen=True, eq=False)
class AirModel:
    """Readings of a run, and their predictions by parameters (K,)."""

    simulator: Simulator
    run: AirRun
    line: Timeline
    slots: NeedleSlots
    sensors: tuple[SensorFit, ...]
    mean: Floats  # of the prior (K,)
    sd: Floats  # of the prior (K,)
    tip_time: Floats  # (r,), s
    tip: Floats  # measured x, y, z (r, 1 + a), mm

    @staticmethod
    def of(scenario: Scenario, run: AirRun) -> "AirModel":
        """Return the model of a run."""
        simulator, axes, slots = Simulator(scenario), scenario.setup.axes, NeedleSlots(scenario.setup.axes)
        control, priors = scenario.control, Priors()
        guided, tracked = scenario.setup.has_guide, bool(run.measurements)
        known = scenario.setup.guide_clearance_mm
        clearance = (priors.clearance_mm if known is None else known) if guided else 0.0
        start = control.start_offset_sd_mm, control.start_angle_sd
        sds = [
            *np.repeat([*start, priors.bend_sd_mm, priors.run_out_sd_mm], axes),
            *(priors.clearance_sd_mm * guided, control.start_axial_sd_mm),
            *(*[_BIAS_MM] * (1 + axes), _LAG_SD * tracked),
        ]
        sensors = []
        for sensor in scenario.sensor:
            found, more = SensorFit.begin(sensor, axes, len(sds), wide_priors(sensor), np.zeros(0))
            sensors.append(found)
            sds += more
        line = Timeline.of(run.moves, 0.0)
        tips = np.array([(one.time, one.x, one.y, one.z or 0.0) for one in run.measurements]).reshape(-1, 4)
        tips = tips[~rolling(line, tips[:, 0])]
        mean = np.zeros(len(sds))
        mean[slots.clearance] = clearance
        sd, tip = np.maximum(sds, LEAST_SD), tips[:, 1 : 2 + axes]
        model = AirModel(simulator, run, line, slots, tuple(sensors), mean, sd, tips[:, 0], tip)
        shapes = model.simulate([mean])[1][0]
        return replace(model, sensors=tuple(model._with_readings(one, shapes) for one in sensors))

    def _with_readings(self, one: SensorFit, shapes: Floats) -> SensorFit:
        """Return a sensor with its readings; shapes (m + 1, n, 5): needle to which points are shifted."""
        given = self.run.readings[one.name]
        time = np.array([each.time for each in given])
        index, *_ = self.line.at(time)
        spacing = self.length / (shapes.shape[1] - 1)
        needles = (Needles(shapes[k + 1][None], spacing) for k in index)
        pairs = zip(given, needles, strict=True)
        values = [read_values(one.sensor, each, needle, one.axes) for each, needle in pairs]
        value = np.array(values).reshape(-1, one.value.shape[1])
        if one.sensor.rolls and one.axes == 1:  # between half turns it leaves the plane
            value[rolling(self.line, time)] = np.nan
        return one.add(time, value)

    @property
    def length(self) -> float:
        """Length of the needle (mm)."""
        return self.simulator.scenario.needle.length_mm

    def simulate(self, parameters: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return tips (P, m + 1, 5) and shapes (P, m + 1, n, 5) at the ends of the moves, with parameters (K,) each."""
        slots, start, model = self.slots, self.simulator.start(), self.simulator.model
        pose = start.base
        states, models = [], []
        for each in parameters:
            base = (pose[Y : Z + 1] + components(each[slots.base])).tolist()
            slope = (pose[3:] + components(each[slots.slope])).tolist()
            base_x = float(pose[X] + each[slots.axial])
            states.append(start.with_estimate(base_x=base_x, base=base, slope=slope))
            clearance = float(each[slots.clearance]) if self.simulator.scenario.setup.has_guide else None
            models.append(adapt_needle(model, 1.0, from_components(each[slots.bend]), clearance))
        rows = np.array([STILL, *(done.motion.control for done in self.run.moves)])
        found = self.simulator.rollout(
            states, np.tile(rows, (len(states), 1, 1)), models=models, limits=False, outputs=("shapes",)
        )
        return found.tips, found.shapes

    def predict(
        self, parameters: Floats, tips: Floats, ends: Sequence[Floats]
    ) -> tuple[Floats, list[Floats]]:
        """Return readings of tracker (r, 1 + a) and sensors (r, d), from tips and quantities at the ends of moves."""
        slots, lag = self.slots, parameters[self.slots.lag]
        index, part, angle = self.line.at(self.tip_time - lag)
        axes = self.sensors[0].axes
        tip = ((1.0 - part)[:, None] * tips[index] + part[:, None] * tips[index + 1])[:, : 1 + axes]
        off = from_components(parameters[slots.run_out]) * np.exp(1j * angle)
        tip = tip + parameters[slots.bias] + np.stack([0.0 * part, off.real, off.imag], axis=1)[:, : 1 + axes]
        parts = zip(self.sensors, ends, strict=True)
        return tip, [one.predict_at(one.time - lag, each, 0.0, self.line, parameters) for one, each in parts]

    def quantities(self, shapes: Floats) -> list[Floats]:
        """Return the values (…, d, 1 + p) of each sensor on shapes (…, n, 5)."""
        return [one.quantities(shapes, self.length) for one in self.sensors]


def wide_priors(sensor: Sensor) -> SensorPriors:
    """Return wide priors of the errors of a sensor."""
    return SensorPriors(OFFSET_SDS * max(sensor.offset_sd, sensor.noise), GAIN_SD, TURN_SD, CLOCK_SD)


def rolling(line: Timeline, times: Floats) -> Flags:
    """Return which times (r,) are within a roll."""
    index, part, _ = line.at(times)
    inside: Flags = (line.turned[index] != 0.0) & (part > 0.0) & (part < 1.0)
    return inside


@dataclass(frozen=True, eq=False)
class AirFit:
    """Posterior of a run in air."""

    model: AirModel
    parameters: Floats  # (K,)
    covariance: Floats  # (K, K)
    predicted: list[Floats]  # by sensor (r, d)
    used: list[Flags]  # by sensor (r, d)
    noise: list[float]  # of each sensor, as seen
    profile_sds: list[float]  # of the clock error of each sensor, with all minima of the cost (s)

    def mean(self, places: slice | int) -> tuple[float, float]:
        """Return the weighted mean of parameters, and its standard deviation."""
        within = places if isinstance(places, slice) else slice(places, places + 1)
        weights = np.linalg.inv(self.covariance[within, within]).sum(axis=0)
        return float(weights @ self.parameters[within] / weights.sum()), float(weights.sum() ** -0.5)

    def clock(self, number: int) -> tuple[float, float]:
        """Return the clock error (s) of a sensor, and its standard deviation, with all minima of the cost."""
        value, sd = self.mean(self.model.sensors[number].slots.clock or 0)
        return value, max(sd, self.profile_sds[number] - _GRID_S)

    def offset(self, number: int) -> list[tuple[float, float]]:
        """Return the offsets of a sensor, and their standard deviations, with the error of the model."""
        one = self.model.sensors[number]
        places = range(one.slots.offset.start, one.slots.offset.stop)
        means, errors = map(self.mean, places), one.sensor.model_error(self.predicted[number])
        unexplained = errors.reshape(-1, len(places)).mean(axis=0)
        return [(value, math.hypot(sd, more)) for (value, sd), more in zip(means, unexplained, strict=True)]

    def predict_without_errors(self) -> list[Floats]:
        """Return the predicted readings (r, d) of error-free sensors on the fitted needle."""
        model, parameters = self.model, self.parameters.copy()
        parameters[model.slots.end :] = 0.0
        tips, shapes = model.simulate([parameters])
        return model.predict(parameters, tips[0], model.quantities(shapes[0]))[1]


def fit_in_air(scenario: Scenario, run: AirRun) -> AirFit:
    """Return the fit of a run: first with the scenario's noise, then with the noise as seen and without outliers."""
    model = AirModel.of(scenario, run)
    ends = model.quantities(model.simulate([model.mean])[1][0])
    starts = [_find_start(model, one, each) for one, each in zip(model.sensors, ends, strict=True)]
    start = model.mean.copy()
    for one, (clock, turn, _) in zip(model.sensors, starts, strict=True):
        start[one.slots.clock] = clock
        if one.slots.turn is not None:
            start[one.slots.turn] = turn
    seen = [np.isfinite(one.value) for one in model.sensors]
    first, _, predicted = _fit(model, start, seen, [one.sensor.noise for one in model.sensors])
    residuals = [one.value - each for one, each in zip(model.sensors, predicted, strict=True)]
    noise = [_scatter(left) or one.sensor.noise for left, one in zip(residuals, model.sensors, strict=True)]
    used = [np.abs(left) < _OUTLIER * sd for left, sd in zip(residuals, noise, strict=True)]
    moves = [model.line.at(one.time)[0] for one in model.sensors]
    each = zip(noise, residuals, used, moves, strict=True)
    scaled = [sd * _excess(left / sd, use, move) for sd, left, use, move in each]
    return AirFit(model, *_fit(model, first, used, scaled), used, noise, [sd for _, _, sd in starts])


def _scatter(left: Floats) -> float:
    """Return the standard deviation of residuals without regard to outliers; 0 without any."""
    known = left[np.isfinite(left)]
    return _MAD * float(np.median(np.abs(known))) if known.size else 0.0


def _excess(left: Floats, used: Flags, move: NDArray[np.intp]) -> float:
    """Return the scatter of mean residuals of moves (noise: 1) relative to white noise, at least 1.

    The error of the model is alike within a move, and no mean over its readings makes it smaller.
    """
    sums, counts = (np.zeros((move.max(initial=0) + 1, left.shape[1])) for _ in range(2))
    np.add.at(sums, move, np.where(used, left, 0.0))
    np.add.at(counts, move, used)
    squares = sums[counts > 0.0] ** 2 / counts[counts > 0.0]
    return max(1.0, float(np.sqrt(squares.mean()))) if squares.size else 1.0


def _find_start(model: AirModel, one: SensorFit, ends: Floats) -> tuple[float, float, float]:
    """Return the best clock error (s) and turn (rad) of a sensor, and the clock error's sd with all minima of the cost.

    Each clock error on a grid has the best other errors; ends: the sensor's quantities at the ends of the moves, for
    the prior's needle.
    """
    seen = np.isfinite(one.value).any(axis=1)
    if not seen.any():
        return 0.0, 0.0, CLOCK_SD
    known = replace(one, time=one.time[seen], value=one.value[seen])
    grid = np.linspace(-_FARTHEST_S, _FARTHEST_S, 2 * round(_FARTHEST_S / _GRID_S) + 1)
    costs, turns = np.transpose([_regress(model, known, ends, clock) for clock in grid])
    density = np.exp(-0.5 * ((costs - costs.min()) / one.sensor.noise**2 + (grid / CLOCK_SD) ** 2))
    density /= density.sum()
    best = int(np.argmin(costs))
    return float(grid[best]), float(turns[best]), math.sqrt(density @ (grid - density @ grid) ** 2)


def _regress(model: AirModel, one: SensorFit, ends: Floats, clock: float) -> tuple[float, float]:
    """Return cost and turn of a regression of readings on their predictions with a clock error (s)."""
    trial = model.mean.copy()
    trial[one.slots.clock or 0] = clock
    pairs = one.slots.turn is not None
    predicted, value = one.predict_at(one.time, ends, 0.0, model.line, trial), one.value
    if pairs:
        predicted, value = (each[:, ::2] + 1j * each[:, 1::2] for each in (predicted, value))
    known = np.isfinite(value)
    count = np.maximum(known.sum(axis=0), 1)
    means = (np.where(known, each, 0.0).sum(axis=0) / count for each in (predicted, value))
    x, y = (np.where(known, each - mean, 0.0) for each, mean in zip((predicted, value), means, strict=True))
    power, common = (np.abs(x) ** 2).sum(axis=0), (x.conj() * y).sum(axis=0)
    gain = common / (power + (one.sensor.noise / GAIN_SD) ** 2)
    left = y - gain * x
    return float((np.abs(left) ** 2).sum()), float(np.angle(common.sum())) if pairs else 0.0


def _fit(
    model: AirModel, start: Floats, used: list[Flags], noise: Sequence[float]
) -> tuple[Floats, Floats, list[Floats]]:
    """Return parameters, their covariance, and predicted readings of a fit to the values of sensors that are used."""
    jitter = model.simulator.scenario.tracker.jitter_per_axis

    def rows(tip: Floats, predicted: Sequence[Floats]) -> Floats:
        parts = [tip.ravel() / jitter if jitter else tip.ravel()]
        parts += [each[use] / sd for each, use, sd in zip(predicted, used, noise, strict=True)]
        return np.concatenate(parts)

    measured = rows(model.tip, [one.value for one in model.sensors])
    unit = np.diag(1.0 / model.sd)

    def predict(parameters: Floats) -> tuple[Floats, list[Floats]]:
        tips, shapes = model.simulate([parameters])
        return model.predict(parameters, tips[0], model.quantities(shapes[0]))

    def residuals(parameters: Floats) -> Floats:
        return np.append(rows(*predict(parameters)) - measured, (parameters - model.mean) / model.sd)

    def jacobian(parameters: Floats) -> Floats:
        steps = _difference_steps(model)
        larger = parameters + np.diag(steps)
        tips, shapes = model.simulate([parameters, *larger[model.slots.simulated]])
        ends = model.quantities(shapes)
        base = rows(*model.predict(parameters, tips[0], [each[0] for each in ends]))
        number = {place: k + 1 for k, place in enumerate(model.slots.simulated)}
        columns = []
        for place, step in enumerate(steps):
            k = number.get(place, 0)
            moved = model.predict(larger[place], tips[k], [each[k] for each in ends])
            columns.append((rows(*moved) - base) / step)
        return np.concatenate([np.stack(columns, axis=1), unit])

    found = least_squares(residuals, start, jac=jacobian, method="lm", x_scale=model.sd, xtol=1e-6, ftol=1e-6)
    return found.x, np.linalg.inv(found.jac.T @ found.jac), predict(found.x)[1]


def _difference_steps(model: AirModel) -> Floats:
    """Return steps (K,) for differences: 0.01 prior standard deviations, and of the simulated parameters fixed ones."""
    steps, slots = 0.01 * model.sd, model.slots
    for name, step in _STEPS.items():
        steps[getattr(slots, name)] = step
    return steps
