"""Observer that corrects the model: parameters of start, needle and tissue are fitted to all readings.

Maximum a posteriori by Gauss–Newton, one step a period: the insertion is simulated again with other parameters, which
takes a millisecond, and compared with the lateral readings. Parameters, with normal priors from the scenario:

    base y (mm), base θ (rad), natural bend of the needle (mm), run-out (mm), factor on the bevel offset,
    clearance of the needle in the guide (mm),
    ln of the factor on each layer's modulus, shift (mm) of each boundary between layers,
    ln of a further factor on the modulus in cells along the depth, correlated over a length.

So tissue ahead of the tip is estimated as far as it is correlated with the tissue behind it. Start, scale and play of
the advance along the axis are fitted separately, to the axial readings. The residuals of the lateral fit are low-passed
and added as a constant.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from flexneedle.estimation.along import DOUBT, Comparison, SensorFit, SensorPriors
from flexneedle.estimation.axial import (
    AS_COMMANDED,
    EvenAdvance,
    axial_errors_prior,
    fit_axial_error,
    fit_even_advance,
    replay_scaled,
    rest_variance,
)
from flexneedle.estimation.estimate import NONE, describe_estimate
from flexneedle.estimation.faults import Fault, find_faults
from flexneedle.estimation.fit import (
    ROUND,
    Whitening,
    differentiate,
    improve_fit,
    simulate_due,
)
from flexneedle.estimation.fitted import LASTING
from flexneedle.estimation.known import KnownInsertion
from flexneedle.estimation.lateral import components, from_components
from flexneedle.estimation.moves import Move, assign_readings, position_along
from flexneedle.estimation.prior import Prior, Priors, Slots, check_cells
from flexneedle.estimation.sensors import sensors_of
from flexneedle.estimation.task import Task
from flexneedle.scenario.sensors.sensor import read_values
from flexneedle.types import (
    DB_X,
    PSI,
    STILL,
    THETA,
    Floats,
    Laterals,
    Measurement,
    Motion,
    Needles,
    Point,
    Reading,
    X,
    Z,
)

_REFITS = 4  # steps of the fit after a sensor is excluded
_KNOTS = 3  # of a drift, down to the target
_RECENT = 12  # moves whose residuals are low-passed


@dataclass(frozen=True)
class Identification:
    """The observer of `adaptive-mpc`, whose settings it uses."""

    fuses = True

    def begin(self, task: Task) -> "Identified":
        """Return the estimate before the first reading, the prior's means. Raises ScenarioError for too short cells."""
        simulator, scenario, settings = task.simulator, task.scenario, task.settings
        check_cells(scenario, settings)
        state, prior = simulator.start(task.plan.roll), Prior.of(scenario, settings, task.plan.target[0])
        prior, slots, along = add_sensors(prior, task)
        step = scenario.setup.max_advance_mm
        begin = scenario.setup.start_tip_x - 5 * step
        # Room for angles of the needle in air, whatever the start along the axis.
        if along or slots.bias.stop:
            begin -= 4.0 * scenario.control.start_axial_sd_mm
        grid = np.arange(begin, scenario.setup.max_depth + (ROUND + 6) * step, step)
        length = scenario.needle.length_mm
        start = Identified(
            simulator,
            settings,
            prior,
            simulator,
            prior.mean,
            state,
            state.tip[None],
            state,
            grid,
            np.zeros(
                (len(sensors_of(scenario)), prior.mean.size, grid.size),
                dtype=float if scenario.setup.axes == 1 else complex,
            ),
            prior.precision,
            axial_covariance=axial_errors_prior(scenario),
            slots=slots,
            along=along,
            quantities=tuple(one.quantities(state.nodes[None], length) for one in along),
            along_curves=tuple(np.zeros((prior.mean.size, grid.size, one.size)) for one in along),
            fields=((0.0, scenario.tracker.field_sd_mm),),
        )
        return differentiate(start, simulate_due(start, prior.mean, range(prior.mean.size)))


@dataclass(frozen=True, eq=False)
class Identified(KnownInsertion):
    """An `Estimate` with fitted parameters."""

    axial_bias: float = 0.0  # constant error of the tracker along the axis (mm)
    even_advance: EvenAdvance = AS_COMMANDED
    residual: complex = 0.0  # low-passed residual (mm)
    innovation: Point = (0.0, 0.0, 0.0)  # the last reading minus its prediction (mm)
    # tip measured at the end of the last move with a reading (mm), None before the first
    measured: Point | None = None

    def __repr__(self) -> str:
        return describe_estimate(self)

    @property
    def tip(self) -> Floats:
        """Tip pose (5,) as measured: the model's, plus the tip's offset from the needle's axis."""
        tip, off = self.state.tip, self.off_axis(self.state.bevel)
        lead = self.lead[-1] if self.moves else 0.0
        tip[: Z + 1] += [lead, lead * tip[THETA] + off.real, lead * tip[PSI] + off.imag]
        return tip

    @property
    def run_out(self) -> complex:
        """Lateral offset (mm) of the measured tip from the needle's axis, relative to the bevel's direction."""
        return from_components(self.parameters[self.slots.run_out])

    def off_axis(self, bevel: complex) -> complex:
        """Return the lateral offset (mm) of the measured tip from the model's, with the bevel in this direction."""
        return self.run_out * bevel + self.residual

    def tip_at(self, time: float) -> Point:
        """Return the position of the tip (mm) that the tracker should measure at `time`."""
        x, y, z = position_along(self.moves, self.tips, time, self.lead)
        running = takewhile(lambda done: time < done.motion.ended, reversed(self.moves))
        left = sum(done.left_to_turn(time) for done in running)
        off = self.off_axis(self.state.bevel * cmath.exp(-1j * left))
        ahead, left, up = self.bias
        return x + ahead, y + off.real + left, z + (off.imag if self.axes > 1 else 0.0) + up

    def without_reading(self) -> "Identified":
        """Return the estimate of a period without a good reading: innovation 0."""
        return replace(self, innovation=(0.0, 0.0, 0.0))

    def move(self, motion: Motion) -> "Identified":
        """Move the estimated needle as the driver did."""
        rested = self.moves and self.moves[-1].applied == STILL
        if motion.control == STILL and rested:  # one move, however long
            return self.change(moves=(*self.moves[:-1], self.moves[-1].extend(motion.ended)), perturbed=())
        new = Move.parts_of(motion)
        rows = np.array([done.applied for done in new])
        state, tips, quantities = self.state, self.tips, self.quantities
        for part in rows[:, None] if self.along else rows[None]:  # one by one, with the shape after each
            state, more = replay_scaled(self.simulator, state, part, self.axial_scale)
            tips = np.concatenate([tips, more])
            if self.along:
                ends = self.quantities_of(state.nodes[None])
                quantities = tuple(np.concatenate(both) for both in zip(quantities, ends, strict=True))
        return self.change(
            state=state, tips=tips, moves=(*self.moves, *new), perturbed=(), quantities=quantities
        )

    def observe(
        self, measurements: Sequence[Measurement], along: Mapping[str, Sequence[Reading]] = NONE
    ) -> "Identified":
        """Fit the parameters to all readings by one Gauss–Newton step, and simulate the insertion with them.

        along: readings of sensors along the needle by name.
        """
        if not (measurements or any(along.values())) or not self.moves:
            return self.without_reading()
        extended = self.change(
            moves=assign_readings(self.moves, measurements) if measurements else self.moves,
            along=tuple(self._add(one, along.get(one.name, ())) for one in self.along),
        )._fit_axially()
        readings = extended.readings[0]
        fitted = improve_fit(extended)
        if not measurements or not len(readings.index):
            # Only sensors along the needle measured: the model's error at the tip is less and less known.
            return fitted.change(residual=math.exp(-1.0 / LASTING) * fitted.residual).without_reading()
        left, lead = fitted.residuals[0], fitted.lead
        ahead = readings.ahead(fitted.tips[:, X]) - lead[readings.index] - fitted.axial_bias
        newest = int(readings.index[-1]) + 1
        since = sum(done.applied.roll + done.applied.spin for done in fitted.moves[newest:])
        bevel = fitted.state.bevel * cmath.exp(-1j * since)
        x = float(fitted.tips[newest, X] + lead[newest - 1] + ahead[-1])
        y = fitted.laterals[0][newest] + lead[newest - 1] * fitted.slope[newest] + left[-1]
        y = complex(y + fitted.run_out * bevel)
        inside = fitted.tips[-1, X] > 0.0
        return fitted.change(
            residual=low_pass(self.settings, fitted.without_field(left)) if inside else 0.0,
            innovation=(float(ahead[-1]), float(left[-1].real), float(left[-1].imag)),
            measured=(x, y.real, y.imag if self.axes > 1 else 0.0),
        )

    def _fit_axially(self) -> "Identified":
        """Return the estimate with start error, scale and play along the axis fitted to all readings."""
        scenario, position, readings = self.nominal.scenario, self.sensors[0], self.readings[0]
        travel = readings.between(np.cumsum(np.append(0.0, self.rows[:, DB_X])))
        without = readings.ahead(self.tips[:, X]) + self.axial + (self.axial_scale - 1.0) * travel
        unexplained = position.unexplained(scenario, self.settings)
        moves_on = self.moves_on[readings.index]
        variance = readings.axial_variance(position.sd(scenario) or 0.0, unexplained)
        variance += np.where(moves_on, 0.0, rest_variance(readings.between(self.tips[:, X]), readings.turns))
        columns, prior = np.stack([np.ones_like(travel), travel, moves_on]), axial_errors_prior(scenario)
        if len(prior) > len(columns):
            columns = np.concatenate([columns, np.ones_like(travel)[None]])
        if self.has_field:
            field = Whitening.of(self, variance)
            without, columns = field.of_rows(without), field.of_rows(columns.T).T
            variance = np.ones_like(variance)
        found, covariance = fit_axial_error(without, columns, variance, prior)
        return self.change(
            axial=float(found[0]),
            axial_scale=1.0 + float(found[1]),
            play=float(found[2]),
            axial_bias=float(found[3]) if len(found) > 3 else 0.0,
            axial_covariance=covariance,
            even_advance=fit_even_advance(without, columns, variance, prior),
        )

    @property
    def bias(self) -> Point:
        """Constant error x, y, z (mm) of the tracker; 0 where it is not estimated."""
        y, z = components(self.parameters[self.slots.bias]) if self.slots.bias.stop else (0.0, 0.0)
        return self.axial_bias, y, z

    def with_field(self, sd: float, since: float) -> "Identified":
        """Return the estimate with another standard deviation (mm) of the field's error, from a time (s) on."""
        return self if sd == self.field_sd else self.change(fields=(*self.fields, (since, sd)))

    def without_field(self, left: Laterals) -> Laterals:
        """Return residuals (r,) of the tip's position without the known part of the field's error."""
        if not self.has_field:
            return left
        field = Whitening.of(self, self.variances()[0])
        lower = field.lower
        covariance = lower @ lower.T - np.diag(field.variance)
        without: Laterals = left - covariance @ np.linalg.solve(lower.T, np.linalg.solve(lower, left))
        return without

    def _add(self, one: SensorFit, readings: Sequence[Reading]) -> SensorFit:
        """Return a sensor along the needle with new readings."""
        return (
            one.add(np.array([each.time for each in readings]), self._values(one, readings))
            if readings
            else one
        )

    def _values(self, one: SensorFit, readings: Sequence[Reading]) -> Floats:
        """Return the values (r, d) of readings."""
        length = self.nominal.scenario.needle.length_mm
        needle = Needles(self.state.nodes[None], length / (len(self.state.nodes) - 1))
        return np.array([read_values(one.sensor, each, needle, self.axes) for each in readings])

    def without(self, name: str, since: float) -> "Identified":
        """Return the estimate fitted again without the readings of a sensor along the needle, from a time (s) on."""
        along = tuple(one.without(since) if one.name == name else one for one in self.along)
        fitted = self.change(along=along)
        for _ in range(_REFITS):
            fitted = improve_fit(fitted)
        if not len(fitted.readings[0].index):
            return fitted.change(residual=0.0)
        left = fitted.residuals[0]
        inside = fitted.tips[-1, X] > 0.0
        return fitted.change(residual=low_pass(self.settings, fitted.without_field(left)) if inside else 0.0)

    def faults(self) -> dict[str, Fault]:
        """Return the likeliest fault of each sensor by name, see `flexneedle.estimation.faults`."""
        return find_faults(self)

    def compare(self, name: str, readings: Sequence[Reading]) -> Comparison:
        """Return readings (r,) of a sensor along the needle beside their predictions."""
        k = next(k for k, one in enumerate(self.along) if one.name == name)
        one, values = self.along[k], self._values(self.along[k], readings)
        time, ends = np.array([each.time for each in readings]), self.quantities[k]
        predicted = one.predict_at(time, ends, float(self.state.tip[X]), self.timeline, self.parameters)
        bins = one.bin_at(time[-1:], self.timeline)
        depth = self.depths(bins)
        slopes = self.along_slopes(depth, k)
        jacobian = one.jacobian(bins, ends, depth, slopes, self.parameters, self.timeline)
        jacobian = one.in_its_axes(jacobian.transpose(2, 0, 1), bins)[:, 0].T
        known = (
            jacobian @ self.covariance @ jacobian.T
            + np.diag((DOUBT * one.sensor.model_error(predicted[-1:])[0]) ** 2)
            + one.sensor.wander_sd**2 * np.eye(len(jacobian))
        )
        return Comparison(values, values - predicted, known, one.sensor.noise)

    @property
    def lag(self) -> float:
        """Time (s) from the newest reading to the end of the last move."""
        newest = max([self._tracked_at, *(float(one.time[-1]) for one in self.along if len(one.time))])
        return self.moves[-1].motion.ended - newest if self.moves else 0.0

    @property
    def _tracked_at(self) -> float:
        """Time (s) of the newest reading of the tracker, 0 before the first."""
        times = (one.time for done in reversed(self.moves) for one in reversed(done.measurements))
        return next(times, 0.0)

    @property
    def tracked(self) -> bool:
        """True if the tracker measured the tip lately, so that it will again."""
        limit = self.nominal.scenario.control.hold_limit_s
        return not self.along or (
            bool(self.moves) and self.moves[-1].motion.ended - self._tracked_at <= limit
        )


def add_sensors(prior: Prior, task: Task) -> tuple[Prior, Slots, tuple[SensorFit, ...]]:
    """Return the prior with the errors of tracker and sensors, the places of all parameters, and the sensors."""
    scenario = task.scenario
    slots, axes = Slots.of(scenario), scenario.setup.axes
    own = prior.mean.size
    sds = [scenario.tracker.bias_sd_mm] * (axes if scenario.tracker.bias_sd_mm else 0)
    bias = slice(own, own + len(sds)) if sds else slots.bias
    along = []
    for sensor in scenario.sensor:
        knots = task.plan.target[0] / _KNOTS * np.arange(1.0, 1.0 + _KNOTS * (sensor.drift_sd > 0.0))
        one, more = SensorFit.begin(sensor, axes, own + len(sds), SensorPriors.of(sensor), knots)
        along.append(one)
        sds += more
    if not sds:
        return prior, slots, ()
    return prior.extend(sds), slots._replace(end=own, bias=bias), tuple(along)


def low_pass(settings: Priors, left: Laterals) -> complex:
    """Return the low-pass of the residuals (r,) of the last moves, later ones with more weight."""
    level, gain = 0.0, settings.residual_gain
    for value in left[-_RECENT:].tolist():
        level += gain * (value - level)
    return level
