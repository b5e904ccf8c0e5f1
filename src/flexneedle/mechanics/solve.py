"""Equilibrium of needles: iterations of two sweeps, a line search, and the needle in its guide.

Needles side by side take their iterations together. A needle that has found its equilibrium is no longer `live`: its
results are kept as they are, whatever its companions still search.
"""

import math
from typing import NamedTuple

from flexneedle.mechanics.compile import inner, shared
from flexneedle.mechanics.contact import contact_law, contact_weight
from flexneedle.mechanics.iteration import Iteration, count_before, count_behind, find_spans
from flexneedle.mechanics.lanes import least, load, magnitude, most, opposite, select, some, store
from flexneedle.mechanics.lateral import Lateral, direction, dot, product, size, stretch, times, y_of
from flexneedle.mechanics.needle import (
    Bearing,
    Boundary,
    Cut,
    Equilibrium,
    Held,
    Iterate,
    Loads,
    NodePose,
    Path,
)
from flexneedle.mechanics.spring import spring_law, spring_rest
from flexneedle.mechanics.sweep_back import Right, sweep_back
from flexneedle.mechanics.sweep_out import Tip, solve_tip, sweep_out

from flexneedle.mechanics.work import (  # isort: skip
    B11, CHANGED, CONTACT, FORCE, GUIDE, K, KIND, STIFFNESS, U, X, Needles,
)  # fmt: skip

COUPLED_ITERATIONS = 15
BEARING_TRIALS = 15  # at the needle in its guide, in an iteration without coupling
MAX_ITERATIONS = 100
_AHEAD_MM = 1.0  # contacts this near ahead of the tip are set unstrained


class Solution(NamedTuple):
    """An equilibrium, the x (mm) for which its last iteration was solved, and the path that was cut."""

    found: Equilibrium
    solved_x: float
    path: Path


class _NewtonStep(NamedTuple):
    """Result of an iteration."""

    tip: NodePose
    next: Iterate
    loads: Loads
    error: float  # distance left after it (mm)
    agrees: bool  # whether the needle bears on its guide as assumed


@shared
def _overshoot(w: Needles, it: Iteration, spring: Lateral, new_spring: Lateral, t: float) -> float:
    """Return the slope of the energy along an iteration's step at `t`, less the beam's part of 1 − t.

    The beam's part is never negative.
    """
    change = new_spring - spring
    here = spring + times(t, change)
    front = it.cut.channel.front
    secant, tangent, _, _ = spring_law(w, front, it.tip_x, spring)
    linear = times(secant, spring) + stretch(direction(spring), change, tangent, secant)
    slope = dot(times(spring_law(w, front, it.tip_x, here)[0], here) - linear, change)
    for i in range(it.spans.behind):
        u = load(w.laterals, i, U)
        change = load(w.laterals, i, CHANGED) - u
        here = u + times(t, change)
        scale = load(w.mesh, i, STIFFNESS) * contact_weight(w, i, it.tip_x)
        linear = load(w.laterals, i, FORCE) - times(load(w.reals, i, K), change)
        part = dot(linear + times(scale * contact_law(w, i, here).secant, here), change)
        slope += select(load(w.mesh, i, KIND) == CONTACT, part, 0.0)
    return slope


@inner
def _line_search(w: Needles, it: Iteration, spring: Lateral, new_spring: Lateral, wanted: bool) -> float:
    """Return the fraction of an iteration's step at which the convex energy still falls: no cycle can form."""
    low, high = 0.0 * it.tip_x, 1.0 + 0.0 * it.tip_x
    whole = _overshoot(w, it, spring, new_spring, high) <= 0.0
    if not some(wanted & opposite(whole)):
        return high
    for _ in range(20):
        middle = 0.5 * (low + high)
        beyond = _overshoot(w, it, spring, new_spring, middle) > 0.0
        low, high = select(beyond, low, middle), select(beyond, middle, high)
    return select(whole, 1.0, select(low > 0.0, low, high))


@shared
def _begin(
    w: Needles, boundary: Boundary, cut: Cut, last: Iterate, live: bool, near: int, coupling: float
) -> tuple[Iterate, Path]:
    """Return the start of the iterations, with the tip on its line, and the path; contacts ahead are unstrained."""
    tip_x = boundary.base.x + w.constants.length - last.shortening
    y = cut.tip.y + times(tip_x - cut.tip.x, cut.tip.slope)
    front, ahead = cut.channel.front, tip_x + _AHEAD_MM
    for i in range(count_before(w, ahead, near) - 1, -1, -1):
        x = load(w.mesh, i, X)
        if not some(x >= front):
            break
        unstrained = live & (x >= front) & (x < ahead)
        store(w.laterals, i, U, select(unstrained, times(0.0, y), load(w.laterals, i, U)))
    fixed, slope = spring_rest(w, boundary.bevel, cut, Path(1.0 + 0.0 * tip_x, y), tip_x)
    unknown = times(math.nan, y)
    guide = Bearing(last.guide.wall, last.guide.give, unknown, unknown)
    return Iterate(times(slope, y) - fixed, last.shortening, guide), Path(coupling, y)


@inner
def _bearing(
    w: Needles, boundary: Boundary, last: Bearing, tip_x: float, settled: float
) -> tuple[bool, Bearing]:
    """Return whether the needle bears on its guide as assumed, to `settled` (mm), and the next assumption.

    A wall only pushes, and between the walls nothing does: one inequality of a convex problem, so that few changes do.
    In space the wall is a circle, which pushes towards its middle: the needle bears on the point nearest to where it
    would be without the wall, as far as its displacement per force is known from the last change.
    """
    clearance = w.constants.clearance
    loose = (load(w.mesh, 0, X) < tip_x) & (load(w.mesh, 0, KIND) == GUIDE) & (clearance > 0.0)
    if not some(loose):
        return opposite(loose), last
    y, force = load(w.laterals, 0, CHANGED) - boundary.guide, load(w.laterals, 0, FORCE)
    bears, give, moved = size(last.wall) > 0.0, last.give, size(y - last.y)
    # Not at a first trial, where the last y is NaN.
    give = select(moved > settled, least(moved / size(force - last.force), load(w.reals, 0, B11)), give)
    free = y - times(give, force)
    distance = size(free)
    pulls = dot(force, last.wall) > 0.0
    off = (distance <= clearance) & (pulls | opposite(bears))  # a wall that pushes stays, however weakly
    off = off | (pulls & (dot(free, last.wall) <= 0.0))
    wall = select(distance > 0.0, times(1.0 / select(distance > 0.0, distance, 1.0), free), last.wall)
    settles = bears & (clearance * size(wall - last.wall) <= settled)
    agrees = select(off, opposite(bears), settles)
    now = Bearing(select(off, times(0.0, y), wall), give, y, force)
    return opposite(loose) | agrees, select(loose, now, last)


@inner
def _sweep(w: Needles, it: Iteration, spring: Lateral, wall: Lateral) -> tuple[Tip, Right]:
    """Return the needle at the tip and at the base, bearing on `wall`, from both sweeps."""
    left, follow = sweep_out(w, it, wall)
    tip = solve_tip(w, it, spring, left, follow)
    return tip, sweep_back(w, it, tip)


@inner
def _sweep_in_guide(w: Needles, it: Iteration, at: Iterate) -> tuple[Tip, Right, Bearing, bool]:
    """Return the needle at tip and base and in its guide, and whether it bears on the guide as assumed.

    Without coupling the position in the guide with the least quadratic energy is searched: a line search towards that
    position descends, so that the needle cannot alternate between the walls.
    """
    trials, settled, guide = 1, w.constants.slide, at.guide
    if not it.coupled:
        unknown = times(math.nan, guide.wall)
        trials, settled = BEARING_TRIALS, 0.1 * w.constants.tolerance
        guide = Bearing(guide.wall, guide.give, unknown, unknown)
    wall, agrees = guide.wall, opposite(it.live)
    for _ in range(trials):
        wall = select(agrees, wall, guide.wall)
        tip, base = _sweep(w, it, at.spring, wall)
        agreed, then = _bearing(w, it.boundary, guide, it.tip_x, settled)
        guide, agrees = select(agrees, guide, then), agrees | agreed
        if not some(opposite(agrees)):
            break
    return tip, base, guide, agrees


@inner
def _iterate(w: Needles, it: Iteration, at: Iterate) -> _NewtonStep:
    """Carry out one iteration, in place."""
    tip, base, guide, agrees = _sweep_in_guide(w, it, at)
    fraction = base.fraction
    if not it.coupled:
        searching = it.live & (base.error > w.constants.tolerance)
        if some(searching):
            found = _line_search(w, it, at.spring, tip.spring, searching)
            fraction = select(searching, least(fraction, found), fraction)
    _accept(w, it, fraction)
    full = fraction == 1.0
    spring = select(full, tip.spring, at.spring + times(fraction, tip.spring - at.spring))
    return _NewtonStep(
        NodePose(it.tip_x, tip.y, tip.slope),
        Iterate(spring, base.shortening, guide),
        Loads(tip.force, tip.reaction, tip.couple, base.shear, base.moment),
        select(full, base.error, math.inf),
        agrees,
    )


@inner
def _accept(w: Needles, it: Iteration, fraction: float) -> None:
    """Take the step, or a fraction of it, of the needles that still search."""
    if some(it.live & (fraction != 1.0)):
        for i in range(it.spans.behind):
            u, new_u = load(w.laterals, i, U), load(w.laterals, i, CHANGED)
            part = select(fraction == 1.0, new_u, u + times(fraction, new_u - u))
            store(w.laterals, i, CHANGED, part)
    for i in range(it.spans.behind):
        contact = it.live & (load(w.mesh, i, X) < it.tip_x) & (load(w.mesh, i, KIND) == CONTACT)
        store(w.laterals, i, U, select(contact, load(w.laterals, i, CHANGED), load(w.laterals, i, U)))


@inner
def _slide(it: Iteration, tip: NodePose, slide: float) -> NodePose:
    """Return the tip moved along its own line to its depth; a held tip keeps its y."""
    slope = select(y_of(it.held.y) == y_of(it.held.y), times(0.0, tip.slope), tip.slope)
    return NodePose(tip.x + slide, tip.y + times(slide, slope), tip.slope)


@inner
def _conclude(
    w: Needles, it: Iteration, at: Iterate, step: _NewtonStep, number: int
) -> tuple[bool, Solution, Iterate]:
    """Return which needles have their equilibrium, the equilibrium, and the start of the next iteration."""
    new, guide, one = (
        step.next,
        step.next.guide,
        1.0 + 0.0 * w.constants.length,
    )  # also of a needle without numbers
    slide, shortening = 0.0 * it.tip_x, at.shortening
    if it.coupled:
        slide, shortening = at.shortening - new.shortening, new.shortening
    found = (step.error <= w.constants.tolerance) & (magnitude(slide) <= w.constants.slide)
    done, tip = found & step.agrees, _slide(it, step.tip, slide)
    finite = (size(tip.y) < math.inf) & (magnitude(tip.x) < math.inf)
    solution = Equilibrium(
        tip,
        Iterate(new.spring, select(done, new.shortening, shortening), guide),
        step.loads,
        count_behind(w, it.spans, it.tip_x),
        float(number) * one,
        most(step.error, magnitude(slide)),
        select(done & finite, one, 0.0 * one),
    )
    if it.coupled and some(w.constants.clearance > 0.0):
        # On the circle the needle moves on from a solution: before it, the displacement per force is not known.
        early = opposite(found) & (size(guide.wall) > 0.0) & (size(at.guide.wall) > 0.0)
        guide = select(early, at.guide, guide)
    return done, Solution(solution, it.tip_x, it.path), Iterate(new.spring, shortening, guide)


@inner
def solve(
    w: Needles, boundary: Boundary, cut: Cut, last: Equilibrium, held: Held, live: bool, near: int
) -> tuple[Solution, int]:
    """Find the equilibrium of the `live` needles; what of the tip is `held` is an essential condition.

    The shortening and the end of the path being cut are found with it. Where that does not converge, both are taken
    from the start of the step: the remaining problem is the minimum of a convex energy, found with a line search.

    Rest positions and compressions are updated in place. `near`: about the number of nodes behind the tips; returned
    for the next solve.
    """
    one, bend = 1.0 + 0.0 * w.constants.length, product(w.constants.curvature, boundary.bevel)
    at, path = _begin(w, boundary, cut, last.last, live, near, one)
    kept, coupled = Solution(last, last.tip.x, path), True
    for number in range(1, MAX_ITERATIONS + 1):
        if number == COUPLED_ITERATIONS + 1:
            _forget_runaways(w, live, times(0.0, boundary.base.y))
            at, path = _begin(w, boundary, cut, last.last, live, near, 0.0 * one)
            coupled = False
        radial_weight = 0.5 if coupled else float(number % 2)
        tip_x = boundary.base.x + w.constants.length - at.shortening
        spans = find_spans(w, cut.channel.front, tip_x, near)
        near = spans.behind
        it = Iteration(boundary, cut, path, coupled, held, live, tip_x, spans, radial_weight, bend)
        step = _iterate(w, it, at)
        done, found, at = _conclude(w, it, at, step, number)
        kept = select(live, found, kept)
        live = live & opposite(done)
        if not some(live):
            break
    return kept, near


@inner
def _forget_runaways(w: Needles, live: bool, zero: Lateral) -> None:
    """Set compressions to 0 where the coupled iterations ran away."""
    for i in range(w.mesh.shape[0]):
        u = load(w.laterals, i, U)
        store(w.laterals, i, U, select(live & opposite(size(u) < math.inf), zero, u))
