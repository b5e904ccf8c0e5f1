"""Checks of a device that measures on the clock of the run: of the kits of trackers and of sensors along the needle."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any
from unittest import SkipTest

from flexneedle.errors import RunError
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.ports import Clock
from flexneedle.testing.checks import require, require_finite, require_increasing, require_parts
from flexneedle.types import VISIBLE

_SLICE_S = 0.02


class MeasuringConformance:
    """Checks of a device with `read`, `status`, and `close` or a context manager.

    Override `make_clock` for a device in simulated time.

    Attributes:
        noun, item: Name of the device and of what it reads, for messages.
        seconds: Time for which it is read (s).
        least_hz: Lowest rate (Hz).
        read_s: Longest time of a read (s).
    """

    noun, item = "device", "item"
    seconds = 1.0
    least_hz = 10.0
    read_s = 0.1

    def make(self, clock: Clock) -> Any:
        """Return a device with `close`, or a context manager of one."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def make_clock(self) -> Clock:
        """Return the clock of the run (default: real time)."""
        return WallClock()

    def disconnect(self, device: Any) -> None:  # noqa: ARG002  for a subclass
        """Make the device fail, so that nothing arrives (default: the check is skipped)."""
        raise SkipTest(f"{type(self).__name__} has no disconnect()")

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, Clock]]:
        clock = self.make_clock()
        made = self.make(clock)
        if isinstance(made, AbstractContextManager):
            with made as device:
                yield device, clock
            return
        require(hasattr(made, "close"), f"a {self.noun} must have close(), or be a context manager")
        try:
            yield made, clock
        finally:
            made.close()

    def _collect(self, device: Any, clock: Clock) -> list[Any]:
        """Return what is read in `seconds`."""
        found, end = list(device.read()), clock.now() + self.seconds
        while clock.now() < end:
            clock.wait(_SLICE_S)
            found += device.read()
        require(found, f"no {self.item} arrived in {self.seconds} s: {device.status}")
        return found

    def _check_times(self, found: list[Any], start: float, now: float) -> None:
        """Require times that increase, none later than now, and the last not before the start."""
        require_increasing(f"times of {self.item}s", [one.time for one in found])
        require_finite(f"times of {self.item}s", [one.time for one in found])
        last, where = found[-1].time, f"the last {self.item} has the time {found[-1].time} s"
        require(last <= now + 1e-6, f"{where}, now is {now} s on the clock of the run")
        require(start - last < self.seconds, f"{where}, before the start at {start} s")

    def test_has_the_parts_of_the_port(self) -> None:
        """Require `read`, `status` as text, and a way to close."""
        with self._open() as (device, _):
            require_parts(f"the {self.noun}", device, "read", "status")
            require(isinstance(device.status, str), f"status must be text, not {device.status!r}")

    def test_arrives_at_its_rate(self) -> None:
        """Require at least `least_hz` in a second, with a status that agrees."""
        with self._open() as (device, clock):
            count, least = len(self._collect(device, clock)), self.least_hz * self.seconds
            status, wanted = device.status, f"must be {VISIBLE!r} while {self.item}s arrive"
            require(
                count >= least, f"{count} {self.item}s in {self.seconds} s, at least {least:g} are needed"
            )
            require(status == VISIBLE, f"status {wanted}: {status!r}")

    def test_read_does_not_wait(self) -> None:
        """Require that a read returns at once, also directly after another."""
        with self._open() as (device, clock):
            self._collect(device, clock)
            start = clock.now()
            for _ in range(5):
                device.read()
            taken = (clock.now() - start) / 5
            require(taken <= self.read_s, f"a read took {taken} s: it must not wait for the next {self.item}")

    def test_failure_is_reported(self) -> None:
        """Require a status with the reason, or RunError, after `disconnect`."""
        with self._open() as (device, clock):
            self.disconnect(device)
            try:
                for _ in range(int(2.0 / _SLICE_S)):
                    clock.wait(_SLICE_S)
                    device.read()
            except RunError:
                return
            rule = f"status must have the reason while no {self.item}s arrive"
            require(device.status not in ("", VISIBLE), rule)
