"""Equilibrium of the needle: iterations of two sweeps, a line search, and the needle in its guide."""

import math

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lateral import Lateral, dot, lateral, size, stretch, times
from flexneedle.mechanics.law import response
from flexneedle.mechanics.model import CONTACT, GUIDE, Model
from flexneedle.mechanics.needle import (
    Bearing,
    Boundary,
    Cut,
    Equilibrium,
    Iterate,
    Laterals,
    Loads,
    NodePose,
    Path,
    Work,
)
from flexneedle.mechanics.spring import spring_law, spring_rest
from flexneedle.mechanics.sweep import solve_tip, sweep_back, sweep_out

COUPLED_ITERATIONS = 15
BEARING_TRIALS = 15  # at the needle in its guide, in an iteration without coupling
MAX_ITERATIONS = 100


@inner
def _overshoot(
    model: Model,
    front: float,
    spring: Lateral,
    u: Laterals,
    w: Work,
    count: int,
    tip_x: float,
    new_spring: Lateral,
    t: float,
) -> float:
    """Return the slope of the energy along an iteration's step at `t`, less the beam's part of 1 − t.

    The beam's part is never negative.
    """
    nodes = model.nodes
    change = new_spring - spring
    here = spring + times(t, change)
    secant, tangent, _, _ = spring_law(model, front, tip_x, spring)
    amount = size(spring)
    along = times(1.0 / amount, spring) if amount > 0.0 else times(1.0, lateral(spring, 1.0, 0.0))
    linear = times(secant, spring) + stretch(along, change, tangent, secant)
    slope = dot(times(spring_law(model, front, tip_x, here)[0], here) - linear, change)
    for i in range(count):
        node, out = nodes[i], w[i]
        if node.kind == CONTACT:
            change = out.new_u - u[i]
            here = u[i] + times(t, change)
            law = response(model.laws[node.law], size(here) / node.height)
            scale = node.stiffness * min(1.0, (tip_x - node.x) / node.reach)
            slope += dot(out.force - times(out.stiffness, change) + times(scale * law.secant, here), change)
    return float(slope)


@inner
def _line_search(
    model: Model,
    front: float,
    spring: Lateral,
    u: Laterals,
    w: Work,
    count: int,
    tip_x: float,
    new_spring: Lateral,
) -> float:
    """Return the fraction of an iteration's step at which the convex energy still falls: no cycle can form."""
    if _overshoot(model, front, spring, u, w, count, tip_x, new_spring, 1.0) <= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        if _overshoot(model, front, spring, u, w, count, tip_x, new_spring, middle) > 0.0:
            high = middle
        else:
            low = middle
    return low if low > 0.0 else high


@inner
def _behind(model: Model, tip_x: float, near: int) -> int:
    """Return the number of nodes behind `tip_x`, counted from a number `near` it."""
    nodes, count = model.nodes, min(near, model.nodes.size)
    while count < nodes.size and nodes[count].x < tip_x:
        count += 1
    while count > 0 and nodes[count - 1].x >= tip_x:
        count -= 1
    return count


@inner
def _guess(model: Model, boundary: Boundary, cut: Cut, last: Iterate, u: Laterals) -> tuple[Lateral, Lateral]:
    """Return a first guess of the y of the tip, on its line, and of the tip spring; contacts ahead are unstrained."""
    tip_x = boundary.base.x + model.length - last.shortening
    y = cut.tip.y + times(tip_x - cut.tip.x, cut.tip.slope)
    front = cut.channel.front
    for i in range(_behind(model, front, last.behind), _behind(model, tip_x + 1.0, last.behind)):
        u[i] = times(0.0, y)
    fixed, slope = spring_rest(model, boundary.bevel, cut, Path(1.0, y), tip_x)
    return y, times(slope, y) - fixed


@inner
def _bearing(
    model: Model, boundary: Boundary, w: Work, count: int, last: Bearing, settled: float
) -> tuple[bool, Bearing]:
    """Return whether the needle bears on its guide as assumed, to `settled` (mm), and the next assumption.

    A wall only pushes, and between the walls nothing does: one inequality of a convex problem, so that few changes do.
    In space the wall is a circle, which pushes towards its middle: the needle bears on the point nearest to where it
    would be without the wall, as far as its displacement per force is known from the last change.
    """
    if count == 0 or model.nodes[0].kind != GUIDE or model.clearance <= 0.0:
        return True, last
    y, force, bears = w[0].y - boundary.guide, w[0].force, size(last.wall) > 0.0
    give, moved = last.give, size(y - last.y)
    if moved > settled:  # not at a first trial, where the last y is NaN
        give = min(moved / size(force - last.force), w[0].b11)
    free = y - times(give, force)
    distance = size(free)
    pulls = dot(force, last.wall) > 0.0
    off = distance <= model.clearance and (pulls or not bears)  # a wall that pushes stays, however weakly
    if off or (pulls and dot(free, last.wall) <= 0.0):
        return not bears, Bearing(times(0.0, y), give, y, force)
    wall = free / distance if distance > 0.0 else last.wall
    agrees = bears and model.clearance * size(wall - last.wall) <= settled
    return agrees, Bearing(wall, give, y, force)


@inner
def _iterate(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    at: Iterate,
    path: Path,
    rest: Laterals,
    u: Laterals,
    w: Work,
    held: Lateral,
    radial_weight: float,
) -> tuple[NodePose, Iterate, Loads, int, float, bool]:
    """Carry out one iteration, in place.

    Returns tip, start of the next iteration, loads, first node being cut, distance left (mm), and whether the needle
    bears on its guide as assumed. Without coupling it first searches the position in the guide with the least quadratic
    energy: a line search towards that position descends, so that the needle cannot alternate between the walls.
    """
    nodes = model.nodes
    tip_x = boundary.base.x + model.length - at.shortening
    count = _behind(model, tip_x, at.behind)
    fresh = count
    while fresh > 0 and nodes[fresh - 1].x > cut.channel.front:
        fresh -= 1
    trials, settled, guide = 1, model.slide, at.guide
    if path.coupling == 0.0:
        unknown = times(math.nan, boundary.guide)
        trials, settled = BEARING_TRIALS, 0.1 * model.tolerance
        guide = Bearing(guide.wall, guide.give, unknown, unknown)
    for _ in range(trials):
        ahead = sweep_out(
            model, boundary, cut, guide.wall, path, rest, u, w, tip_x, count, fresh, radial_weight
        )
        tip = solve_tip(model, boundary, cut, at.spring, path, tip_x, held, ahead)
        shear, moment, shortening, left, fraction = sweep_back(model, boundary, u, w, tip_x, tip, count)
        agrees, guide = _bearing(model, boundary, w, count, guide, settled)
        if agrees:
            break
    if path.coupling == 0.0 and left > model.tolerance:
        front, spring = cut.channel.front, at.spring
        fraction = min(fraction, _line_search(model, front, spring, u, w, count, tip_x, tip.spring))
    for i in range(count):
        if nodes[i].kind == CONTACT:
            u[i] = w[i].new_u if fraction == 1.0 else u[i] + times(fraction, w[i].new_u - u[i])
    spring = tip.spring if fraction == 1.0 else at.spring + times(fraction, tip.spring - at.spring)
    return (
        NodePose(tip_x, tip.y, tip.slope),
        Iterate(spring, shortening, guide, count),
        Loads(tip.force, tip.reaction, shear, moment),
        fresh,
        left if fraction == 1.0 else math.inf,
        agrees,
    )


@inner
def solve(
    model: Model,
    boundary: Boundary,
    cut: Cut,
    last: Iterate,
    rest: Laterals,
    u: Laterals,
    w: Work,
    held: Lateral,
) -> tuple[Equilibrium, Path, int]:
    """Find the equilibrium; a `held` tip (mm, NaN if free) is an essential condition.

    The shortening and the end of the path being cut are found with it. Where that does not converge, both are taken
    from the start of the step: the remaining problem is the minimum of a convex energy, found with a line search.

    `rest` and `u` (n,) are lateral arrays, updated in place; `w` is a `work_array`. Returns also the path that was cut
    and the index of the first node on it.
    """
    y, spring = _guess(model, boundary, cut, last, u)
    unknown = times(math.nan, y)
    guide_before = Bearing(last.guide.wall, last.guide.give, unknown, unknown)
    at = Iterate(spring, last.shortening, guide_before, last.behind)
    path = Path(1.0, y)
    for iteration in range(1, MAX_ITERATIONS + 1):
        if iteration == COUPLED_ITERATIONS + 1:
            for i in range(model.nodes.size):
                if not math.isfinite(size(u[i])):  # the coupled iterations ran away
                    u[i] = times(0.0, boundary.base.y)
            y, spring = _guess(model, boundary, cut, last, u)
            at = Iterate(spring, last.shortening, guide_before, last.behind)
            path = Path(0.0, y)
        radial_weight = 0.5 if path.coupling > 0.0 else float(iteration % 2)
        tip, new, loads, fresh, left, agrees = _iterate(
            model, boundary, cut, at, path, rest, u, w, held, radial_weight
        )
        slide = at.shortening - new.shortening if path.coupling > 0.0 else 0.0
        found = left <= model.tolerance and abs(slide) <= model.slide
        guide, shortening = new.guide, new.shortening
        if found and agrees:
            at = new
            break
        if path.coupling == 0.0:
            shortening = at.shortening
        elif not found and size(guide.wall) > 0.0 and size(at.guide.wall) > 0.0:
            # On the circle the needle moves on from a solution: before it, the displacement per force is not known.
            guide = at.guide
        at = Iterate(new.spring, shortening, guide, new.behind)
    on = times(slide, tip.slope) if math.isnan(held.real) else times(0.0, tip.slope)
    tip = NodePose(tip.x + slide, tip.y + on, tip.slope)
    finite = math.isfinite(size(tip.y)) and math.isfinite(tip.x)
    return (
        Equilibrium(tip, at, loads, iteration, max(left, abs(slide)), finite and found and agrees),
        path,
        fresh,
    )
