"""A measurement has values of the right shape; whether they are finite is for the monitor to say."""

import math
import re

import numpy as np
import pytest

from flexneedle import Measurement
from flexneedle.errors import InputError

NAN, INF = math.nan, math.inf
UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        *(("direction", one, "must be two numbers") for one in ((0.1,), (0.1, 0.2, 0.3), 0.1, ("a", "b"))),
        *(("direction", one, "must be two numbers") for one in ((True, 0.0), (None, 0.0))),
        *(("points", one, "must each be three numbers") for one in ((1.0, 2.0, 3.0), ((1.0, 2.0),), None)),
        *(
            ("covariance", one, "must be 3 rows")
            for one in (1.0, (), (1.0, 1.0, 1.0), ((1.0, 0.0), (0.0, 1.0)))
        ),
        *(("covariance", (*UNIT[:2], one), "must be 3 rows") for one in ((0.0, 0.0), (0.0, 0.0, "1"))),
        ("direction_covariance", UNIT, "must be 2 rows"),
        ("covariance", ((1.0, 0.5, 0.0), (0.2, 1.0, 0.0), UNIT[2]), r"\[1\]\[0\], here 0.2, up to rounding"),
        ("direction_covariance", ((1e-6, 1e-7), (-1e-7, 1e-6)), r"\[1\]\[0\], here -1e-07, up to rounding"),
        ("covariance", (UNIT[0], (0.0, -1e-9, 0.0), (0.0, 0.0, NAN)), "must be at least 0, a variance"),
        ("covariance", ((NAN, 0.0, 0.0), (0.0, 1.0, 0.5), (0.0, 0.2, 1.0)), r"\[2\]\[1\], here 0.2, up to"),
    ],
)
def test_a_wrong_shape_is_refused_in_one_line(name, value, rule):
    with pytest.raises(InputError, match=rf"^{name}(\[.*)? = .*: must.*") as error:
        Measurement(0.1, 1.0, 2.0, **{name: value})
    assert re.search(rule, str(error.value))


def test_values_that_are_not_finite_are_left_to_the_monitor():
    found = Measurement(
        NAN, NAN, INF, -INF,
        direction=(NAN, INF),
        points=((NAN, INF, 0.0),),
        covariance=((NAN, 1.0, INF), (1.0, NAN, INF), (0.0, NAN, -INF)),
        direction_covariance=((INF, NAN), (0.5, NAN)),
    )  # fmt: skip
    assert math.isnan(found.direction[0])
    assert found.covariance[2][2] == -INF


def test_a_covariance_may_be_asymmetric_by_rounding_only():
    """By the rounding of single precision, of its largest entry."""
    third = float(np.float32(1 / 3))
    matrix = ((1.0, third, 0.0), (1 / 3, 1.0, 1e-8), (0.0, 0.0, 1.0))
    assert Measurement(0.1, 1.0, 2.0, covariance=matrix).covariance == matrix
    with pytest.raises(InputError, match="up to rounding"):
        Measurement(0.1, 1.0, 2.0, covariance=((1.0, 1 / 3, 0.0), (1 / 3 + 1e-4, 1.0, 0.0), UNIT[2]))


def test_arrays_and_lists_become_tuples_of_numbers():
    """So that measurements can be compared."""
    found = Measurement(
        0.1, 1.0, 2.0, 3.0,
        direction=np.array([0.1, 0.2]),
        points=np.array([[1.0, 2.0, 3.0]]),
        covariance=np.eye(3, dtype=int),
        direction_covariance=[[0, 0], [0, 0]],
    )  # fmt: skip
    zero = ((0.0, 0.0), (0.0, 0.0))
    assert found == Measurement(0.1, 1.0, 2.0, 3.0, None, (0.1, 0.2), ((1.0, 2.0, 3.0),), UNIT, zero)
    assert {type(value) for row in found.covariance for value in row} == {float}
