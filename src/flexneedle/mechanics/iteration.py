"""An iteration of a solve: its inputs, its nodes, and the fraction of its step that may be taken.

Most nodes are contacts of old tissue well behind the tip, cut before the running step and with their full weight: they
take a short loop in both sweeps. The others, at the guide, at measured points and near the tip, take a longer one.
There a node ahead of the tip of its needle has no length before it and no stiffness, and so no effect: needles of
different depths go together.
"""

import math
from typing import NamedTuple

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.contact import contact_weight
from flexneedle.mechanics.lanes import least, load, root, select, some
from flexneedle.mechanics.lateral import Lateral, dot, size, square
from flexneedle.mechanics.needle import Boundary, Cut, Held, Path
from flexneedle.mechanics.work import Needles, X


class Spans(NamedTuple):
    """Numbers of nodes: those from `first` to `last` − 1 take the short loop; `behind` are behind a tip."""

    first: int
    last: int
    behind: int


class Iteration(NamedTuple):
    """Inputs of both sweeps."""

    boundary: Boundary
    cut: Cut
    path: Path
    coupled: bool  # whether shortening and end of the path are unknown
    held: Held  # conditions of the tip
    live: bool  # needles that still search
    tip_x: float
    spans: Spans
    radial_weight: float  # of `one_stiffness`
    bend: Lateral  # curvature of the free needle (1/mm)


@inner
def count_before(w: Needles, x: float, near: int) -> int:
    """Return the number of nodes before x (mm) in any lane; the search begins at `near` nodes."""
    total = w.mesh.shape[0]
    count = min(near, total)
    while count < total and some(load(w.mesh, count, X) < x):
        count += 1
    while count > 0 and not some(load(w.mesh, count - 1, X) < x):
        count -= 1
    return count


@inner
def find_spans(w: Needles, front: float, tip_x: float, near: int) -> Spans:
    """Return the spans of needles with these tips (mm), with about `near` nodes behind them."""
    behind = count_before(w, tip_x, near)
    first, last = min(w.first, behind), behind
    while last > first and some(
        (load(w.mesh, last - 1, X) > front) | (contact_weight(w, last - 1, tip_x) < 1.0)
    ):
        last -= 1
    return Spans(first, last, behind)


@inner
def count_behind(w: Needles, spans: Spans, tip_x: float) -> float:
    """Return the number of nodes behind each tip."""
    number = float(spans.last - spans.first) + 0.0 * tip_x
    for i in range(spans.first):
        number += select(load(w.mesh, i, X) < tip_x, 1.0, 0.0)
    for i in range(spans.last, spans.behind):
        number += select(load(w.mesh, i, X) < tip_x, 1.0, 0.0)
    return select(tip_x < math.inf, number, 0.0)


@inner
def judge(height: float, sharpness: float, turning: float, u: Lateral, new_u: Lateral) -> tuple[float, float]:
    """Return (error, fraction): distance left after this step (mm), and fraction of the step that may be taken.

    Newton's method converges quadratically, so about |Δu|² W‴/2W″ is left, and in space the part of Δu for which the
    stiffness is not exact; a step may use half the stretch that is left.
    """
    change = size(new_u - u)
    error = least(change, change * (change * sharpness + turning))
    limit = 0.5 * (height + size(u))
    over = (square(new_u) > limit * limit) & (sharpness < math.inf)
    fraction = 1.0 + 0.0 * change
    if some(over):
        along, squared = dot(u, new_u - u), select(over, change * change, 1.0)
        reach = root(select(over, along * along + squared * (limit * limit - square(u)), 1.0)) - along
        error, fraction = select(over, change, error), select(over, reach / squared, 1.0)
    return error, fraction
