"""Where a limit is kept, in words."""

import pytest

from flexneedle.tracking.evaluation.distance import Distances, Stretch


def bins(rmse):
    """Stretches of 50 mm from 600 mm on."""
    return tuple(
        Stretch(600.0 + 50 * k, 650.0 + 50 * k, 625.0 + 50 * k, 9, 90, value, value, value, 0.1)
        for k, value in enumerate(rmse)
    )


@pytest.mark.parametrize(
    ("smallest", "exceeded", "told"),
    [
        (None, (), "nowhere"),
        (625.0, (), "everywhere measured"),
        (675.0, (), "from 675 mm"),
        (625.0, (725.0,), "up to 675 mm, not at 725 mm"),
        (675.0, (725.0, 775.0), "from 675 mm, not at 725, 775 mm"),
    ],
)
def test_the_nearest_bin_is_not_where_a_limit_begins(smallest, exceeded, told):
    assert Distances(50.0, 0.5, smallest, exceeded, bins([0.4] * 4)).told == told


def test_without_a_limit_none_is_kept():
    assert Distances(50.0, None, None, (), bins([0.4])).told == "no limit"
