"""Types of arguments that several commands have; argparse prints the reason why a value is invalid."""

import argparse
from collections.abc import Callable
from math import isfinite
from typing import TypeVar

Number = TypeVar("Number", int, float)


def seed(text: str) -> int:
    """Return the seed of an argument. Raises ArgumentTypeError for a negative one."""
    value = _read(int, text, "must be a whole number of at least 0")
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value}: must be at least 0")
    return value


def finite(text: str) -> float:
    """Return a finite number."""
    rule = "must be a finite number"
    value = _read(float, text, rule)
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: {rule}")
    return value


def positive(text: str) -> float:
    """Return a finite number above 0."""
    rule = "must be a finite number above 0"
    value = _read(float, text, rule)
    if not (isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text}: {rule}")
    return value


def _read(kind: Callable[[str], Number], text: str, rule: str) -> Number:
    """Return the number of a text. Raises ArgumentTypeError, with the rule, for any other text."""
    try:
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: {rule}") from None
