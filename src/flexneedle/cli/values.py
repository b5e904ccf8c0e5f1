"""Types of numbers that several commands have as arguments; argparse prints the reason why a value is invalid."""

import argparse
from collections.abc import Callable
from math import inf, isfinite
from typing import TypeVar

from flexneedle.arguments import NARROWEST_MM, WIDEST_MM

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


_INCHES = {"mm": 1.0 / 25.4, "cm": 1.0 / 2.54, "in": 1.0}


def length(text: str) -> float:
    """Return the width of a figure in inches, from text such as 88mm."""
    number, unit = text.strip()[:-2], text.strip()[-2:]
    try:
        inches = float(number) * _INCHES[unit]
    except (ValueError, KeyError):
        inches = 0.0
    if not NARROWEST_MM <= round(25.4 * inches, 6) <= WIDEST_MM:
        rule = f"must be a width with its unit, such as 88mm, 8.8cm or 3.5in, from {NARROWEST_MM:g} to {WIDEST_MM:g} mm"
        raise argparse.ArgumentTypeError(f"{text}: {rule}")
    return inches


seed = make_number_type(int, 0)
port = make_number_type(int, 0, 65535)
finite = make_number_type(float)
positive = make_number_type(float, above=0.0)
