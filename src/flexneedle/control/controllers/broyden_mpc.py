"""`broyden-mpc`: a Jacobian estimated from readings, and linear MPC of the guide; no model of needle or tissue.

Bernardes et al., Data-driven adaptive needle insertion assist for transperineal prostate interventions (Phys. Med.
Biol. 2023, doi:10.1088/1361-6560/accefa): the Jacobian from inputs (insertion, guide position) to the measured
tip takes 0.65 of Broyden's rank-one update after each step; the guide positions of four steps, within 6 mm of the
axis, minimise the distance of the predicted tip from its reference; the first is applied. The bevel is
never rolled. Two things differ here: an MPC step is a control step and not 10 mm of insertion by
hand, and the reference is the planned path where theirs is a target straight ahead.
"""

from dataclasses import dataclass

import numpy as np

from flexneedle.control.interface import Controller, Decision, travel_left
from flexneedle.control.mpc import planned_offset, steps_to_planned_base
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Positive, Section, count
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import DB_X, DG_Y, Control, Floats, X

_LEAST_INSERTION_MM = 0.5  # between two updates: in a shorter one the tracker's noise dominates
_RIDGE = 1e-9  # mm² per squared millimetre of the guide: a unique solution where the guide has no effect
_RELEASE = 1e-12  # gradient of the cost that counts as rounding
_KEPT = 8  # control steps; readings are not older


class BroydenMpc(Section):
    """Section `control.broyden_mpc`: a Jacobian estimated from readings, and linear MPC of the guide."""

    update_gain: Fraction = 0.65
    """Share of Broyden's update of the Jacobian; 1: it reproduces the newest motion."""
    horizon: int = count(4, least=1, most=20)
    """Horizon, in control steps."""
    max_guide_travel_mm: Positive = 6.0
    """Largest lateral distance of the guide from the axis; at most `setup.max_guide_travel_mm`."""
    guide_weight: NonNegative = 0.000316
    """Weight of squared guide steps (mm²) relative to the squared deviation of the tip (mm²)."""
    zone_weight: NonNegative = 30.0
    """Weight of the squared distance (mm²) by which the tip enters the margin of a zone to avoid."""
    guide_effect: NonNegative = 0.982
    """Initial Jacobian: lateral motion of the tip per motion of the guide."""


@dataclass(frozen=True, eq=False)
class JacobianEstimate:
    """Jacobian from insertion and guide to the tip, and the recorded inputs."""

    jacobian: Floats  # derivatives (1 + a, 1 + g) of the tip on a lateral axes, for a guide on g axes
    history: tuple[tuple[float, ...], ...] = ()  # the last rows (tip x, insertion, guide), as commanded
    # tip (1 + a,) and inputs (1 + g,) of the newest update; None before a reading
    last_update: tuple[Floats, Floats] | None = None


def begin(task: Task) -> JacobianEstimate:
    """Return the initial Jacobian, of a tip that continues straight and follows the guide laterally."""
    setup = task.scenario.setup
    jacobian = np.eye(1 + setup.axes, 1 + setup.moved_guide_axes)
    jacobian[1:, 1:] *= task.settings.guide_effect
    return JacobianEstimate(jacobian)


def decide(
    task: Task, estimated: JacobianEstimate, estimate: Estimate, _rng: np.random.Generator
) -> tuple[Decision, JacobianEstimate]:
    """Update the Jacobian by a new reading, predict the present tip, and take the first of the best guide steps."""
    scenario, state = task.scenario, estimate.state
    settings, setup = task.settings, scenario.setup
    inputs = np.array([state.travel[DB_X], *state.guide[: setup.moved_guide_axes]])
    estimated = record_inputs(estimated, float(state.tip[X]), inputs)
    left = travel_left(scenario, task.plan, state)
    advance = min(setup.max_advance_mm, left)
    base = steps_to_planned_base(setup, task.plan, state, state.tip[:1] + advance)[0]
    row = Control(advance, *base.tolist())
    if estimate.measured is None or left <= 0.0:
        return Decision(row, "no reading yet"), estimated
    tip = np.array(estimate.measured[: 1 + setup.axes])
    then = interpolate_inputs(estimated, float(tip[0]))
    estimated = update_jacobian(estimated, tip, then, settings.update_gain)
    tip = tip + estimated.jacobian @ (inputs - then)
    ahead = np.minimum(setup.max_advance_mm * np.arange(1, settings.horizon + 1), left)
    moves, cost = solve_guide_moves(settings, scenario, task.plan, estimated.jacobian, tip, ahead, inputs[1:])
    slopes, effects = estimated.jacobian[1:, 0], np.diag(estimated.jacobian[1:, 1:])
    moved = f"{_join_values(slopes)} laterally with insertion, {_join_values(effects)} with the guide"
    why = f"bevel kept: never rolled; tip moves {moved}"
    return Decision(Control(*row[:DG_Y], *moves[0].tolist()), why, cost), estimated


def _join_values(values: Floats) -> str:
    """Return the numbers of all axes, joined by "and"."""
    return " and ".join(f"{value:.3f}" for value in values.tolist())


def record_inputs(estimated: JacobianEstimate, x: float, inputs: Floats) -> JacobianEstimate:
    """Record the inputs with the tip at depth x (mm), to which later readings are assigned."""
    history = (*estimated.history, (x, *inputs.tolist()))[-_KEPT:]
    return JacobianEstimate(estimated.jacobian, history, estimated.last_update)


def interpolate_inputs(estimated: JacobianEstimate, x: float) -> Floats:
    """Return the inputs (1 + g,) with the tip at depth x (mm), within the recorded range."""
    depth, *inputs = np.array(estimated.history).T
    return np.array([np.interp(x, depth, values) for values in inputs])


def update_jacobian(
    estimated: JacobianEstimate, tip: Floats, inputs: Floats, gain: float
) -> JacobianEstimate:
    """Return the estimate updated by a reading of the tip, if the insertion since the last update is long enough."""
    if estimated.last_update is None:
        return JacobianEstimate(estimated.jacobian, estimated.history, (tip, inputs))
    last_tip, last_inputs = estimated.last_update
    if inputs[0] - last_inputs[0] < _LEAST_INSERTION_MM:
        return estimated
    jacobian = broyden_update(estimated.jacobian, inputs - last_inputs, tip - last_tip, gain)
    return JacobianEstimate(jacobian, estimated.history, (tip, inputs))


def broyden_update(jacobian: Floats, moved: Floats, measured: Floats, gain: float) -> Floats:
    """Return the nearest matrix that maps `moved` to `measured` (Broyden 1965), or the share `gain` of that change."""
    return jacobian + gain * np.outer(measured - jacobian @ moved, moved) / (moved @ moved)


def solve_guide_moves(
    settings: BroydenMpc,
    scenario: Scenario,
    plan: Plan,
    jacobian: Floats,
    tip: Floats,
    ahead: Floats,
    guide: Floats,
) -> tuple[Floats, float]:
    """Return guide positions (n, g), mm, relative to the present ones (g,), and their cost.

    ahead (n,): travel of the tip (mm) at the end of each of n steps. Cost: squared distance (mm²) of tip and planned
    path, `guide_weight` times the squared guide steps, and `zone_weight` times the squared distance to the margins of
    zones of a tip that would enter them without these.
    """
    n, axes = len(ahead), guide.size
    goal = planned_offset(plan, tip[0] + ahead)[: tip.size - 1]
    effort = np.sqrt(settings.guide_weight) * (np.eye(n) - np.eye(n, k=-1))
    left = goal - tip[1:, None] - np.multiply.outer(jacobian[1:, 0], ahead)
    away, inside = _lead_away(settings, zones_of(scenario), jacobian, tip, ahead)
    matrix = np.concatenate([np.kron(jacobian[1:, 1:], np.eye(n)), np.kron(np.eye(axes), effort), away])
    right = np.concatenate([left.ravel(), np.zeros(axes * n), inside])
    setup, home = scenario.setup, scenario.guide_home
    reach = min(settings.max_guide_travel_mm, setup.max_guide_travel_mm)
    guide = guide - np.array([home.real, home.imag])[:axes]
    furthest, place = np.tile(setup.max_guide_step_mm * np.arange(1, n + 1), axes), np.repeat(guide, n)
    lower, upper = np.maximum(-furthest, -reach - place), np.minimum(furthest, reach - place)
    moves = bounded_least_squares(matrix, right, np.minimum(lower, 0.0), np.maximum(upper, 0.0))
    return moves.reshape(axes, n).T, float(np.sum((matrix @ moves - right) ** 2))


def _lead_away(
    settings: BroydenMpc, zones: ZoneMap, jacobian: Floats, tip: Floats, ahead: Floats
) -> tuple[Floats, Floats]:
    """Return rows (n, g n), and their right-hand sides (n,), of motions out of margins that the tip would enter."""
    n, axes = len(ahead), jacobian.shape[1] - 1
    if not zones:
        return np.empty((0, axes * n)), np.empty(0)
    points = np.zeros((n, 3))
    points[:, : tip.size] = tip + np.outer(ahead, np.append(1.0, jacobian[1:, 0]))
    inside = np.maximum(zones.margin - zones.least_clearances(points), 0.0)
    effect = zones.slopes(points)[:, 1 : tip.size] @ jacobian[1:, 1:] * (inside > 0.0)[:, None]
    rows = np.concatenate([np.diag(column) for column in effect.T], axis=1)
    weight = np.sqrt(settings.zone_weight)
    return weight * rows, weight * inside


def bounded_least_squares(matrix: Floats, right: Floats, lower: Floats, upper: Floats) -> Floats:
    """Return the exact least ‖A z − b‖² for lower ≤ 0 ≤ upper, by the primal active-set method from z = 0.

    For a singular A the solution nearest to 0, by a ridge.
    """
    hessian = matrix.T @ matrix + _RIDGE * np.eye(len(lower))
    slope = matrix.T @ right
    z, held = np.zeros(len(lower)), np.zeros(len(lower), dtype=bool)
    for _ in range(10 * len(lower)):  # a few in practice; each lowers the cost
        best = np.where(held, z, 0.0)
        free = np.ix_(~held, ~held)
        best[~held] = np.linalg.solve(hessian[free], (slope - hessian @ best)[~held])
        bound = np.clip(best, lower, upper)
        if (bound == best).all():
            z, push = best, (slope - hessian @ best) * held
            push = np.where(z == lower, np.maximum(push, 0.0), np.minimum(push, 0.0)) * (lower < upper)
            if np.abs(push).max() <= _RELEASE:
                break
            held[np.abs(push).argmax()] = False
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(bound != best, (bound - z) / (best - z), np.inf)
        first = int(part.argmin())
        z = z + part[first] * (best - z)
        z[first], held[first] = bound[first], True
    return z


CONTROLLER = Controller(
    "broyden-mpc",
    "guide by linear MPC with a Jacobian estimated from readings (Broyden), no model",
    StateCorrection(),
    begin=begin,
    decide=decide,
    settings=BroydenMpc,
    needs_guide=True,
    avoids_zones=True,
)
