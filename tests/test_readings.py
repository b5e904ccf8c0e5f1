"""Codes of devices for "no value" in readings of sensors."""

from math import inf, nan

import pytest

from flexneedle.types import VISIBLE, SensorReading

UNIT, ZERO = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("axes", [(0,), (2,), (0, 1, 2)])
def test_ndis_code_is_missing_and_a_position_that_cannot_be_has_a_fault(axes):
    def read(code, **more):
        return SensorReading(tuple(code if axis in axes else 5.0 for axis in range(3)), UNIT, 0.02, **more)

    for code in (-3.697314e28, -3.6973140286e28):  # in digits, and as a float of four bytes
        assert read(code) == SensorReading(None, UNIT, 0.02, "missing")
        assert read(code, status="disturbed") == SensorReading(None, UNIT, 0.02, "disturbed")
    for code, fault in (
        (nan, "not a number"),
        (inf, "not a number"),
        (1e30, "beyond 10 m"),
        (-10_001.0, "beyond 10 m"),
    ):
        assert read(code).fault == f"its position is {fault}"
        assert read(code).position is not None
    assert (read(-10_000.0).fault, read(5.0, status="stale").fault) == ("", "stale")


def test_an_orientation_of_length_0_is_none_and_with_a_position_of_zeros_a_missing_sample():
    assert SensorReading((1.0, 2.0, 3.0), ZERO) == SensorReading((1.0, 2.0, 3.0))
    lost = SensorReading((0.0, -0.0, 0.0), ZERO)
    assert (lost.position, lost.orientation) == (None, None)
    assert lost.status == "missing (position and orientation are 0)"
    for reading in (SensorReading((0.0, 0.0, 0.0)), SensorReading((0.0, 0.0, 0.0), UNIT)):
        assert (reading.position, reading.status) == ((0.0, 0.0, 0.0), VISIBLE)
