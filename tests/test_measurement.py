"""A measurement has values of the right shape; whether they are finite is for the monitor to say."""

import math

import numpy as np
import pytest

from flexneedle import Measurement
from flexneedle.errors import InputError

NAN, INF = math.nan, math.inf
UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SLOPES = "must be two numbers, dy/dx and dz/dx in rad"
POINTS = "must each be three numbers, x, y, z in mm"
SIZE_3, SIZE_2 = "must be 3 rows of 3 numbers", "must be 2 rows of 2 numbers"


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"direction": (0.1,)}, f"direction = (0.1,): {SLOPES}"),
        ({"direction": (0.1, 0.2, 0.3)}, f"direction = (0.1, 0.2, 0.3): {SLOPES}"),
        ({"direction": 0.1}, f"direction = 0.1: {SLOPES}"),
        ({"direction": ("a", "b")}, f"direction = ('a', 'b'): {SLOPES}"),
        ({"direction": (True, 0.0)}, f"direction = (True, 0.0): {SLOPES}"),
        ({"direction": (None, 0.0)}, f"direction = (None, 0.0): {SLOPES}"),
        ({"points": (1.0, 2.0, 3.0)}, f"points = (1.0, 2.0, 3.0): {POINTS}"),
        ({"points": ((1.0, 2.0),)}, f"points = ((1.0, 2.0),): {POINTS}"),
        ({"points": None}, f"points = None: {POINTS}"),
        ({"covariance": 1.0}, f"covariance = 1.0: {SIZE_3}"),
        ({"covariance": ()}, f"covariance = (): {SIZE_3}"),
        ({"covariance": (1.0, 1.0, 1.0)}, f"covariance = (1.0, 1.0, 1.0): {SIZE_3}"),
        ({"covariance": ((1.0, 0.0), (0.0, 1.0))}, f"covariance = ((1.0, 0.0), (0.0, 1.0)): {SIZE_3}"),
        ({"covariance": (*UNIT[:2], (0.0, 0.0))}, f": {SIZE_3}"),
        ({"covariance": (*UNIT[:2], (0.0, 0.0, "1"))}, f": {SIZE_3}"),
        ({"direction_covariance": UNIT}, f": {SIZE_2}"),
        (
            {"covariance": ((1.0, 0.5, 0.0), (0.2, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "covariance[0][1] = 0.5: must equal covariance[1][0], here 0.2, up to rounding",
        ),
        (
            {"direction_covariance": ((1e-6, 1e-7), (-1e-7, 1e-6))},
            "direction_covariance[0][1] = 1e-07: must equal direction_covariance[1][0], here -1e-07, up to rounding",
        ),
        (
            {"covariance": ((1.0, 0.0, 0.0), (0.0, -1e-9, 0.0), (0.0, 0.0, NAN))},
            "covariance[1][1] = -1e-09: must be at least 0, a variance",
        ),
        (
            {"covariance": ((NAN, 0.0, 0.0), (0.0, 1.0, 0.5), (0.0, 0.2, 1.0))},
            "covariance[1][2] = 0.5: must equal covariance[2][1], here 0.2, up to rounding",
        ),
    ],
)
def test_a_wrong_shape_is_refused_in_one_line(values, line):
    with pytest.raises(InputError) as error:
        Measurement(0.1, 1.0, 2.0, **values)
    message = str(error.value)
    assert message.endswith(line) if line.startswith(":") else message == line
    assert "\n" not in message


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
    """By that of single precision, of its largest entry."""
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
