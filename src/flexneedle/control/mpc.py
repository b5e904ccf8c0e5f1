"""Cross-entropy model predictive control of advance and guide (paper eq. 13)."""

from functools import partial

import numpy as np

from flexneedle.control.bang_bang import BevelRule
from flexneedle.control.interface import Decision, travel_left
from flexneedle.control.limits import guide_reach, largest_guide_step
from flexneedle.costs.terms import CE_MPC, drop_zones
from flexneedle.costs.weighted_sum import outputs_of
from flexneedle.planning.cross_entropy import Search, elite_count
from flexneedle.planning.horizon import Variables, find_best
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.scenario.sections.fields import Fraction, NonNegative, count
from flexneedle.scenario.sections.weights import with_weights
from flexneedle.simulator.control import MOVES, controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.simulator.zones import zones_of
from flexneedle.types import DB_X, DB_Y, DG_Y, ROLL, STILL, Control, Floats, X, Y, Z

_TOLERANCE = 1e-3  # spread of the elite's costs at convergence, relative to the first
_LEAST_ADVANCE = 0.5  # of the longest step, so that the cost is not reduced by not advancing


@with_weights(CE_MPC, "control.ce_mpc")
class CeMpc(BevelRule):
    """Section `control.ce_mpc`: the search of `ce-mpc`, and its bang-bang rule for the bevel."""

    samples: int = count(21, least=2, most=100_000)
    """Control sequences per iteration."""
    iterations: int = count(4, least=1, most=1_000)
    """Iterations per control period."""
    horizon: int = count(7, least=1, most=1_000)
    """Horizon, in control steps."""
    orientation_weight_mm: NonNegative = 11.8
    """Weight of the angle to the planned path, as the distance equivalent to 1 rad."""
    curvature_per_m: NonNegative = 0.232
    """κ, curvature of the rule's two paths."""
    flip_dead_band: Fraction = 0.875
    """As `control.bevel_only.flip_dead_band`."""


def choose_step(
    simulator: Simulator,
    plan: Plan,
    state: State,
    control: CeMpc,
    *,
    roll: float,
    rng: np.random.Generator,
    why: str = "",
) -> Decision:
    """Return the first of the next steps of advance and guide with the least deviation from the planned tip poses.

    roll: roll in the first step (rad); why: its reason.
    """
    scenario = simulator.scenario
    steps, travel = control.horizon, travel_left(scenario, plan, state)
    reference, nominal = plan_window(plan, float(state.tip[X]), steps)
    base = steps_to_planned_base(scenario.setup, plan, state, reference[:, X])
    guide = largest_guide_step(scenario.setup, plan.strategy)
    variables = _variables(scenario, state, base, travel, nominal, guide, roll)
    search = Search(
        samples=control.samples,
        elite=elite_count(control.samples, scenario.plan.elite_fraction),
        iterations=control.iterations,
        smoothing=scenario.plan.smoothing,
        tolerance=_TOLERANCE,
    )
    steps_of_guide = nominal[:, DG_Y : DG_Y + 2]
    weight = control.orientation_weight_mm
    zones = zones_of(scenario)
    terms = CE_MPC.terms(
        control,
        target=plan.target,
        reference=reference,
        orientation=weight,
        nominal=steps_of_guide,
        clear=zones.margin,
    )
    charged = terms if zones else drop_zones(terms)
    wanted = outputs_of(charged)
    rollout = partial(simulator.rollout, state, outputs=wanted.outputs, at_end=wanted.at_end)
    found = find_best(variables, rollout, charged, search, rng)
    spread = float(np.sqrt(found.search_state.covariance[steps, steps]))
    command = Control.of(found.trajectories.controls[0, 0].tolist())
    return Decision(command, why, found.cost, spread, samples=found.samples)


def plan_window(plan: Plan, x: float, steps: int) -> tuple[Floats, Floats]:
    """Return planned tip poses (steps, 5) after each step from the tip's depth x (mm), and the controls (steps, 9)."""
    last = len(plan.tips) - 1
    at = float(np.interp(x, plan.tips[:, X], np.arange(last + 1)))
    index = np.minimum(at + np.arange(1, steps + 1), last)
    poses = np.stack([np.interp(index, np.arange(last + 1), plan.tips[:, k]) for k in range(5)], axis=1)
    rows = np.minimum(np.floor(at + 1e-9).astype(int) + np.arange(steps), last)
    return poses, np.concatenate([plan.controls, [STILL]])[rows]


def planned_offset(plan: Plan, depth: float | Floats) -> Floats:
    """Return y and z (2, …), mm, of the planned path at depths (…), mm, with the target as its end."""
    known, *lateral = (np.append(plan.tips[:-1, k], plan.target[k]) for k in (X, Y, Z))
    return np.array([np.interp(depth, known, values) for values in lateral], dtype=float)


def steps_to_planned_base(setup: Setup, plan: Plan, state: State, depth: Floats) -> Floats:
    """Return steps (n, 4) of base y, z (mm), θ, ψ (rad) to the planned base poses with the tip at `depth` (n,), mm.

    A base that lags behind the plan moves as fast as its limits allow.
    """
    limits = np.repeat([setup.max_base_step_mm, setup.max_base_turn_step], 2).tolist()
    base = slice(DB_Y, DG_Y)
    moved = np.concatenate([np.zeros((1, 4)), np.cumsum(plan.controls[:, base], axis=0)])
    goal = np.stack([np.interp(depth, plan.tips[:, X], column) for column in moved.T])
    goal[:2] = np.clip(goal[:2], -setup.max_base_travel_mm, setup.max_base_travel_mm)
    steps = []
    for place, limit, ends in zip(state.travel[base].tolist(), limits, goal.tolist(), strict=True):
        for end in ends:
            steps.append(min(max(end - place, -limit), limit))
            place += steps[-1]
    return np.array(steps).reshape(goal.shape).T


def _variables(
    scenario: Scenario,
    state: State,
    base: Floats,
    travel: float,
    nominal: Floats,
    guide: float,
    roll: float,
) -> Variables:
    """Return the variables z of the search: advances, and guide steps on each axis, (steps,) each, about the plan's.

    guide: the longest step (mm).
    """
    control, steps, advance = scenario.control, len(nominal), scenario.setup.max_advance_mm
    # A guide step must undo the start error within half the horizon; jitter asks for a little more.
    sigma = min(guide, 2.0 * (control.start_offset_sd_mm + scenario.tracker.jitter_per_axis) / steps)
    axes = scenario.setup.moved_guide_axes or 1
    lower = np.repeat([_LEAST_ADVANCE * advance, *[-guide] * axes], steps)
    upper = np.repeat([advance, *[guide] * axes], steps)
    planned = [nominal[:, DB_X], *nominal.T[DG_Y : DG_Y + axes]]
    return Variables(
        lower=lower,
        upper=upper,
        mean=np.clip(np.concatenate(planned), lower, upper),
        sigma=np.repeat([scenario.plan.advance_sigma_mm, *[sigma] * axes], steps),
        controls=lambda z: make_controls(scenario, state, z, base, travel, roll),
    )


def make_controls(
    scenario: Scenario, state: State, z: Floats, base: Floats, travel: float, roll: float
) -> Floats:
    """Return controls (N, steps, 9) of z and the base's steps.

    The advance is limited to the travel, the guide to its reach.
    """
    n, steps = len(z), len(base)
    moved = np.minimum(np.cumsum(z[:, :steps], axis=1), travel)
    rows = controls(n, steps, db_x=np.diff(moved, axis=1, prepend=0.0))
    for axis, sideways in enumerate(np.split(z[:, steps:], z.shape[1] // steps - 1, axis=1)):
        place = state.guide[axis]
        guide = np.clip(place + np.cumsum(sideways, axis=1), *guide_reach(scenario, axis))
        rows[:, :, DG_Y + axis] = np.diff(guide, axis=1, prepend=place)
    rows[:, :, DB_Y:DG_Y] = base
    rows[:, :, DB_Y:MOVES] *= rows[:, :, :1] > 0.0
    rows[:, 0, ROLL] = roll
    return rows
