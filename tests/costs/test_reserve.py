"""Expected costs of normal values, and the reserve of the bevel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle import controls as controls_of
from flexneedle.costs import terms
from flexneedle.costs.normal import moments_above_zero
from flexneedle.costs.weighted_sum import Trajectories

STEPS, STEP = 40, 0.5
DEPTH = STEP * np.arange(1, STEPS + 1)


@given(st.floats(-3.0, 3.0), st.floats(0.01, 2.0))
def test_moments_above_zero_are_the_integrals(mean, sd):
    x = np.linspace(0.0, max(mean + 9.0 * sd, 0.0), 20001)
    density = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    for power, found in enumerate(moments_above_zero(np.array([mean]), np.array([sd])), 1):
        assert found[0] == pytest.approx(np.trapezoid(x**power * density, x), abs=1e-4 * sd)


def path_of(*rolls, angle=np.pi):
    """A path with rolls by an angle at these depths (mm)."""
    roll = np.zeros((1, STEPS))
    roll[0, np.searchsorted(DEPTH - STEP, rolls)] = angle
    tips = np.zeros((1, STEPS, 5))
    tips[0, :, 0] = DEPTH
    rows = controls_of(1, STEPS, db_x=STEP, roll=roll)
    return Trajectories(rows, tips, np.zeros((1, STEPS)), np.ones((1, STEPS), dtype=bool))


def reserve(path, begins, sds, price=1.0, *, any_angle=False):
    """Reserve of a needle that bends by 0.05, at one price."""
    return terms.lost_reserve(
        path, begins, sds, np.full(begins.shape, price), 0.05, 0.03, any_angle=any_angle
    )


@pytest.mark.parametrize("rolls", [(), (10.0,), (5.0, 12.0), (14.0,)])
@pytest.mark.parametrize("begin", [0.0, 8.0])
@pytest.mark.parametrize("price", [1.0, 0.25])
def test_the_reserve_is_what_correcting_a_random_miss_by_rolls_leaves(rolls, begin, price):
    """The reference draws misses, corrects each by the nearest end that any rolls below the depth can reach, and pays
    for the rest."""
    sd, draws = 0.3, np.random.default_rng(0).normal(0.0, 0.3, 200_000)
    sides = (-1.0) ** np.searchsorted(np.sort(rolls), DEPTH - STEP, side="right")
    below = begin <= DEPTH - STEP
    used, most = 0.05 * STEP * sides[below].sum(), 0.05 * STEP * below.sum()
    wanted = used - draws
    left = np.abs(wanted - np.clip(wanted, -most, most))
    expected = terms.charge_miss(price * left, 0.03).mean()
    found = reserve(path_of(*rolls), begins=np.array([begin]), sds=np.array([sd]), price=price)[0]
    assert found == pytest.approx(expected, rel=0.03, abs=2e-3)


def test_the_worst_depth_counts_and_what_is_known_costs_nothing():
    path, sds = path_of(10.0), np.array([0.3, 0.3])
    each = [reserve(path, begins=np.array([b]), sds=sds[:1])[0] for b in (0.0, 12.0)]
    assert each[0] < each[1]
    assert reserve(path, begins=np.array([0.0, 12.0]), sds=sds)[0] == max(each)
    assert reserve(path, begins=np.array([0.0, 12.0]), sds=0.0 * sds)[0] == pytest.approx(0.0, abs=1e-8)
    assert reserve(path, begins=np.zeros(0), sds=np.zeros(0))[0] == 0.0


def test_a_needle_that_turns_to_any_angle_has_one_bound_whichever_way_it_is_bent():
    """The same in all directions; straight, as much as a needle that bends to both sides."""
    begins, sds = np.array([0.0]), np.array([0.3])
    turned = [
        reserve(path_of(10.0, angle=angle), begins=begins, sds=sds, any_angle=True)[0]
        for angle in (2.0, -2.0)
    ]
    assert turned[0] == pytest.approx(turned[1], rel=1e-12)
    straight = path_of()
    assert reserve(straight, begins=begins, sds=sds, any_angle=True)[0] == pytest.approx(
        reserve(straight, begins=begins, sds=sds)[0], rel=1e-3
    )
