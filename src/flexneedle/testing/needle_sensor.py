"""Conformance kit of the port `NeedleSensor`, of a sensor along the needle of a rig file."""

import math

from flexneedle.lab.rig.devices.opening import readings_rule
from flexneedle.testing.checks import require
from flexneedle.testing.device_kit import MeasuringConformance
from flexneedle.types import VISIBLE


class NeedleSensorConformance(MeasuringConformance):
    """Checks of a sensor along the needle. `make` returns the sensor, started, of a scenario's sensor.

    Override `make_clock` for a device in simulated time.

    Attributes:
        seconds: Time for which it is read (s).
        least_hz: Lowest rate of readings (Hz).
        read_s: Longest time of a read (s).
    """

    noun, item = "sensor", "reading"

    def test_readings_are_of_their_type(self) -> None:
        """Require a tuple of Reading, with increasing times on the clock of the run."""
        with self._open() as (sensor, clock):
            start = clock.now()
            found = self._collect(sensor, clock)
            require(not (rule := readings_rule(found)), f"read() {rule}")
            require(isinstance(sensor.read(), tuple), "read must return a tuple")
            self._check_times(found, start, clock.now())

    def test_readings_have_values_or_a_reason(self) -> None:
        """Require numbers in most readings, a reason in the others, and in all as many numbers in a row."""
        with self._open() as (sensor, clock):
            found = self._collect(sensor, clock)
            for one in found:
                known = any(math.isfinite(value) for row in one.rows for value in row)
                rule = f"a reading without a number needs a reason: {one}"
                require(known or one.status not in ("", VISIBLE), rule)
            measured = [one for one in found if one.rows]
            require(2 * len(measured) > len(found), f"most readings have no rows: {found[-1].status}")
            widths = {len(row) for one in measured for row in one.rows}
            require(len(widths) == 1, f"rows must all have as many numbers, not {sorted(widths)}")
