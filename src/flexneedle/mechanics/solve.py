"""Equilibrium of needles: iterations of two sweeps, a line search, and the needle in its guide.

Needles side by side take their iterations together. A needle that has found its equilibrium is no longer `live`: its
results are kept as they are, whatever its companions still search.
"""

import math
from typing import NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lanes import least, load, magnitude, most, opposite, select, some, store
from flexneedle.mechanics.lateral import Lateral, direction, dot, size, stretch, times, y_of
from flexneedle.mechanics.law import response
from flexneedle.mechanics.needle import (
    Bearing,
    Boundary,
    Cut,
    Equilibrium,
    Iterate,
    Loads,
    NodePose,
    Path,
)
from flexneedle.mechanics.spring import spring_law, spring_rest
from flexneedle.mechanics.sweep import Spans, find_spans, solve_tip, sweep_back, sweep_out
from flexneedle.mechanics.work import (
    B11,
    CELLS,
    CHANGED,
    CONTACT,
    FORCE,
    GUIDE,
    KIND,
    LAW,
    PER_REACH,
    STIFFNESS,
    K,
    Needles,
    U,
    X,
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


class _Iteration(NamedTuple):
    tip: NodePose
    next: Iterate
    loads: Loads
    left: float
    agrees: bool  # whether the needle bears on its guide as assumed


@inner
def _overshoot(
    w: Needles, front: float, spring: Lateral, count: int, tip_x: float, new_spring: Lateral, t: float
) -> float:
    """Return the slope of the energy along an iteration's step at `t`, less the beam's part of 1 − t.

    The beam's part is never negative.
    """
    change = new_spring - spring
    here = spring + times(t, change)
    secant, tangent, _, _ = spring_law(w, front, tip_x, spring)
    linear = times(secant, spring) + stretch(direction(spring), change, tangent, secant)
    slope = dot(times(spring_law(w, front, tip_x, here)[0], here) - linear, change)
    for i in range(count):
        u = load(w.laterals, i, U)
        change = load(w.laterals, i, CHANGED) - u
        here = u + times(t, change)
        law = response(w.laws, load(w.mesh, i, LAW), size(here) * load(w.mesh, i, CELLS))
        grown = least(1.0, most(0.0, (tip_x - load(w.mesh, i, X)) * load(w.mesh, i, PER_REACH)))
        scale = load(w.mesh, i, STIFFNESS) * grown
        linear = load(w.laterals, i, FORCE) - times(load(w.reals, i, K), change)
        part = dot(linear + times(scale * law.secant, here), change)
        slope += select(load(w.mesh, i, KIND) == CONTACT, part, 0.0)
    return slope


@inner
def _line_search(
    w: Needles, front: float, spring: Lateral, count: int, tip_x: float, new_spring: Lateral, wanted: bool
) -> float:
    """Return the fraction of an iteration's step at which the convex energy still falls: no cycle can form."""
    low, high = 0.0 * tip_x, 1.0 + 0.0 * tip_x
    whole = _overshoot(w, front, spring, count, tip_x, new_spring, high) <= 0.0
    if not some(wanted & opposite(whole)):
        return high
    for _ in range(20):
        middle = 0.5 * (low + high)
        beyond = _overshoot(w, front, spring, count, tip_x, new_spring, middle) > 0.0
        low, high = select(beyond, low, middle), select(beyond, middle, high)
    return select(whole, 1.0, select(low > 0.0, low, high))


@inner
def _guess(
    w: Needles, boundary: Boundary, cut: Cut, shortening: float, live: bool, near: int
) -> tuple[Lateral, Lateral]:
    """Return a first guess of the y of the tip, on its line, and of the tip spring; contacts ahead are unstrained."""
    tip_x = boundary.base.x + w.constants.length - shortening
    y = cut.tip.y + times(tip_x - cut.tip.x, cut.tip.slope)
    front, ahead = cut.channel.front, tip_x + _AHEAD_MM
    top, total = near, w.mesh.shape[0]
    while top < total and some(load(w.mesh, top, X) < ahead):
        top += 1
    for i in range(top - 1, -1, -1):
        x = load(w.mesh, i, X)
        if not some(x >= front):
            break
        unstrained = live & (x >= front) & (x < ahead)
        store(w.laterals, i, U, select(unstrained, times(0.0, y), load(w.laterals, i, U)))
    fixed, slope = spring_rest(w, boundary.bevel, cut, Path(1.0 + 0.0 * tip_x, y), tip_x)
    return y, times(slope, y) - fixed


@inner
def _bearing(
    w: Needles, boundary: Boundary, last: Bearing, behind: bool, settled: float
) -> tuple[bool, Bearing]:
    """Return whether the needle bears on its guide as assumed, to `settled` (mm), and the next assumption.

    A wall only pushes, and between the walls nothing does: one inequality of a convex problem, so that few changes do.
    In space the wall is a circle, which pushes towards its middle: the needle bears on the point nearest to where it
    would be without the wall, as far as its displacement per force is known from the last change.
    """
    clearance = w.constants.clearance
    loose = behind & (load(w.mesh, 0, KIND) == GUIDE) & (clearance > 0.0)
    y, force, bears = (
        load(w.laterals, 0, CHANGED) - boundary.guide,
        load(w.laterals, 0, FORCE),
        size(last.wall) > 0.0,
    )
    give, moved = last.give, size(y - last.y)
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
def _iterate(
    w: Needles,
    boundary: Boundary,
    cut: Cut,
    at: Iterate,
    path: Path,
    coupled: bool,
    held: Lateral,
    live: bool,
    spans: Spans,
    tip_x: float,
    radial_weight: float,
) -> _Iteration:
    """Carry out one iteration, in place.

    Without coupling it first searches the position in the guide with the least quadratic energy: a line search towards
    that position descends, so that the needle cannot alternate between the walls.
    """
    trials, settled, guide = 1, w.constants.slide, at.guide
    if not coupled:
        unknown = times(math.nan, boundary.guide)
        trials, settled = BEARING_TRIALS, 0.1 * w.constants.tolerance
        guide = Bearing(guide.wall, guide.give, unknown, unknown)
    wall = guide.wall
    left, follow = sweep_out(w, boundary, cut, wall, path, tip_x, spans, radial_weight)
    tip = solve_tip(w, boundary, cut, at.spring, path, tip_x, held, left, follow)
    base = sweep_back(w, boundary, live, tip_x, tip, spans)
    loose = w.constants.clearance > 0.0
    agrees = opposite(loose)
    if some(loose):
        behind = load(w.mesh, 0, X) < tip_x
        agrees, guide = _bearing(w, boundary, guide, behind, settled)
        trial = 1
        while trial < trials and some(live & opposite(agrees)):
            wall = select(agrees, wall, guide.wall)
            left, follow = sweep_out(w, boundary, cut, wall, path, tip_x, spans, radial_weight)
            tip = solve_tip(w, boundary, cut, at.spring, path, tip_x, held, left, follow)
            base = sweep_back(w, boundary, live, tip_x, tip, spans)
            agreed, then = _bearing(w, boundary, guide, behind, settled)
            guide, agrees = select(agrees, guide, then), agrees | agreed
            trial += 1
    fraction = base.fraction
    if not coupled:
        searching = base.left > w.constants.tolerance
        if some(live & searching):
            found = _line_search(
                w, cut.channel.front, at.spring, spans.behind, tip_x, tip.spring, live & searching
            )
            fraction = select(searching, least(fraction, found), fraction)
    _accept(w, spans.behind, tip_x, live, fraction)
    full = fraction == 1.0
    spring = select(full, tip.spring, at.spring + times(fraction, tip.spring - at.spring))
    return _Iteration(
        NodePose(tip_x, tip.y, tip.slope),
        Iterate(spring, base.shortening, guide),
        Loads(tip.force, tip.reaction, base.shear, base.moment),
        select(full, base.left, math.inf),
        agrees,
    )


@inner
def _accept(w: Needles, count: int, tip_x: float, live: bool, fraction: float) -> None:
    """Take the step, or a fraction of it, of the needles that are still searching."""
    if some(live & (fraction != 1.0)):
        for i in range(count):
            u, new_u = load(w.laterals, i, U), load(w.laterals, i, CHANGED)
            part = select(fraction == 1.0, new_u, u + times(fraction, new_u - u))
            store(w.laterals, i, CHANGED, part)
    for i in range(count):
        contact = live & (load(w.mesh, i, X) < tip_x) & (load(w.mesh, i, KIND) == CONTACT)
        store(w.laterals, i, U, select(contact, load(w.laterals, i, CHANGED), load(w.laterals, i, U)))


@inner
def solve(
    w: Needles, boundary: Boundary, cut: Cut, last: Equilibrium, held: Lateral, live: bool, near: int
) -> tuple[Solution, int]:
    """Find the equilibrium of the `live` needles; a `held` tip y (mm, NaN if free) is an essential condition.

    The shortening and the end of the path being cut are found with it. Where that does not converge, both are taken
    from the start of the step: the remaining problem is the minimum of a convex energy, found with a line search.

    Rest positions and compressions are updated in place. `near`: about the number of nodes behind the tips; returned
    for the next solve.
    """
    y, spring = _guess(w, boundary, cut, last.last.shortening, live, near)
    unknown = times(math.nan, y)
    before = Bearing(last.last.guide.wall, last.last.guide.give, unknown, unknown)
    at = Iterate(spring, last.last.shortening, before)
    one = 1.0 + 0.0 * w.constants.length  # also of a needle without numbers
    kept = Solution(last, last.tip.x, Path(one, y))
    path, coupled = Path(one, y), True
    for iteration in range(1, MAX_ITERATIONS + 1):
        if iteration == COUPLED_ITERATIONS + 1:
            _forget_runaways(w, live, times(0.0, boundary.base.y))
            y, spring = _guess(w, boundary, cut, last.last.shortening, live, near)
            at = Iterate(spring, last.last.shortening, before)
            path, coupled = Path(0.0 * one, y), False
        radial_weight = 0.5 if coupled else float(iteration % 2)
        tip_x = boundary.base.x + w.constants.length - at.shortening
        spans = find_spans(w, cut.channel.front, tip_x, near)
        near = spans.behind
        step = _iterate(w, boundary, cut, at, path, coupled, held, live, spans, tip_x, radial_weight)
        new = step.next
        slide = at.shortening - new.shortening if coupled else 0.0 * tip_x
        found = (step.left <= w.constants.tolerance) & (magnitude(slide) <= w.constants.slide)
        done = found & step.agrees
        on = times(slide, select(y_of(held) == y_of(held), times(0.0, step.tip.slope), step.tip.slope))
        tip = NodePose(tip_x + slide, step.tip.y + on, step.tip.slope)
        finite = (size(tip.y) < math.inf) & (magnitude(tip.x) < math.inf)
        shortening = new.shortening if coupled else at.shortening
        state = Iterate(new.spring, select(done, new.shortening, shortening), new.guide)
        here = Solution(
            Equilibrium(
                tip,
                state,
                step.loads,
                _count_behind(w, spans, tip_x),
                float(iteration) * one,
                most(step.left, magnitude(slide)),
                select(done & finite, one, 0.0 * one),
            ),
            tip_x,
            path,
        )
        kept = select(live, here, kept)
        live = live & opposite(done)
        if not some(live):
            break
        guide = new.guide
        if coupled and some(w.constants.clearance > 0.0):
            # On the circle the needle moves on from a solution: before it, the displacement per force is not known.
            early = opposite(found) & (size(guide.wall) > 0.0) & (size(at.guide.wall) > 0.0)
            guide = select(early, at.guide, guide)
        at = Iterate(new.spring, shortening, guide)
    return kept, near


@inner
def _forget_runaways(w: Needles, live: bool, zero: Lateral) -> None:
    """Set compressions to 0 where the coupled iterations ran away."""
    for i in range(w.mesh.shape[0]):
        u = load(w.laterals, i, U)
        store(w.laterals, i, U, select(live & opposite(size(u) < math.inf), zero, u))


@inner
def _count_behind(w: Needles, spans: Spans, tip_x: float) -> float:
    """Return the number of nodes behind each tip."""
    number = float(spans.last - spans.first) + 0.0 * tip_x
    for i in range(spans.first):
        number += select(load(w.mesh, i, X) < tip_x, 1.0, 0.0)
    for i in range(spans.last, spans.behind):
        number += select(load(w.mesh, i, X) < tip_x, 1.0, 0.0)
    return select(tip_x < math.inf, number, 0.0)
