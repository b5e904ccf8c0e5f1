"""Which readings are believed: each kind of bad one, and both sides of each limit."""

import math

import pytest

from flexneedle.ports import Sample
from flexneedle.tracking import OK, judge

NOW, STALE, LIMIT = 10.0, 0.125, 2.0
PREDICTED = (30.0, 1.0)


def verdict(sample, now=NOW):
    return judge(sample, PREDICTED, now, STALE, LIMIT)


def test_a_fresh_reading_near_the_prediction_is_believed():
    assert verdict(Sample(NOW, 30.1, 0.9)) == OK == "ok"


@pytest.mark.parametrize(
    ("sample", "why"),
    [
        (None, "missing: no reading"),
        (Sample(NOW, None, 1.0), "missing: tracker sees no tip"),
        (Sample(NOW, 30.0, None), "missing: tracker sees no tip"),
        (Sample(NOW, None, None), "missing: tracker sees no tip"),
        (Sample(NOW, math.nan, 1.0), "not a number"),
        (Sample(NOW, 30.0, math.nan), "not a number"),
        (Sample(math.nan, 30.0, 1.0), "not a number"),
        (Sample(NOW, math.inf, 1.0), "not a number"),
        (Sample(NOW, 30.0, -math.inf), "not a number"),
        (Sample(-math.inf, 30.0, 1.0), "not a number"),
        (Sample(NOW - 0.5, 30.0, 1.0), "stale: 0.500 s old, limit 0.125 s"),
        (Sample(NOW + 0.5, 30.0, 1.0), "stale: dated 0.500 s ahead"),
        (Sample(NOW, 33.0, 5.0), "innovation 5.00 mm, limit 2 mm"),
    ],
)
def test_each_bad_reading_is_named(sample, why):
    assert verdict(sample) == why


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_age_at_the_limit_is_believed_and_beyond_it_not(side):
    assert verdict(Sample(NOW - side * STALE, 30.0, 1.0)) == OK
    assert verdict(Sample(NOW - side * (STALE + 1e-6), 30.0, 1.0)).startswith("stale")


@pytest.mark.parametrize("way", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, 0.8)])
def test_innovation_is_the_distance_and_its_limit_is_still_believed(way):
    def at(distance):
        return Sample(NOW, PREDICTED[0] + distance * way[0], PREDICTED[1] + distance * way[1])

    assert verdict(at(LIMIT - 1e-12)) == OK
    assert verdict(at(LIMIT + 1e-6)).startswith("innovation")


def test_innovation_exactly_at_the_limit_is_believed():
    assert verdict(Sample(NOW, 32.0, 1.0)) == OK


def test_what_is_worst_is_said_first():
    """A reading that is no number is neither stale nor far; an old one isn't compared with today's tip."""
    assert verdict(Sample(NOW - 9.0, math.nan, 99.0)) == "not a number"
    assert verdict(Sample(NOW - 9.0, 99.0, 99.0)).startswith("stale")
