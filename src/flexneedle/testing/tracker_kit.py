"""Conformance kit of the port `Tracker`, of the tracker of a rig file."""

from flexneedle.lab.rig.devices.opening import frames_rule
from flexneedle.testing.checks import require, require_finite, require_increasing
from flexneedle.testing.device_kit import MeasuringConformance
from flexneedle.types import VISIBLE


class TrackerConformance(MeasuringConformance):
    """Checks of a tracker device. `make` returns the tracker, started.

    Override `make_clock` for a device in simulated time.

    Attributes:
        sensor: Name of the needle's sensor.
        seconds: Time for which frames are read (s).
        least_hz: Lowest rate of frames (Hz).
        read_s: Longest time of a read (s).
    """

    noun, item = "tracker", "frame"
    sensor = "tip"

    def test_frames_are_of_their_type(self) -> None:
        """Require a tuple of Frame: numbers, unit quaternions, readings by sensor."""
        with self._open() as (tracker, clock):
            found = tuple(self._collect(tracker, clock))
            require(not (rule := frames_rule(found)), f"read() {rule}")
            require(isinstance(tracker.read(), tuple), "read must return a tuple")

    def test_frames_are_in_their_order(self) -> None:
        """Require increasing numbers and times, no frame twice, and no time later than now or before the start."""
        with self._open() as (tracker, clock):
            start = clock.now()
            found = self._collect(tracker, clock)
            require_increasing("frame numbers", [frame.number for frame in found])
            self._check_times(found, start, clock.now())

    def test_needle_sensor_has_positions(self) -> None:
        """Require the needle's sensor in each frame, with a finite position or the reason why it has none."""
        with self._open() as (tracker, clock):
            found = self._collect(tracker, clock)
            lacking = [frame for frame in found if self.sensor not in frame.readings]
            require(not lacking, f"a frame lacks the sensor {self.sensor}: {lacking[:1]}")
            readings = [reading for frame in found for reading in frame.readings.values()]
            for one in readings:
                if one.position is None:
                    require(
                        one.status not in ("", VISIBLE), f"a reading without a position needs a reason: {one}"
                    )
                else:
                    require_finite("a position", one.position)
            require(
                any(frame.readings[self.sensor].position for frame in found), f"{self.sensor} has no position"
            )

    def test_frames_do_not_change(self) -> None:
        """Require that a frame keeps its values while later ones are read."""
        with self._open() as (tracker, clock):
            first = self._collect(tracker, clock)[0]
            before = repr((first.time, first.number, dict(first.readings)))
            self._collect(tracker, clock)
            after = repr((first.time, first.number, dict(first.readings)))
            require(before == after, f"a frame changed after it was read: {before}, then {after}")
