"""Types of numbers that several commands have as arguments; argparse prints the reason why a value is invalid."""

import argparse
from collections.abc import Callable
from math import inf, isfinite
from typing import TypeVar

Number = TypeVar("Number", int, float)
_KINDS = {"int": "whole", "float": "finite"}


def make_number_type(
    kind: type[Number], least: float = -inf, most: float = inf, *, above: float = -inf
) -> Callable[[str], Number]:
    """Return the argparse type of finite numbers, int or float, from `least` to `most`, or above a limit."""
    limits = f" from {least:g} to {most:g}" if most < inf else f", at least {least:g}" if least > -inf else ""
    limits = f" above {above:g}" if above > -inf else limits
    rule = f"must be a {_KINDS[kind.__name__]} number{limits}"

    def read(text: str) -> Number:
        try:
            value = kind(text)
            valid = text.isascii() and isfinite(value) and least <= value <= most and value > above
        except (ValueError, OverflowError):
            valid = False
        if not valid:
            raise argparse.ArgumentTypeError(f"{text}: {rule}")
        return value

    return read


seed = make_number_type(int, 0)
port = make_number_type(int, 0, 65535)
finite = make_number_type(float)
positive = make_number_type(float, above=0.0)
