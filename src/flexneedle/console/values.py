"""Types of arguments that several commands have; argparse prints the reason why a value is invalid."""

import argparse
from math import isfinite


def seed(text: str) -> int:
    """Return the seed of an argument. Raises ArgumentTypeError for a negative one."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value}: must be at least 0")
    return value


def finite(text: str) -> float:
    """Return a finite number."""
    value = float(text)
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number")
    return value


def positive(text: str) -> float:
    """Return a finite number above 0."""
    value = float(text)
    if not (isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number above 0")
    return value
