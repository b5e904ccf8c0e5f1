"""Seconds on the command line; argparse says what is wrong with others."""

import argparse
from math import isfinite


def some_seconds(text: str) -> float:
    """Return a number of seconds above 0."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0")
    return value


def wait_seconds(text: str) -> float:
    """Return a number of seconds of at least 0 that can be waited for."""
    value = float(text)
    if not (isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"{text}: must be at least 0")
    return value
