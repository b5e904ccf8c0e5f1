"""An observer that corrects the model: start, needle and tissue are fitted to all readings of the insertion.

Maximum a posteriori by Gauss–Newton: the whole insertion is simulated again with other constants, which costs a few
milliseconds, and the lateral readings choose among them. Parameters, with normal priors from the scenario:

    base y (mm), base turn (rad), natural bend of the needle (mm), run-out (mm), ln of the factor on the modulus of
    each layer, and the factor on the bevel offset at knots along the depth, a random walk.

The walk takes up what varies along the depth; being a bevel's force, it turns over with the bevel. What the fit leaves
is low-passed and carried on as a constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from flexneedle.control.estimate import Floats, Move, along, assigned, place
from flexneedle.ports import Command, Sample
from flexneedle.scenario import Scenario
from flexneedle.simulator import Control, Simulator, State

__all__ = ["Identification", "Identified"]

BASE_Y, BASE_TURN, BEND, RUN_OUT, MODULUS = range(5)
_STEPS = (0.05, 3e-4, 0.05, 0.05)  # for differences: mm, rad, mm, mm
_FACTOR_STEP = 0.05
_REFRESH = 3  # moves after which the Jacobian is computed anew
_NEAR_MM = 2.0  # tissue does not matter for a tip further before the skin
_WIDEST = 4.0  # standard deviations that a parameter may leave its prior
_RECENT = 12  # moves whose residuals are low-passed
_LEAST_FACTOR, _LARGEST_FACTOR = (
    -3.0,
    3.4,
)  # of the bevel offset: 0.7 of the compression length with the preset's


@dataclass(frozen=True)
class Identification:
    """This observer has no choices but the scenario's `[control.adaptive_mpc]`."""

    def begin(self, simulator: Simulator, bevel: int) -> "Identified":
        """Believe in the scenario."""
        layers = len(simulator.scenario.tissue)
        parameters = np.append(np.zeros(MODULUS + layers), 1.0)
        state = simulator.start(bevel)
        return Identified(simulator, simulator, bevel, parameters, state, state.tip[None])


@dataclass(frozen=True, eq=False)
class Identified:
    """The belief; an `Estimate`.

    nominal: the scenario's model; first_bevel: at the start; parameters (K,); tips (m + 1, 3): of the model at the
    ends of the m moves, the start first; jacobian (r, K) of the first r readings.
    """

    nominal: Simulator
    simulator: Simulator
    first_bevel: int
    parameters: Floats
    state: State
    tips: Floats
    moves: tuple[Move, ...] = ()
    jacobian: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    residual: float = 0.0
    innovation: tuple[float, float] = (0.0, 0.0)
    measured: tuple[float, float] | None = None

    @property
    def tip(self) -> Floats:
        """Tip pose (3,) as seen: the model's and what its axis is off."""
        tip = self.state.tip
        tip[1] += self.off_axis(self.state.bevel)
        return tip

    def off_axis(self, bevel: int) -> float:
        """Lateral distance (mm) of the seen tip from the model's with the bevel on that side."""
        return float(self.parameters[RUN_OUT]) * bevel + self.residual

    def tip_at(self, time: float) -> tuple[float, float]:
        """Where the tip was believed to be (mm) at `time`."""
        x, y = along(self.moves, self.tips, time)
        return x, y + self.off_axis(self.state.bevel)

    def unseen(self) -> "Identified":
        """The same without an innovation."""
        return replace(self, innovation=(0.0, 0.0))

    def move(self, applied: Command, begun: float, ended: float) -> "Identified":
        """Move the believed needle as the driver did, from `begun` to `ended` (s)."""
        state = self.simulator.step(self.state, Control.from_row(applied))
        tips = np.concatenate([self.tips, state.tip[None]])
        return replace(self, state=state, tips=tips, moves=(*self.moves, Move(begun, ended, applied)))

    def observe(self, samples: Sequence[Sample]) -> "Identified":
        """Fit the parameters to all readings so far, one Gauss–Newton step, and simulate with them to now."""
        if not samples or not self.moves:
            return self.unseen()
        moves = assigned(self.moves, samples)
        readings = _readings(moves)
        rows = np.array([done.applied for done in moves])
        simulate = partial(_simulated, self.nominal, self.first_bevel, rows)
        parameters = _with_knots(self.nominal.scenario, self.parameters, rows)
        before = readings.predicted(simulate(parameters)[1], rows, self.first_bevel, parameters)
        jacobian = _jacobian(self, simulate, readings, rows, parameters, before)
        parameters = _improved(self.nominal.scenario, readings, parameters, before, jacobian)
        state, tips = simulate(parameters)
        left = readings.y - readings.predicted(tips, rows, self.first_bevel, parameters)
        ahead = readings.x - readings.between(tips[:, 0])
        newest = int(readings.index[-1])
        x, y = tips[newest + 1, :2] + (ahead[-1], left[-1])
        run_out = parameters[RUN_OUT] * _sides(self.first_bevel, rows)[newest + 1]
        return replace(
            self,
            simulator=_adapted(self.nominal, parameters, _depths(self.nominal.scenario, rows)[-1]),
            parameters=parameters,
            state=state,
            tips=tips,
            moves=moves,
            jacobian=jacobian,
            residual=_low_passed(self.nominal.scenario, left) if tips[-1, 0] > 0.0 else 0.0,
            innovation=(float(ahead[-1]), float(left[-1])),
            measured=(float(x), float(y + run_out)),
        )


@dataclass(frozen=True, eq=False)
class _Readings:
    """Means of the readings of each move that has any, each (r,): move, share of it done, x, y (mm), variance (mm²)."""

    index: Floats
    part: Floats
    x: Floats
    y: Floats
    count: Floats

    def between(self, ends: Floats) -> Floats:
        """A quantity at the readings, from its values at the ends of the moves (m + 1,)."""
        k = self.index.astype(int)
        between: Floats = (1.0 - self.part) * ends[k] + self.part * ends[k + 1]
        return between

    def predicted(self, tips: Floats, rows: Floats, bevel: int, parameters: Floats) -> Floats:
        """The model's lateral readings (r,), mm."""
        return self.between(tips[:, 1] + parameters[RUN_OUT] * _sides(bevel, rows))


def _readings(moves: tuple[Move, ...]) -> _Readings:
    seen = [(k, done) for k, done in enumerate(moves) if done.samples]
    means = [
        (
            k,
            np.mean([done.part(sample.time) for sample in done.samples]),
            *np.mean([place(sample) for sample in done.samples], axis=0),
            len(done.samples),
        )
        for k, done in seen
    ]
    return _Readings(*np.array(means, dtype=float).T)


def _sides(bevel: int, rows: Floats) -> Floats:
    """Direction of the bevel at the ends of the moves, the start first, (m + 1,)."""
    return bevel * np.cumprod(np.append(1.0, np.where(rows[:, 4] > 0.0, -1.0, 1.0)))


def _depths(scenario: Scenario, rows: Floats) -> Floats:
    """Depth of a straight needle's tip before and after the moves (m + 1,), mm."""
    start = scenario.setup.start_tip_x
    return start + np.append(0.0, np.cumsum(rows[:, 0]))


def _with_knots(scenario: Scenario, parameters: Floats, rows: Floats) -> Floats:
    """The parameters with a knot of the bevel's factor at or past the tip; a new one believes its neighbour."""
    depth = max(0.0, float(_depths(scenario, rows).max()))
    needed = MODULUS + len(scenario.tissue) + 1 + int(np.ceil(depth / scenario.control.adaptive_mpc.knot_mm))
    return np.append(parameters, np.full(max(0, needed - parameters.size), parameters[-1]))


def _factors(scenario: Scenario, parameters: Floats, depth: Floats) -> Floats:
    """Factor on the bevel offset at depths (mm)."""
    knots = parameters[MODULUS + len(scenario.tissue) :]
    factors: Floats = np.interp(depth, np.arange(knots.size) * scenario.control.adaptive_mpc.knot_mm, knots)
    return factors


def _adapted(nominal: Simulator, parameters: Floats, depth: float) -> Simulator:
    """The model with the learnt constants, those of `depth` (mm) where they vary along it."""
    layers = len(nominal.scenario.tissue)
    bevel = float(_factors(nominal.scenario, parameters, np.array(depth)))
    return nominal.adapted(
        np.exp(parameters[MODULUS : MODULUS + layers]).tolist(), bevel, float(parameters[BEND])
    )


def _simulated(nominal: Simulator, bevel: int, rows: Floats, parameters: Floats) -> tuple[State, Floats]:
    """The insertion so far with these parameters: the state now, and the tips (m + 1, 3)."""
    layers = len(nominal.scenario.tissue)
    modulus = np.exp(parameters[MODULUS : MODULUS + layers]).tolist()
    simulator = nominal.adapted(modulus, 1.0, float(parameters[BEND]))
    start = nominal.start(bevel).believing(
        base_y=float(parameters[BASE_Y]), base_turn=float(parameters[BASE_TURN])
    )
    rest = np.array([[0.0, 0.0, 0.0, 0.0, -1.0]])  # takes up the start
    factors = _factors(nominal.scenario, parameters, _depths(nominal.scenario, rows))
    return simulator.replay(start, np.concatenate([rest, rows]), factors)


def _jacobian(
    belief: Identified,
    simulate: partial[tuple[State, Floats]],
    readings: _Readings,
    rows: Floats,
    parameters: Floats,
    before: Floats,
) -> Floats:
    """Derivative (r, K) of the predicted readings; old rows are kept for a few moves, new ones take the last one's."""
    old = belief.jacobian
    if old.shape[1] == parameters.size and readings.y.size % _REFRESH and old.shape[0] > 0:
        kept: Floats = old[np.minimum(np.arange(readings.y.size), old.shape[0] - 1)]
        return kept
    deep = belief.tips[-1, 0] > -_NEAR_MM
    jacobian = np.zeros((readings.y.size, parameters.size))
    jacobian[:, RUN_OUT] = readings.between(_sides(belief.first_bevel, rows))
    for k in (BASE_Y, BASE_TURN, BEND, *(range(MODULUS, parameters.size) if deep else ())):
        step = _STEPS[k] if k < MODULUS else _FACTOR_STEP
        other = parameters.copy()
        other[k] += step
        tips = simulate(other)[1]
        jacobian[:, k] = (readings.predicted(tips, rows, belief.first_bevel, other) - before) / step
    return jacobian


def _improved(
    scenario: Scenario, readings: _Readings, parameters: Floats, before: Floats, jacobian: Floats
) -> Floats:
    """One Gauss–Newton step to the maximum a posteriori, within the widest sensible range."""
    settings = scenario.control.adaptive_mpc
    variance = scenario.tracker.jitter_per_axis**2 / readings.count + settings.model_sd_mm**2
    precision, mean, widest = _prior(scenario, parameters.size)
    weighted = jacobian.T / variance
    gradient = weighted @ (readings.y - before) - precision @ (parameters - mean)
    moved = parameters + np.linalg.solve(weighted @ jacobian + precision, gradient)
    return np.clip(moved, *widest)


def _prior(scenario: Scenario, size: int) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Precision (K, K) and mean (K,) of the parameters, and their bounds (2 × (K,))."""
    control, settings = scenario.control, scenario.control.adaptive_mpc
    knots = MODULUS + len(scenario.tissue)
    sd = np.array([control.start_offset_sd_mm, control.start_angle_sd, settings.bend_sd_mm])
    sd = np.concatenate([sd, [settings.run_out_sd_mm], np.full(knots - MODULUS, settings.modulus_log_sd)])
    sd = np.maximum(sd, 1e-9)
    precision = np.zeros((size, size))
    precision[range(knots), range(knots)] = sd**-2.0
    precision[knots, knots] = max(settings.bevel_sd, 1e-9) ** -2.0
    walk = max(settings.bevel_walk_sd, 1e-9) ** -2.0
    for k in range(knots + 1, size):
        precision[k - 1 : k + 1, k - 1 : k + 1] += walk * np.array([[1.0, -1.0], [-1.0, 1.0]])
    mean = np.where(np.arange(size) < knots, 0.0, 1.0)
    low = np.append(-_WIDEST * sd, np.full(size - knots, _LEAST_FACTOR))
    high = np.append(_WIDEST * sd, np.full(size - knots, _LARGEST_FACTOR))
    return precision, mean, (low, high)


def _low_passed(scenario: Scenario, left: Floats) -> float:
    """The residuals (r,) of the last moves, each less than the one after it."""
    level, gain = 0.0, scenario.control.adaptive_mpc.residual_gain
    for value in left[-_RECENT:].tolist():
        level += gain * (value - level)
    return level
