"""The way to the target: at first the plan's, then found again by cross-entropy with what the observer has learnt.

Towards the target the needle is simulated in steps longer than a control step; the guide moves evenly in each of a few
pieces, and the bevel may turn between them. The cost is the planner's with more weight on the tissue (paper eq. 9).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.control.estimate import Floats
from flexneedle.control.identification import Identified
from flexneedle.control.interface import Task, travel_left
from flexneedle.control.mpc import planned_base
from flexneedle.planning import Settings, cross_entropy
from flexneedle.trace import PlanRecord

__all__ = ["Route", "of_plan", "renewed"]

_LONG = 2.0  # steps, in control steps
_SIDE_SIGMA = 1.0
_SIDE_BOUND = 3.0
_SIDE_CORRELATION = (
    0.8  # of the bevel's side in neighbouring pieces at first: few turns are likelier than many
)


@dataclass(frozen=True, eq=False)
class Route:
    """Where to be, over the depth (r,) of the tip (mm): y and angle of the tip as seen, tips (r, 2); guide (r,), mm.

    turns: depths at which the bevel turns; renew_at: depth at which to find the way again.
    """

    depth: Floats
    tips: Floats
    guide: Floats
    turns: tuple[float, ...]
    renew_at: float = 0.0

    def after(self, depth: float) -> "Route":
        """Without the turns up to `depth` (mm)."""
        return replace(self, turns=tuple(turn for turn in self.turns if turn > depth))


def of_plan(plan: PlanRecord) -> Route:
    """The plan's way, to be found again at the skin."""
    turns = plan.tips[:-1][plan.controls[:, 4] > 0.0]
    return Route(plan.tips[:, 0], plan.tips[:, 1:], plan.guide, tuple(turns[:, 0].tolist()))


def renewed(task: Task, belief: Identified, route: Route, rng: np.random.Generator) -> Route:
    """The best way found from where the needle is believed to be to the target."""
    settings = task.settings
    ahead = _Ahead.of(task, belief)
    pieces, most = int(ahead.piece[-1]) + 1, _LONG * ahead.guide_step
    mean = np.concatenate([_guide_steps(ahead, route), np.full(pieces, float(belief.state.bevel))])
    guide_sigma = min(settings.route_guide_sigma_mm, most)
    sigma = np.repeat([guide_sigma, _SIDE_SIGMA], pieces)
    sigma[pieces] = 0.0  # the side in the first piece is the present one
    apart = np.abs(np.subtract.outer(np.arange(pieces), np.arange(pieces)))
    correlation = np.eye(2 * pieces)
    correlation[pieces:, pieces:] = _SIDE_CORRELATION**apart
    bound = np.repeat([most, _SIDE_BOUND], pieces)
    found = cross_entropy.minimize(
        lambda z: _cost(task, belief, ahead, z),
        cross_entropy.start(mean, sigma, correlation),
        Settings(
            samples=settings.route_samples,
            elite=max(2, settings.route_samples // 8),
            iterations=settings.route_iterations,
            smoothing=task.scenario.plan.smoothing,
            tolerance=task.scenario.plan.tolerance,
            lower=-bound,
            upper=bound,
        ),
        rng,
    )
    if not np.isfinite(found.best_cost):
        return replace(route, renew_at=ahead.depth[0] + settings.route_mm)
    return _route(belief, ahead, _controls(ahead, belief, found.best[None]), settings.route_mm)


@dataclass(frozen=True, eq=False)
class _Ahead:
    """The steps to the target: advance (m,), mm; piece (m,) that each belongs to; depth (m + 1,) of the tip before and
    after each; base (m, 2): planned steps of base y and turn; longest guide step in a control step, reach (mm).
    """

    advance: Floats
    piece: NDArray[np.intp]
    depth: Floats
    base: Floats
    guide_step: float
    reach: float

    @staticmethod
    def of(task: Task, belief: Identified) -> "_Ahead":
        """Even steps, in even pieces."""
        setup, settings = task.scenario.setup, task.settings
        left = travel_left(task.scenario, task.plan, belief.state)
        steps = max(1, int(np.ceil(left / (_LONG * setup.max_advance_mm) - 1e-9)))
        depth = float(belief.state.tip[0]) + np.linspace(0.0, left, steps + 1)
        pieces = min(settings.route_pieces, steps)
        return _Ahead(
            np.diff(depth),
            np.arange(steps) * pieces // steps,
            depth,
            planned_base(setup, task.plan, belief.state, depth[1:]),
            setup.max_guide_step_mm if setup.has_guide else 0.0,
            setup.max_guide_travel_mm,
        )


def _guide_steps(ahead: _Ahead, route: Route) -> Floats:
    """The guide's mean step in each piece on the present route."""
    steps = np.diff(np.interp(ahead.depth, route.depth, route.guide))
    pieces = int(ahead.piece[-1]) + 1
    return np.array([steps[ahead.piece == k].mean() for k in range(pieces)])


def _controls(ahead: _Ahead, belief: Identified, z: Floats) -> Floats:
    """Controls (N, m, 5) of guide steps and bevel sides z (N, 2 n); the guide stays within its reach."""
    pieces = z.shape[1] // 2
    guide = belief.state.guide + np.cumsum(z[:, :pieces][:, ahead.piece], axis=1)
    guide = np.clip(guide, -ahead.reach, ahead.reach)
    side = np.where(z[:, pieces:] >= 0.0, 1.0, -1.0)[:, ahead.piece]
    controls = np.zeros((len(z), ahead.advance.size, 5))
    controls[:, :, 0] = ahead.advance
    controls[:, :, 1:3] = ahead.base
    controls[:, :, 3] = np.diff(guide, axis=1, prepend=belief.state.guide)
    controls[:, :, 4] = np.where(np.diff(side, axis=1, prepend=belief.state.bevel) != 0.0, 1.0, -1.0)
    return controls


def _seen(belief: Identified, controls: Floats, tips: Floats) -> Floats:
    """Lateral place (N, m) of the tip as it will be seen, mm."""
    side = belief.state.bevel * np.cumprod(-np.sign(controls[:, :, 4]), axis=1)
    seen: Floats = tips[:, :, 1] + belief.run_out * side + belief.residual
    return seen


def _cost(task: Task, belief: Identified, ahead: _Ahead, z: Floats) -> Floats:
    """The miss (mm), and what tissue energy, guide motion and turns are worth against it (mm)."""
    settings = task.settings
    controls = _controls(ahead, belief, z)
    tips, energy, converged = belief.simulator.rollout(belief.state, controls, limits=False)
    depth, lateral = task.plan.target
    end = tips[:, -1]
    miss = np.abs(_seen(belief, controls, tips)[:, -1] + np.tan(end[:, 2]) * (depth - end[:, 0]) - lateral)
    costs: Floats = miss + settings.route_energy_weight_mm_per_mj * energy[:, -1]
    costs += settings.route_guide_weight_per_mm * (controls[:, :, 3] ** 2).sum(axis=1)
    costs += settings.route_turn_weight_mm * (controls[:, :, 4] > 0.0).sum(axis=1)
    return np.where(converged.all(axis=1), costs, np.inf)


def _route(belief: Identified, ahead: _Ahead, controls: Floats, route_mm: float) -> Route:
    """The way of these controls (1, m, 5), from the tip as it is seen now."""
    tips, _, _ = belief.simulator.rollout(belief.state, controls, limits=False)
    seen = np.stack([_seen(belief, controls, tips)[0], tips[0, :, 2]], axis=1)
    return Route(
        ahead.depth,
        np.concatenate([belief.tip[None, 1:], seen]),
        belief.state.guide + np.append(0.0, np.cumsum(controls[0, :, 3])),
        tuple(ahead.depth[:-1][controls[0, :, 4] > 0.0].tolist()),
        float(ahead.depth[0]) + route_mm,
    )
