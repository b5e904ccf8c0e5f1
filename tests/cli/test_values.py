"""Types of arguments: what is no such number is refused with the reason."""

import argparse

import pytest

from flexneedle.cli.values import finite, positive, seed


@pytest.mark.parametrize(
    ("kind", "text", "rule"),
    [
        (seed, "-1", "-1: must be at least 0"),
        (seed, "x", "x: must be a whole number of at least 0"),
        (finite, "x", "x: must be a finite number"),
        (positive, "fast", "fast: must be a finite number above 0"),
        (finite, "inf", "inf: must be a finite number"),
        (finite, "nan", "nan: must be a finite number"),
        (positive, "0", "0: must be a finite number above 0"),
        (positive, "-0.5", "-0.5: must be a finite number above 0"),
        (positive, "inf", "inf: must be a finite number above 0"),
        (positive, "nan", "nan: must be a finite number above 0"),
    ],
)
def test_a_number_out_of_range_is_refused(kind, text, rule):
    with pytest.raises(argparse.ArgumentTypeError) as refused:
        kind(text)
    assert str(refused.value) == rule


def test_other_numbers_are_taken():
    assert (seed("0"), finite("-1.5"), positive("1e-9")) == (0, -1.5, 1e-9)
