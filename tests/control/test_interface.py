"""Decisions: nine plain numbers, a miss that is predicted or not, a rest that ends."""

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
    """Commands and figures are compared; the shape follows from them."""

    def decision(command, sd):
        shape = Shape(np.zeros((3, 5)), np.full((3, 2), sd))
        return Decision(command, "", 0.0, 0.0, miss=0.1, miss_sd=0.2, predicted=shape)

    assert decision(STILL, 1.0) == decision(STILL, 1.0)
    assert decision(STILL, 1.0) != decision(Control(db_x=1.0), 1.0)


@pytest.mark.parametrize(
    "command",
    [
        (1.0, 0.0), (1.0, 0.0, 0.0, 0.0, -1), None, (1.0, 0.0, 0.0, "far", 0.0, 0.0, 0.0, 0.0, 0.0),
        Control(db_x=math.nan), Control(dg_y=math.inf), Control(roll=math.nan),
    ],
)  # fmt: skip
def test_another_command_is_refused(command):
    with pytest.raises(InputError, match=r"^command = "):
        Decision(command, "")


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("miss_sd", {"miss": 0.1, "miss_sd": -0.1}),
        *(("rest", {"rest": one}) for one in (-1.0, math.inf, math.nan, "1")),
        *((key, {key: None}) for key in ("why", "cost", "spread", "miss", "miss_sd")),
        ("miss", {"miss": [0.1, 0.2], "miss_sd": 0.1}),
    ],
)
def test_a_value_of_another_kind_or_range_is_refused(key, values):
    with pytest.raises(InputError, match=f"^{key} = "):
        Decision(STILL, **{"why": "", **values})
