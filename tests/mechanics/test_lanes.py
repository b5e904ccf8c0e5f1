"""Primitives of lanes: in each lane the same as plain Python on its number."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from flexneedle.mechanics import lanes as ln
from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.lateral import rotate, stretch, times
from flexneedle.mechanics.work import workspace


class Both(NamedTuple):
    """A record of a number and a lateral."""

    number: float
    lateral: complex


TABLE = np.arange(9.0 * ln.ROW).reshape(9, ln.ROW) ** 2
A = [0.5, -0.0, 0.0, math.inf, -math.inf, math.nan, 3.0, -7.25, 1e-300, 2.0, -1.0]
B = [1.0, -1.0, 0.3, 2.0, -3.0, 0.0, 3.0, 6.9, -0.5, 2.0, 1.5 * math.pi]
NEEDLES = np.array([A, B, np.linspace(-1.0, 2.0, 11), np.linspace(3.0, -4.0, 11)]).T.copy()


def compute(a, b, z, table):
    """Return results of all primitives: numbers, and laterals."""
    positive, near = a > 0.0, (b >= -1.0) & (b < 1.0)
    one, other = Both(a, z), Both(b, times(-1.0, z))
    chosen = ln.select(near, one, other)
    row = ln.row_of(table, ln.whole(ln.magnitude(b)) + 1.0)
    sum_ = a + b
    sum_ -= 2.0
    numbers = (
        sum_, 3 * b - a, a / (b + 9.0), -a, b * b, ln.root(b * b + 1.0), ln.magnitude(a), ln.whole(b),
        ln.least(a, b), ln.most(a, b), ln.least(b, a), ln.most(b, a), ln.least(1.0, b),
        ln.select(positive, a, b), ln.select(positive | near, 1.0, b), ln.select(ln.opposite(near), a, 0.0),
        ln.select(a == b, 1.0, 0.0), ln.select(a != b, 1.0, 0.0), ln.select(a <= b, 1.0, 0.0),
        ln.select(ln.select(positive, near, True), 1.0, b), chosen.number, row[0], row[3], row[7],
    )  # fmt: skip
    across = (
        ln.pair(b, 2.0), z + ln.pair(b, b), z - ln.pair(b, b), times(b, z), chosen.lateral, rotate(b, z),
        rotate(1.5 * math.pi, z), stretch(ln.pair(0.6, 0.8), z, b, 2.0),
    )  # fmt: skip
    return numbers, across


compiled = inner(compute)


@kernel
def run(needles, who, table, reals, laterals, numbers, across):
    """Fill numbers (N, k) and laterals (N, k, 2) of needles `who`, group by group; count those with any a > 2."""
    groups = 0
    for j in range(0, who.size, ln.lanes_of(reals)):
        ln.fill(reals, 0, 0, needles, who, j, 0)
        ln.fill(reals, 0, 1, needles, who, j, 1)
        ln.fill(laterals, 0, 0, needles, who, j, 2)
        a, b = ln.load_all(reals, 0, 2)
        ln.store(reals, 0, 1, a + 0.0)
        groups += ln.some(ln.load(reals, 0, 1) > 2.0)
        found, lateral = compiled(a, b, ln.load(laterals, 0, 0), table)
        for k in range(len(found)):
            ln.spill(found[k], numbers, j, k)
        for k in range(len(lateral)):
            ln.spill(lateral[k], across, j, k, 0)
    return groups


def test_each_lane_is_plain_python_on_its_number():
    """NaN, infinities and zeros of either sign included, to the last bit; a turn to rounding."""
    who = np.arange(2 * ln.WIDTH)[::-1] * 3 % len(NEEDLES)
    space = workspace(1, 1, 2)
    numbers, across = np.full((len(who), 24), -99.0), np.full((len(who), 8, 2), -99.0)
    groups = run(NEEDLES, who, TABLE, space.reals, space.laterals, numbers, across)
    with np.errstate(invalid="ignore"):
        expected = [compute(a, b, complex(y, z), TABLE) for a, b, y, z in NEEDLES[who]]
    plain = np.array([found for found, _ in expected], dtype=float)
    np.testing.assert_array_equal(numbers, plain)
    known = ~np.isnan(plain)
    np.testing.assert_array_equal(np.signbit(numbers)[known], np.signbit(plain)[known])
    lateral = np.array([found for _, found in expected])
    np.testing.assert_allclose(across[..., 0] + 1j * across[..., 1], lateral, rtol=1e-15, atol=1e-15)
    assert groups == sum(any(NEEDLES[k, 0] > 2.0 for k in group) for group in who.reshape(2, -1))


@pytest.mark.parametrize("axes", [1, 2])
def test_memory_of_lanes_begins_at_lines_of_the_cache(axes):
    spaces = [workspace(nodes, 3, axes) for nodes in range(1, 80)]
    assert all(array.ctypes.data % 64 == 0 and array.flags.c_contiguous for one in spaces for array in one)
