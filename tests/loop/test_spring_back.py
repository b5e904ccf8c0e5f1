"""Insertions with a needle that springs back along its axis where it stops."""

import pytest

from flexneedle.results import Outcome
from flexneedle.types import X


@pytest.mark.parametrize("play", [0.0, 0.3, 0.8])
def test_the_tip_at_rest_ends_at_the_depth_of_the_target(plan, inserted, play):
    """In motion the tip passes the target by the play, and by no more: the depth is not approached from beyond."""
    done = inserted(3, phantom__structure__spring_back_mm=play)
    assert done.outcome is Outcome.DONE
    depths = [period.true_tip.x - plan.target[X] for period in done.periods]
    assert abs(depths[-1]) < 0.05
    assert max(depths) < play + 0.05
