"""The insertion simulated with fitted parameters, and its readings."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.along import Bins, SensorFit, Timeline, between
from flexneedle.estimation.axial import scale_advance
from flexneedle.estimation.lateral import components, from_components
from flexneedle.estimation.move_means import MoveMeans
from flexneedle.estimation.moves import Move
from flexneedle.estimation.prior import Prior, Priors, Slots
from flexneedle.estimation.sensors import Sensor, sensors_of
from flexneedle.mechanics.model import Adaptation, Model, adapt, adapt_needle
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, ROLL, STILL, THETA, Floats, Laterals, X, Y, Z, laterals

_REST = np.array([STILL])
# An offset that turns with the bevel: error of its mean in a roll, whose motor starts and stops, relative to it.
_UNEVEN = 0.2


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The present needle with one parameter larger by `step`: its model and state."""

    parameter: int
    step: float
    model: Model
    state: State


LASTING = 10
"""Moves over which the model's error lasts."""
ANGLES = 3
"""Angles of the needle in air whose derivatives are kept, besides the last."""
TRACKER = "tracker"
"""Name of the tracker among the sensors."""


class Simulated(NamedTuple):
    """Insertions with P sets of parameters: their models, their states now, and tip poses (P, m + 1, 5)."""

    models: list[Model]
    states: list[State]
    tips: Floats
    shapes: Floats  # poses (P, m + 1, n, 5) of the nodes, of size 0 without sensors along the needle


@dataclass(frozen=True, eq=False)
class FittedInsertion:
    """An insertion that is simulated with fitted parameters, its readings, and its derivatives to the parameters."""

    nominal: Simulator  # the scenario's model, to which the prior refers
    settings: Priors
    prior: Prior
    simulator: Simulator  # the model with the parameters
    parameters: Floats  # posterior means (K,)
    state: State
    tips: Floats  # tip poses (m + 1, 5) at the ends of the m moves, the start first
    start: State  # the scenario's, before the first move
    grid: Floats  # depths of the tip (g,), mm
    curves: Laterals  # derivatives (S, K, g) of the sensors' quantities over the depths, the lateral position first
    precision: Floats  # inverse covariance (K, K) of the parameters
    axial: float = 0.0  # start error along the axis (mm), of the needle at rest in tissue
    axial_scale: float = 1.0  # advance of the needle over the commanded advance
    play: float = 0.0  # spring-back along the axis at rest in tissue (mm)
    period: int = 0
    # the present needle with one parameter changed, for some parameters
    perturbed: tuple[Perturbed, ...] = ()
    moves: tuple[Move, ...] = ()
    slots: Slots = field(kw_only=True)  # places of the parameters
    along: tuple[SensorFit, ...] = ()  # sensors along the needle
    quantities: tuple[Floats, ...] = ()  # their values (m + 1, d, 1 + p) at the ends of the moves
    along_curves: tuple[Floats, ...] = ()  # derivatives (K, g, d) of their values over the depths
    # standard deviations (mm) of the tracker's error that is correlated along the path, each from a time (s) on
    fields: tuple[tuple[float, float], ...] = ()

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return self.nominal.scenario.setup.axes

    @cached_property
    def rows(self) -> Floats:
        """The commands of the moves (m, 9)."""
        return np.array([done.motion.control for done in self.moves], dtype=float).reshape(-1, len(STILL))

    @cached_property
    def moves_on(self) -> NDArray[np.bool_]:
        """Moves (m,) that advance or end in air: their readings are ahead of a needle at rest by the play."""
        moves_on: NDArray[np.bool_] = (self.rows[:, DB_X] > 0.0) | (self.tips[1:, X] <= 0.0)
        return moves_on

    @cached_property
    def lead(self) -> Floats:
        """Axial distance (m,), mm, in each move from the model's tip, which is at rest, to the measured one."""
        lead: Floats = np.where(self.moves_on, self.play, 0.0)
        return lead

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors in use, the tip's position first."""
        return sensors_of(self.nominal.scenario)

    @cached_property
    def readings(self) -> tuple[MoveMeans, ...]:
        """Means of each sensor's readings."""
        return tuple(MoveMeans.of(self.moves, one.name, self.state.bevel, self.axes) for one in self.sensors)

    def variances(self) -> list[Floats]:
        """Return variances (r,) of the means of each sensor's readings: jitter, model error, angle error in a roll."""
        scenario, sd = self.nominal.scenario, 1.0 / np.sqrt(np.diag(self.prior.precision))
        return [
            readings.variance(sensor.sd(scenario) or 0.0, sensor.unexplained(scenario, self.settings))
            + np.where(readings.turns, (_UNEVEN * sd[getattr(self.slots, sensor.offset).start]) ** 2, 0.0)
            for sensor, readings in zip(self.sensors, self.readings, strict=True)
        ]

    @cached_property
    def laterals(self) -> list[Laterals]:
        """Lateral quantity (m + 1,) of the tips for each sensor; the first is their position (mm)."""
        return [laterals(self.tips, sensor.column, self.axes) for sensor in self.sensors]

    @cached_property
    def residuals(self) -> list[Laterals]:
        """Lateral residuals (r,) of each sensor: readings minus the model's quantities.

        A tip in motion is ahead on its path, which bends little over the play.
        """
        residuals = [
            readings.compute_residuals(
                tips, from_components(self.parameters[getattr(self.slots, sensor.offset)])
            )
            for sensor, readings, tips in zip(self.sensors, self.readings, self.laterals, strict=True)
        ]
        position = self.readings[0]
        residuals[0] -= self.lead[position.index] * position.between(self.slope)
        if self.slots.bias.stop:
            residuals[0] -= from_components(self.parameters[self.slots.bias])
        return residuals

    @property
    def field_sd(self) -> float:
        """Present standard deviation (mm) of the tracker's error that is correlated along the path."""
        return self.fields[-1][1] if self.fields else 0.0

    @property
    def has_field(self) -> bool:
        """True if the tracker has, or had, an error that is correlated along the path."""
        return any(sd for _, sd in self.fields)

    @cached_property
    def timeline(self) -> Timeline:
        """Times of the moves, and the needle's angle."""
        return Timeline.of(self.moves, self.start.roll)

    @cached_property
    def bins(self) -> list[Bins]:
        """Means of the readings of each sensor along the needle."""
        return [one.bins(self.timeline, one.clock(self.parameters)) for one in self.along]

    @cached_property
    def along_residuals(self) -> list[Floats]:
        """Residuals (b, d) of the sensors along the needle: means minus the model's values."""
        parts = zip(self.along, self.bins, self.quantities, strict=True)
        return [
            bins.value - one.expected(bins, ends, self.depths(bins), self.parameters)
            for one, bins, ends in parts
        ]

    @cached_property
    def along_jacobians(self) -> list[Floats]:
        """Derivatives (b, d, K) of the values of the sensors along the needle to the parameters."""
        parts = enumerate(zip(self.along, self.bins, self.quantities, strict=True))
        return [
            one.jacobian(
                bins,
                ends,
                self.depths(bins),
                self.along_slopes(between(bins, self.places(self.tips[:, X])[:, None])[:, 0], k),
                self.parameters,
                self.timeline,
            )
            for k, (one, bins, ends) in parts
        ]

    def places(self, depth: Floats) -> Floats:
        """Return the places (n,), mm, on the grid of the curves of needles at depths (n,): after the first moves.

        These are the depths. But where the error of the tracker or sensors along the needle are fitted, turns at rest
        before the first advance give other derivatives at the same depth: the angles before the last one have places at
        the beginning of the grid.
        """
        if not (self.along or self.slots.bias.stop):
            return depth
        still = np.logical_and.accumulate(self.rows[:, DB_X] == 0.0)
        turned = np.append(0, np.cumsum(self.rows[still, ROLL:].any(axis=1)))
        before = np.flatnonzero(turned < turned[-1])
        places = depth.copy()
        places[before] = self.grid[np.maximum(1, ANGLES + turned[before] - turned[-1] + 1)]
        return places

    def depths(self, bins: Bins) -> Floats:
        """Return the depths (b,), mm, of the tip at means of readings."""
        return between(bins, self.tips[:, X, None])[:, 0]

    def along_slopes(self, depth: Floats, sensor: int) -> Floats:
        """Return derivatives (b, K, d) of the quantities of a sensor along the needle at places (b,), mm."""
        left, part = self._nodes(depth)
        curves = self.along_curves[sensor]
        slopes = (1.0 - part)[:, None] * curves[:, left] + part[:, None] * curves[:, left + 1]
        return slopes.transpose(1, 0, 2)

    def _nodes(self, depth: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return the points of the grid before places (n,), mm, and the shares of the steps to the next."""
        step = self.grid[1] - self.grid[0]
        place = np.clip((depth - self.grid[0]) / step, 0.0, self.grid.size - 1.001)
        left = place.astype(int)
        return left, place - left

    @cached_property
    def slope(self) -> Laterals:
        """Slopes (m + 1,) of the tips."""
        return laterals(self.tips, THETA, self.axes)

    def slopes(self, depth: Floats, sensor: int = 0) -> Laterals:
        """Return derivatives (n, K) of a sensor's quantity at places (n,), mm, from the curves; 0 for its offset."""
        left, part = self._nodes(depth)
        curves = self.curves[sensor]
        slopes: Laterals = ((1.0 - part) * curves[:, left] + part * curves[:, left + 1]).T
        return slopes

    @cached_property
    def covariance(self) -> Floats:
        """Posterior covariance (K, K) of the parameters."""
        inverse: Floats = np.linalg.inv(self.precision).astype(np.float64)
        return inverse

    def change(self, **changes: Any) -> Self:
        """Return the insertion with changes; properties of what has not changed are kept."""
        fields = {name: vars(self)[name] for name in self.__dataclass_fields__}
        made, kept = type(self)(**{**fields, **changes}), ["sensors"]
        if made.precision is self.precision:
            kept.append("covariance")
        if made.moves is self.moves:
            kept += ["rows", "timeline"] + ["readings"] * (made.state.bevel == self.state.bevel)
            if made.along is self.along and all(one.slots.clock is None for one in self.along):
                kept.append("bins")
        vars(made).update({name: vars(self)[name] for name in kept if name in vars(self)})
        return made

    def simulate_with(self, parameters: Floats) -> Self:
        """Return the insertion simulated again with these parameters (K,)."""
        return next(self.simulate_each([parameters]))

    def simulate_each(self, parameters: Sequence[Floats]) -> Iterator[Self]:
        """Yield the insertion simulated again with each set of parameters, (K,) each, all at once."""
        simulated = self.simulate_all(parameters)
        return (self.take(each, simulated, k) for k, each in enumerate(parameters))

    def take(self, parameters: Floats, simulated: Simulated, number: int = 0) -> Self:
        """Return the insertion with parameters (K,) and the needle that was simulated with them."""
        models, states, tips, shapes = simulated
        simulator = self.nominal.with_model(models[number])
        return self.change(
            simulator=simulator,
            parameters=parameters,
            state=states[number],
            tips=tips[number],
            quantities=self.quantities_of(shapes[number]) if self.along else (),
        )

    def quantities_of(self, shapes: Floats) -> tuple[Floats, ...]:
        """Return the values (…, d, 1 + p) of each sensor along the needle on shapes (…, n, 5)."""
        length = self.nominal.scenario.needle.length_mm
        return tuple(one.quantities(shapes, length) for one in self.along)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Outputs of the rollouts."""
        return ("shapes",) if self.along else ()

    def simulate_all(self, parameters: Sequence[Floats]) -> Simulated:
        """Return the insertion simulated again with each set of parameters, (K,) each."""
        models = adapt_models(self.nominal, self.slots, self.settings.cell_mm, parameters)
        scaled, extra = scale_advance(self.rows, self.axial_scale)
        rows = np.concatenate([_REST, scaled])  # at rest the start is settled in its model
        clamps = [each[: self.slots.slope.stop].tobytes() for each in parameters]
        starts = dict(zip(clamps, parameters, strict=True))
        placed = {clamp: self._place_start(each) for clamp, each in starts.items()}
        found = self.nominal.rollout(
            [placed[clamp] for clamp in clamps],
            np.tile(rows, (len(models), 1, 1)),
            models=models,
            limits=False,
            ends=True,
            outputs=self.wanted,
        )
        states = [state.discount_advance(extra) for state in found.ends]
        return Simulated(models, states, found.tips, found.shapes)

    def _place_start(self, parameters: Floats) -> State:
        """Return the start with these parameters (K,), not settled."""
        base, slope = components(parameters[self.slots.base]), components(parameters[self.slots.slope])
        pose = self.start.base
        return self.start.with_estimate(
            base_x=float(pose[X]) + self.axial,
            base=(pose[Y : Z + 1] + base).tolist(),
            slope=(pose[THETA:] + slope).tolist(),
        )


Fitted = TypeVar("Fitted", bound=FittedInsertion)


def adapt_models(nominal: Simulator, slots: Slots, cell: float, parameters: Sequence[Floats]) -> list[Model]:
    """Return the models with sets of parameters, (K,) each; nominal: the scenario's model, to which they refer.

    Those with the same tissue share it. cell: length (mm) of the cells of the modulus.
    """
    layers = len(nominal.scenario.tissue)
    shift = slots.modulus + layers
    variation = shift + layers - 1
    tissues: dict[bytes, Model] = {}
    models = []
    for each in parameters:
        key = each[slots.modulus : slots.end].tobytes()
        if key not in tissues:
            tissue = Adaptation(
                shift=each[shift:variation],
                stiffness=np.exp(each[slots.modulus : shift]),
                cell=cell,
                variation=np.exp(each[variation : slots.end]),
            )
            tissues[key] = adapt(nominal.model, tissue)
        needle = float(each[slots.bevel]), from_components(each[slots.bend]), float(each[slots.clearance])
        models.append(adapt_needle(tissues[key], *needle))
    return models
