"""The insertion simulated with fitted parameters, and its readings."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np

from flexneedle.estimation.axial import replay_scaled
from flexneedle.estimation.lateral import components, from_components
from flexneedle.estimation.move_means import MoveMeans
from flexneedle.estimation.moves import Move
from flexneedle.estimation.prior import Prior, Priors, Slots
from flexneedle.estimation.sensors import Sensor, sensors_of
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL, THETA, Floats, Laterals, X, Y, Z, laterals

_REST = np.array([STILL])
_MOVES_A_SEGMENT = 8  # in tissue; in air there is one segment
# An offset that turns with the bevel: error of its mean in a roll, whose motor starts and stops, relative to it.
_UNEVEN = 0.2


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The present needle with one parameter larger by `step`: its model and state."""

    parameter: int
    step: float
    simulator: Simulator
    state: State


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
    stops: tuple[tuple[int, State], ...]  # state before some of the moves
    grid: Floats  # depths of the tip (g,), mm
    curves: Laterals  # derivatives (S, K, g) of the sensors' quantities over the depths, the lateral position first
    precision: Floats  # inverse covariance (K, K) of the parameters
    axial: float = 0.0  # start error along the axis (mm)
    axial_scale: float = 1.0  # advance of the needle over the commanded advance
    period: int = 0
    # the present needle with one parameter changed, for some parameters
    perturbed: tuple[Perturbed, ...] = ()
    moves: tuple[Move, ...] = ()

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return self.nominal.scenario.setup.axes

    @cached_property
    def slots(self) -> Slots:
        """Places of the parameters."""
        return Slots.of(self.nominal.scenario)

    @cached_property
    def rows(self) -> Floats:
        """The commands of the moves (m, 9)."""
        return np.array([done.applied for done in self.moves], dtype=float).reshape(-1, len(STILL))

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

    @property
    def laterals(self) -> list[Laterals]:
        """Lateral quantity (m + 1,) of the tips for each sensor; the first is their position (mm)."""
        return [laterals(self.tips, sensor.column, self.axes) for sensor in self.sensors]

    @property
    def residuals(self) -> list[Laterals]:
        """Lateral residuals (r,) of each sensor: readings minus the model's quantities."""
        return [
            readings.compute_residuals(
                tips, from_components(self.parameters[getattr(self.slots, sensor.offset)])
            )
            for sensor, readings, tips in zip(self.sensors, self.readings, self.laterals, strict=True)
        ]

    def slopes(self, depth: Floats, sensor: int = 0) -> Laterals:
        """Return derivatives (n, K) of a sensor's quantity at depths (n,), mm, from the curves; 0 for its offset."""
        step = self.grid[1] - self.grid[0]
        place = np.clip((depth - self.grid[0]) / step, 0.0, self.grid.size - 1.001)
        left = place.astype(int)
        part = place - left
        curves = self.curves[sensor]
        slopes: Laterals = ((1.0 - part) * curves[:, left] + part * curves[:, left + 1]).T
        return slopes

    def simulate_with(self, parameters: Floats) -> Self:
        """Return the insertion simulated again with these parameters, in segments."""
        simulator = adapt_model(self.nominal, self.settings, parameters)
        state = self.settle_start(simulator, parameters)
        inside = int(np.argmax(np.append(self.tips[1:, X], np.inf) > 0.0))
        ends = [*range(min(inside, len(self.rows)), len(self.rows), _MOVES_A_SEGMENT), len(self.rows)]
        stops, parts, first = [], [state.tip[None]], 0
        for last in ends:
            stops.append((first, state))
            if last > first:
                state, tips = replay_scaled(simulator, state, self.rows[first:last], self.axial_scale)
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

    def settle_start(self, simulator: Simulator, parameters: Floats) -> State:
        """Return the state of the start, settled in the model (`simulator`) with these parameters (K,)."""
        start = self.nominal.start(self.stops[0][1].roll)
        moved = start.with_estimate(
            base_x=float(start.base[0]) + self.axial,
            base=(start.base[Y : Z + 1] + components(parameters[self.slots.base])).tolist(),
            slope=(start.base[THETA:] + components(parameters[self.slots.slope])).tolist(),
        )
        return simulator.replay(moved, _REST)[0]


Fitted = TypeVar("Fitted", bound=FittedInsertion)


def adapt_model(nominal: Simulator, settings: Priors, parameters: Floats) -> Simulator:
    """Return the model with these parameters (K,); nominal: the scenario's model, to which they refer."""
    layers, slots = len(nominal.scenario.tissue), Slots.of(nominal.scenario)
    shift = slots.modulus + layers
    variation = shift + layers - 1
    return nominal.with_adaptation(
        Adaptation(
            shift=parameters[shift:variation],
            stiffness=np.exp(parameters[slots.modulus : shift]),
            cell=settings.cell_mm,
            variation=np.exp(parameters[variation:]),
            bevel=float(parameters[slots.bevel]),
            bend=from_components(parameters[slots.bend]),
            clearance=float(parameters[slots.clearance]),
        )
    )
