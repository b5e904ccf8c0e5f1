"""Steps of an insertion: move, solve, cut (docs/theory.md section 6), of needles side by side."""

import math

from flexneedle.mechanics.compile import inner, shared
from flexneedle.mechanics.contact import contact_rest
from flexneedle.mechanics.iteration import count_before
from flexneedle.mechanics.lanes import least, load, most, select, some, store, whole
from flexneedle.mechanics.lateral import lateral, rotate, times
from flexneedle.mechanics.needle import Boundary, Cut, CutChannel, Equilibrium, Held, NeedleState, NodePose
from flexneedle.mechanics.solve import Solution, solve
from flexneedle.mechanics.spring import spring_rest
from flexneedle.mechanics.work import CONTACT, GUIDE, KIND, REST, Columns, Needles, X
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

_SAME_PLACE = 1e-3  # of a part: a tip this near the end of a part is there


@inner
def _move_boundary(boundary: Boundary, command: Columns, share: float, roll: float) -> Boundary:
    """Return the boundary after a share of a command; `roll` (rad) includes its spin."""
    base, like = boundary.base, boundary.guide
    bevel = boundary.bevel
    turning = roll != 0.0
    if some(turning):
        bevel = select(turning, rotate(roll, bevel), bevel)
    return Boundary(
        NodePose(
            base.x + share * load(command, 0, DB_X),
            base.y + times(share, lateral(like, load(command, 0, DB_Y), load(command, 0, DB_Z))),
            base.slope + times(share, lateral(like, load(command, 0, DB_THETA), load(command, 0, DB_PSI))),
        ),
        boundary.guide + times(share, lateral(like, load(command, 0, DG_Y), load(command, 0, DG_Z))),
        bevel,
        boundary.load,
    )


@shared
def settle_needles(
    w: Needles, needle: NeedleState, held: Held, live: bool, near: int
) -> tuple[NeedleState, int]:
    """Solve with the present base and guide, and lay the cut; what of the tip is `held` is essential.

    Arrays are changed in place, as in `solve`, which explains `near`. Out of the skin the channel is closed.
    """
    boundary, cut = needle.boundary, needle.cut
    if w.first > 0:
        at_guide = live & (load(w.mesh, 0, KIND) == GUIDE)
        store(w.laterals, 0, REST, select(at_guide, boundary.guide, load(w.laterals, 0, REST)))
    solution, near = solve(w, boundary, cut, needle.solution, held, live, near)
    tip = solution.found.tip
    _lay_cut(w, cut, solution, live, near)
    fixed, slope = spring_rest(w, boundary.bevel, cut, solution.path, tip.x)
    front = select(tip.x > 0.0, most(cut.channel.front, tip.x), 0.0)
    settled = NeedleState(boundary, cut, CutChannel(front, fixed + times(1.0 - slope, tip.y)), solution.found)
    return select(live, settled, needle), near


@inner
def _lay_cut(w: Needles, cut: Cut, solution: Solution, live: bool, near: int) -> None:
    """Set the rest positions of the contacts on the path of the tip, eq. 9."""
    solved_x, y = solution.solved_x, solution.found.tip.y
    for i in range(count_before(w, solved_x, near) - 1, -1, -1):
        x = load(w.mesh, i, X)
        if not some(x > cut.channel.front):
            break
        fixed, share = contact_rest(cut, solution.path, solved_x, x)
        fresh = live & (x > cut.channel.front) & (x < solved_x) & (load(w.mesh, i, KIND) == CONTACT)
        rest = select(fresh, fixed + times(share, y), load(w.laterals, i, REST))
        store(w.laterals, i, REST, rest)


@inner
def _end_of_part(w: Needles, needle: NeedleState, advance: float, done: float) -> float:
    """Return the share of a step at which its next part ends, after the share `done`.

    Down to the zone below the skin parts end where the tip is expected at a multiple of the part's length: the state
    remains a continuous function of the command.
    """
    x, part = needle.solution.tip.x, w.constants.part
    parted = (advance > 0.0) & (x < w.constants.zone) & (x + (1.0 - done) * advance > 0.0)
    if not some(parted):
        return 1.0 + 0.0 * advance
    goal = most(0.0, part * (whole(x / part + _SAME_PLACE) + 1.0))
    end = done + (goal - x) / select(parted, advance, 1.0)
    return select(parted, least(1.0, end), 1.0)


@inner
def advance_needles(w: Needles, needle: NeedleState, command: Columns, near: int) -> tuple[NeedleState, int]:
    """Return the needles after one step, in its parts, and about the number of nodes behind their tips."""
    advance, spin = load(command, 0, DB_X), load(command, 0, SPIN)
    roll, done = load(command, 0, ROLL), 0.0 * advance
    residual, converged = done, 1.0 + done
    live = done < 1.0
    unknown = times(math.nan, needle.boundary.guide)
    while some(live):
        end = _end_of_part(w, needle, advance, done)
        spun = (end - done) * spin
        boundary = _move_boundary(needle.boundary, command, end - done, roll + spun)
        cut = Cut(needle.solution.tip, needle.channel, spun)
        moved = select(live, NeedleState(boundary, cut, needle.channel, needle.solution), needle)
        needle, near = settle_needles(w, moved, Held(unknown, unknown), live, near)
        residual = select(live, most(residual, needle.solution.residual), residual)
        converged = select(live, converged * needle.solution.converged, converged)
        roll = 0.0 * roll
        done = select(live, end, done)
        live = live & (done < 1.0)
    last = needle.solution
    solution = Equilibrium(last.tip, last.last, last.loads, last.behind, last.iterations, residual, converged)
    return NeedleState(needle.boundary, needle.cut, needle.channel, solution), near
