"""What a decision must be: nine plain numbers, a miss that is predicted or not, a rest that ends."""

import math

import numpy as np
import pytest

from flexneedle.control.interface import Decision
from flexneedle.errors import InputError
from flexneedle.types import STILL, Control, Shape


@pytest.mark.parametrize("kind", [list, np.array])
def test_a_command_of_any_sequence_becomes_plain_numbers(kind):
    command = Decision(kind([1, 0, 0, 0, 0, 0.5, 0, math.pi, 0]), "").command
    assert command == Control(db_x=1.0, dg_y=0.5, flip=True)
    assert [type(value) for value in command] == [float] * 9


def test_decisions_with_a_predicted_shape_can_be_compared():
    """By their commands and figures; the shape follows from them."""

    def decision(command, sd):
        shape = Shape(np.zeros((3, 5)), np.full((3, 2), sd))
        return Decision(command, "", 0.0, 0.0, miss=0.1, miss_sd=0.2, predicted=shape)

    assert decision(STILL, 1.0) == decision(STILL, 1.0)
    assert decision(STILL, 1.0) != decision(Control(db_x=1.0), 1.0)


@pytest.mark.parametrize(
    ("command", "rule"),
    [
        ((1.0, 0.0), "must be a Control, or its 9 columns"),
        ((1.0, 0.0, 0.0, 0.0, -1), "must be a Control, or its 9 columns"),
        (None, "must be a Control, or its 9 columns"),
        ((1.0, 0.0, 0.0, "far", 0.0, 0.0, 0.0, 0.0, 0.0), "must be a Control, or its 9 columns"),
        (Control(db_x=math.nan), "must have finite numbers"),
        (Control(dg_y=math.inf), "must have finite numbers"),
        (Control(roll=math.nan), "must have finite numbers"),
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
        Decision(STILL, "", **value)
