"""`adaptive-mpc`: cross-entropy MPC on a model that learns the insertion from the readings.

Start, needle and tissue are identified (`control.identification`). With what was learnt the way to the target is found
again every few millimetres (`control.route`), guide and bevel alike; a short horizon of steps of full advance follows
it, and weighs the miss most where it reaches the target. The paper's rule may turn the bevel besides, if the model
agrees.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from flexneedle.control import bang_bang
from flexneedle.control.adaptive_settings import AdaptiveMpc
from flexneedle.control.estimate import Estimate, Floats
from flexneedle.control.identification import Identification, Identified
from flexneedle.control.interface import Decision, Method, Task, travel_left
from flexneedle.control.mpc import planned_base
from flexneedle.control.route import Route, of_plan, renewed
from flexneedle.planning import Settings, cross_entropy


@dataclass(frozen=True, eq=False)
class Ahead:
    """The way that a decision looks ahead, m steps in n pieces.

    advance (m,): mm; piece (m,): the piece of each step; path (m, 2): wanted y (mm) of the model's tip, and angle;
    guide (m,): the route's steps (mm); base (m, 2): the plan's steps of base y and turn; weight (m,): of the deviation
    after each step.
    """

    advance: Floats
    piece: NDArray[np.intp]
    path: Floats
    guide: Floats
    base: Floats
    weight: Floats
    flip: bool


def decide(task: Task, memory: Route, estimate: Estimate, rng: np.random.Generator) -> tuple[Decision, Route]:
    """The way, the bevel, then the best first step of the guide."""
    belief = cast(Identified, estimate)  # METHOD below names its observer
    route = _followed(task, memory, belief, rng)
    due = float(belief.state.tip[0]) + 0.5 * task.scenario.setup.max_advance_mm
    turns, route = sum(turn <= due for turn in route.turns), route.after(due)
    if turns % 2 == 1:
        return _search(task, belief, route, rng, flip=True, why="bevel turned: on the way"), route
    flip, why = bang_bang.decide(task, belief, task.settings)
    decision = _search(task, belief, route, rng, flip=flip, why=why)
    if flip:
        kept = _search(task, belief, route, rng, flip=False, why=f"{why}; the model keeps it")
        decision = min(decision, kept, key=lambda choice: choice.cost)
    return decision, route


def _followed(task: Task, route: Route, belief: Identified, rng: np.random.Generator) -> Route:
    """The route, found again if it is time, but for the horizon before the target."""
    if float(belief.state.tip[0]) < route.renew_at or _near(task, belief):
        return route
    return renewed(task, belief, route, rng)


def _near(task: Task, belief: Identified) -> bool:
    """Whether the horizon reaches the target."""
    reach: float = task.settings.horizon * task.scenario.setup.max_advance_mm
    return travel_left(task.scenario, task.plan, belief.state) <= reach + 1e-9


def _ahead(task: Task, belief: Identified, route: Route, *, flip: bool) -> Ahead:
    settings, setup = task.settings, task.scenario.setup
    left = travel_left(task.scenario, task.plan, belief.state)
    steps = max(1, min(settings.horizon, int(np.ceil(left / setup.max_advance_mm - 1e-9))))
    advance = np.diff(np.minimum(np.arange(steps + 1) * setup.max_advance_mm, left))
    depth = float(belief.state.tip[0]) + np.append(0.0, np.cumsum(advance))
    path = np.stack([np.interp(depth[1:], route.depth, route.tips[:, k]) for k in (0, 1)], axis=1)
    weight = np.ones(steps)
    if _near(task, belief):
        path[-1, 0], weight[-1] = task.plan.target[1], settings.target_weight
    path[:, 0] -= belief.off_axis(-belief.state.bevel if flip else belief.state.bevel)
    guide = np.diff(np.interp(depth, route.depth, route.guide))
    pieces = min(settings.pieces, steps)
    base = planned_base(setup, task.plan, belief.state, depth[1:])
    return Ahead(advance, np.arange(steps) * pieces // steps, path, guide, base, weight, flip)


def _search(
    task: Task, belief: Identified, route: Route, rng: np.random.Generator, *, flip: bool, why: str
) -> Decision:
    """Cross-entropy over the guide's step in each piece."""
    setup, settings = task.scenario.setup, task.settings
    ahead = _ahead(task, belief, route, flip=flip)
    pieces = int(ahead.piece[-1]) + 1
    most = setup.max_guide_step_mm if setup.has_guide else 0.0
    mean = np.array([ahead.guide[ahead.piece == k].mean() for k in range(pieces)])
    found = cross_entropy.minimize(
        lambda z: _cost(task, belief, ahead, z),
        cross_entropy.start(np.clip(mean, -most, most), np.full(pieces, min(settings.guide_sigma_mm, most))),
        Settings(
            samples=settings.samples,
            elite=max(2, settings.samples // 8),
            iterations=settings.iterations,
            smoothing=task.scenario.plan.smoothing,
            tolerance=task.scenario.plan.tolerance,
            lower=np.full(pieces, -most),
            upper=np.full(pieces, most),
        ),
        rng,
    )
    db_x, db_y, db_theta, dg_y, _ = _controls(task, belief, ahead, found.best[None])[0, 0].tolist()
    spread = float(np.sqrt(found.covariance[0, 0]))
    return Decision((db_x, db_y, db_theta, dg_y, 1 if flip else -1), why, found.best_cost, spread)


def _controls(task: Task, belief: Identified, ahead: Ahead, z: Floats) -> Floats:
    """Controls (N, m, 5) of guide steps z (N, n); the guide stays within its reach."""
    reach = task.scenario.setup.max_guide_travel_mm
    steps = z[:, ahead.piece] * (ahead.advance / task.scenario.setup.max_advance_mm)
    guide = np.clip(belief.state.guide + np.cumsum(steps, axis=1), -reach, reach)
    controls = np.zeros((len(z), ahead.advance.size, 5))
    controls[:, :, 0] = ahead.advance
    controls[:, :, 1:3] = ahead.base
    controls[:, :, 3] = np.diff(guide, axis=1, prepend=belief.state.guide)
    controls[:, :, 4] = -1.0
    controls[:, 0, 4] = 1.0 if ahead.flip else -1.0
    return controls


def _cost(task: Task, belief: Identified, ahead: Ahead, z: Floats) -> Floats:
    """Weighted squared deviation from the path (mm²), departure from the route's guide steps, tissue energy."""
    settings = task.settings
    controls = _controls(task, belief, ahead, z)
    tips, energy, converged = belief.simulator.rollout(belief.state, controls)
    off = (tips[:, :, 1:] - ahead.path) * (1.0, settings.orientation_weight_mm)
    costs: Floats = (off**2).sum(axis=2) @ ahead.weight
    costs += settings.guide_weight * ((controls[:, :, 3] - ahead.guide) ** 2).sum(axis=1)
    costs += settings.energy_weight_per_mj * energy.sum(axis=1)
    return np.where(converged.all(axis=1), costs, np.inf)


METHOD = Method(
    "adaptive-mpc",
    "cross-entropy MPC on a model that learns start, needle and tissue from the readings",
    Identification(),
    begin=lambda task: of_plan(task.plan),
    decide=decide,
    settings=AdaptiveMpc,
)
