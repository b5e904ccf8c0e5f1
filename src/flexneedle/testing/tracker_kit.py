"""Conformance kit of the port `Tracker`, of the tracker of a rig file."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any
from unittest import SkipTest

from flexneedle.errors import RunError
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.opening import frames_rule
from flexneedle.ports import Clock, Tracker
from flexneedle.testing.checks import (
    require,
    require_finite,
    require_increasing,
    require_parts,
)
from flexneedle.types import VISIBLE, Frame

_SLICE_S = 0.02


class TrackerConformance:
    """Checks of a tracker device. `make` returns the tracker, started.

    Override `make_clock` for a device in simulated time.

    Attributes:
        sensor: Name of the needle's sensor.
        seconds: Time for which frames are read (s).
        least_hz: Lowest rate of frames (Hz).
        read_s: Longest time of a read (s).
    """

    sensor = "tip"
    seconds = 1.0
    least_hz = 10.0
    read_s = 0.1

    def make(self, clock: Clock) -> Any:
        """Return a tracker with `close`, or a context manager of one."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def make_clock(self) -> Clock:
        """Return the clock of the run (default: real time)."""
        return WallClock()

    def disconnect(self, tracker: Tracker) -> None:  # noqa: ARG002  for a subclass
        """Make the device fail, so that no frames arrive (default: the check is skipped)."""
        raise SkipTest(f"{type(self).__name__} has no disconnect()")

    @contextmanager
    def _open(self) -> Iterator[tuple[Tracker, Clock]]:
        clock = self.make_clock()
        made = self.make(clock)
        if isinstance(made, AbstractContextManager):
            with made as tracker:
                yield tracker, clock
            return
        require(hasattr(made, "close"), "a tracker must have close(), or be a context manager")
        try:
            yield made, clock
        finally:
            made.close()

    def _frames(self, tracker: Tracker, clock: Clock) -> list[Frame]:
        """Return the frames of `seconds`."""
        found, end = list(tracker.read()), clock.now() + self.seconds
        while clock.now() < end:
            clock.wait(_SLICE_S)
            found += tracker.read()
        require(found, f"no frame arrived in {self.seconds} s: {tracker.status}")
        return found

    def test_has_the_parts_of_the_port(self) -> None:
        """Require `read`, `status` as text, and a way to close."""
        with self._open() as (tracker, _):
            require_parts("the tracker", tracker, "read", "status")
            require(isinstance(tracker.status, str), f"status must be text, not {tracker.status!r}")

    def test_frames_are_of_their_type(self) -> None:
        """Require a tuple of Frame: numbers, unit quaternions, readings by sensor."""
        with self._open() as (tracker, clock):
            found = tuple(self._frames(tracker, clock))
            require(not (rule := frames_rule(found)), f"read() {rule}")
            require(isinstance(tracker.read(), tuple), "read must return a tuple")

    def test_frames_are_in_their_order(self) -> None:
        """Require increasing numbers and times, no frame twice, and no time later than now or before the start."""
        with self._open() as (tracker, clock):
            start = clock.now()
            found = self._frames(tracker, clock)
            require_increasing("frame numbers", [frame.number for frame in found])
            require_increasing("times of frames", [frame.time for frame in found])
            require_finite("times of frames", [frame.time for frame in found])
            last, now = found[-1].time, clock.now()
            require(
                last <= now + 1e-6, f"a frame has the time {last} s, now is {now} s on the clock of the run"
            )
            age = start - found[-1].time
            require(
                age < self.seconds, f"the last frame has the time {last} s, before the start at {start} s"
            )

    def test_frames_arrive_at_their_rate(self) -> None:
        """Require at least `least_hz` frames in a second, with a status that agrees."""
        with self._open() as (tracker, clock):
            found = self._frames(tracker, clock)
            least = self.least_hz * self.seconds
            require(
                len(found) >= least, f"{len(found)} frames in {self.seconds} s, at least {least:g} are needed"
            )
            require(
                tracker.status == VISIBLE,
                f"status must be {VISIBLE!r} while frames arrive: {tracker.status!r}",
            )

    def test_needle_sensor_has_positions(self) -> None:
        """Require the needle's sensor in each frame, with a finite position or the reason why it has none."""
        with self._open() as (tracker, clock):
            found = self._frames(tracker, clock)
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

    def test_read_does_not_wait(self) -> None:
        """Require that a read returns at once, also directly after another."""
        with self._open() as (tracker, clock):
            self._frames(tracker, clock)
            start = clock.now()
            for _ in range(5):
                tracker.read()
            taken = (clock.now() - start) / 5
            require(taken <= self.read_s, f"a read took {taken} s: it must not wait for the next frame")

    def test_failure_is_reported(self) -> None:
        """Require a status with the reason, or RunError, after `disconnect`."""
        with self._open() as (tracker, clock):
            self.disconnect(tracker)
            try:
                for _ in range(int(2.0 / _SLICE_S)):
                    clock.wait(_SLICE_S)
                    tracker.read()
            except RunError:
                return
            require(tracker.status not in ("", VISIBLE), "status must have the reason while no frames arrive")

    def test_frames_do_not_change(self) -> None:
        """Require that a frame keeps its values while later ones are read."""
        with self._open() as (tracker, clock):
            first = self._frames(tracker, clock)[0]
            before = repr((first.time, first.number, dict(first.readings)))
            self._frames(tracker, clock)
            after = repr((first.time, first.number, dict(first.readings)))
            require(before == after, f"a frame changed after it was read: {before}, then {after}")
