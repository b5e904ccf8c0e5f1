"""What a decision must be: five plain numbers, a miss that is predicted or not, a rest that ends."""

import math

import numpy as np
import pytest

from flexneedle.control.interface import Decision
from flexneedle.errors import InputError


@pytest.mark.parametrize("kind", [list, np.array])
def test_a_command_of_any_sequence_becomes_plain_numbers(kind):
    command = Decision(kind([1.0, 0.0, 0.0, 0.5, -1.0]), "").command
    assert command == (1.0, 0.0, 0.0, 0.5, -1)
    assert [type(value) for value in command] == [float] * 4 + [int]


@pytest.mark.parametrize(
    ("command", "rule"),
    [
        ((1.0, 0.0), "must have 5 numbers"),
        (None, "must have 5 numbers"),
        ((1.0, 0.0, 0.0, "far", -1), "must have 5 numbers"),
        ((math.nan, 0.0, 0.0, 0.0, -1), "must have finite numbers"),
        ((1.0, 0.0, 0.0, math.inf, -1), "must have finite numbers"),
        ((1.0, 0.0, 0.0, 0.0, 0), "flip must be -1 or 1"),
        ((1.0, 0.0, 0.0, 0.0, math.nan), "flip must be -1 or 1"),
    ],
)
def test_another_command_is_refused(command, rule):
    with pytest.raises(InputError, match=rf"^command = .*: {rule}"):
        Decision(command, "")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"miss": 0.1, "miss_sd": -0.1}, "miss_sd = -0.1: must be at least 0, or NaN"),
        ({"rest": -1.0}, "rest = -1.0: must be finite and at least 0"),
        ({"rest": math.inf}, "rest = inf: must be finite"),
        ({"rest": math.nan}, "rest = nan: must be finite"),
    ],
)
def test_a_prediction_or_a_rest_that_means_nothing_is_refused(value, message):
    with pytest.raises(InputError, match=f"^{message}"):
        Decision((0.0, 0.0, 0.0, 0.0, -1), "", **value)
