"""Codes of devices for "no value" in readings of sensors."""

from math import inf, nan

import pytest

from flexneedle.types import VISIBLE, SensorReading

UNIT, ZERO = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("code", [nan, inf, -inf, -3.697314e28, 1e30, 10_001.0, -99_999.0])
@pytest.mark.parametrize("axes", [(0,), (2,), (0, 1, 2)])
def test_a_position_beyond_10_m_is_missing(code, axes):
    position = tuple(code if axis in axes else 5.0 for axis in range(3))
    found = SensorReading(position, UNIT, 0.02)
    assert (found.position, found.orientation, found.indicator) == (None, UNIT, 0.02)
    assert "a code for missing" in found.status
    assert SensorReading(position, status="disturbed").status == "disturbed"


def test_an_orientation_of_length_0_is_none_and_with_a_position_of_zeros_a_missing_sample():
    assert SensorReading((1.0, 2.0, 3.0), ZERO) == SensorReading((1.0, 2.0, 3.0))
    lost = SensorReading((0.0, -0.0, 0.0), ZERO)
    assert (lost.position, lost.orientation) == (None, None)
    assert lost.status == "missing (position and orientation are 0)"
    for reading in (SensorReading((0.0, 0.0, 0.0)), SensorReading((0.0, 0.0, 0.0), UNIT)):
        assert (reading.position, reading.status) == ((0.0, 0.0, 0.0), VISIBLE)
    assert SensorReading((-10_000.0, 0.0, 10_000.0)).status == VISIBLE
