"""Types of arguments: other values are refused with the reason."""

import argparse

import pytest

from flexneedle.cli.values import finite, make_number_type, port, positive, seed


@pytest.mark.parametrize(
    ("kind", "texts", "rule"),
    [
        (seed, ("x", "1.5", "-1", "٢", "1" + 400 * "0"), "must be a whole number, at least 0"),
        (port, ("-1", "65536", "http"), "must be a whole number from 0 to 65535"),
        (make_number_type(float, 0.0), ("-1", "inf"), "must be a finite number, at least 0"),
        (finite, ("x", "inf", "nan"), "must be a finite number"),
        (positive, ("fast", "0", "-0.5", "inf", "nan"), "must be a finite number above 0"),
    ],
)
def test_a_number_out_of_range_is_refused(kind, texts, rule):
    for text in texts:
        with pytest.raises(argparse.ArgumentTypeError, match=f"^{text}: {rule}$"):
            kind(text)


def test_other_numbers_are_accepted():
    assert (seed("0"), finite("-1.5"), positive("1e-9"), port("65535")) == (0, -1.5, 1e-9, 65535)
