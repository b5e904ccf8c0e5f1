"""The guide's lever, and the bevel's reserve behind it."""

import numpy as np
import pytest

from adaptive import QUICK, decided, estimate_of
from flexneedle.control.controllers import adaptive_mpc
from flexneedle.control.path import KNOTS
from flexneedle.control.reserve import Lever, reserve_of_bevel
from tasks import task_of

LEVER = Lever(10.0 + 20.0 * np.append(0.0, KNOTS), np.array([0.1, -0.3, 0.2, 0.05]))


@pytest.mark.parametrize(
    ("least", "depth"),
    [(1.0, 10.0), (0.6, 10.0 + 2.0 * 0.5), (0.25, 16.0), (0.15, 22.0 - 6.0 * 0.5), (0.0, 30.0)],
)
def test_the_lever_is_lost_where_the_corrections_left_have_too_little_effect(least, depth):
    """Effects of later knots add up whatever their signs; linear in between. By hand: 0.65, 0.55, 0.25, 0.05, 0."""
    assert LEVER.lost_from(least) == pytest.approx(depth)


def test_the_lever_is_the_motion_of_the_end_by_a_correction(quick_plan, along):
    """Four corrections at once, each at its knot, move the end by the sum of the effects."""
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    memory = decided(quick_plan, estimate)[1]
    task = task_of(estimate.nominal, quick_plan)
    ahead = adaptive_mpc.Ahead.of(task, estimate.state, memory.path)
    z = ahead.current
    leaning = z.copy()
    leaning[: KNOTS.size] += 0.05
    ends = adaptive_mpc.rollout_as_measured(estimate, ahead.controls(np.array([z, leaning]))[0])
    past = adaptive_mpc.past_target(ends.tips, quick_plan.target)
    assert (past[1] - past[0]).real == pytest.approx(0.05 * memory.lever.effect.sum(), rel=0.05)


def test_the_reserve_has_depths_by_the_lever_and_knows_more_the_deeper(quick_plan, along):
    estimate = estimate_of(along(quick_plan, 40), QUICK)
    memory = decided(quick_plan, estimate)[1]
    ahead = adaptive_mpc.Ahead.of(task_of(estimate.nominal, quick_plan), estimate.state, memory.path)
    ends = adaptive_mpc.find_ends(task_of(estimate.nominal, quick_plan), estimate, ahead)
    bend = adaptive_mpc.bend_of(ahead, ends)
    lever = Lever(
        ahead.depth[0] + ahead.left * np.array([0.0, 0.25, 0.5, 0.75, 1.0]), np.array([0.4, 0.4, 0.1, 0.1])
    )

    def found(least, margin):
        return reserve_of_bevel(
            estimate, ahead, memory.outlook, lever, bend, quick_plan.target, least=least, margin=margin
        )

    some = found(0.2, 2.0)
    shares = (
        some.begins - ahead.depth[0]
    ) / ahead.left  # where the effects left are 0.8, 0.4 and 0.2, and beyond
    np.testing.assert_allclose(shares, [0.125, 0.375, 0.5, 0.5 + 0.5 / 3.0, 0.5 + 1.0 / 3.0])
    np.testing.assert_array_equal(some.prices, [0.25, 0.5, 1.0, 1.0, 1.0])
    assert (np.diff(some.sds) <= 0.0).all()
    assert some.sds[0] > some.sds[-1] > 0.0
    np.testing.assert_allclose(some.sds, 2.0 * found(0.2, 1.0).sds)
    _, kept, _, rolled, _ = ends
    assert 2.0 * some.reach * ahead.left == pytest.approx(abs(kept - rolled))
    assert (found(1e9, 1.0).begins[:3] == ahead.depth[0]).all()
    np.testing.assert_allclose(found(0.0, 1.0).begins, ahead.depth[-1])
