"""Tracker devices and motors for the conformance kits: sound ones, and each with one fault."""

import math

from flexneedle.errors import DriverError
from flexneedle.testing import MotorsConformance, TrackerConformance
from flexneedle.types import VISIBLE, Frame, SensorReading
from rooms import ManualClock
from stages import Stage


class Device:
    """A tracker device: 40 frames a second."""

    status, number, ahead, sensor, position, length = VISIBLE, 1, 0.0, "tip", (1.0, 2.0, 3.0), 1.0
    reason, takes = "", 0.0

    def __init__(self, clock):
        self.clock, self.start, self.next = clock, clock.now(), 0

    def read(self):
        self.clock.wait(self.takes)
        due = int((self.clock.now() - self.start) * 40.0 + 1e-6) + 1
        taken, self.next = range(self.next, due), due
        return tuple(map(self.frame, taken))

    def frame(self, number):
        status = VISIBLE if self.position else self.reason
        tip = SensorReading(self.position, (self.length, 0.0, 0.0, 0.0), status=status)
        return Frame(self.start + number / 40.0 + self.ahead, self.number * number, {self.sensor: tip})

    def close(self):
        pass


class ChangesItsFrames(Device):
    readings = {}  # noqa: RUF012  this is the fault

    def frame(self, number):
        tip = SensorReading((float(number), 0.0, 0.0))
        self.readings["tip"] = tip
        return Frame(self.start + number / 40.0, number, self.readings)


class HidesItsFailure(Device):
    def read(self):
        return () if getattr(self, "lost", False) else super().read()


def of_device(device):
    def disconnect(_, made):
        made.lost = True
        if device is not HidesItsFailure:
            made.status = "no connection"

    parts = {"make": lambda _, clock: device(clock), "make_clock": lambda _: ManualClock()}
    return type("Kit", (TrackerConformance,), parts | {"disconnect": disconnect})


class Motors(Stage):
    """Motors that refuse anything but positions."""

    def follow(self, positions):
        if not all(map(math.isfinite, positions.values())):
            raise DriverError(f"{positions}: must be finite")
        super().follow(positions)


class WaitsForTheEnd(Motors):
    def follow(self, positions):
        super().follow(positions)
        while any(state.moving for state in self.read().values()):
            self.clock.wait(0.01)


class RepliesLate(Motors):
    def read(self):
        self.clock.wait(0.5)
        return super().read()


class IgnoresFurtherPositions(Motors):
    def follow(self, positions):
        if not any(call[0] == "follow" for call in self.calls):
            super().follow(positions)


class MovesWithoutPower(Motors):
    def follow(self, positions):
        super().follow(positions)
        for channel, position in positions.items():
            self.motors[channel].position = position


class MovesToReconnect(Motors):
    def reconnect(self):
        self.motors["A"].position = 50.0


class ClosesOnce(Motors):
    closed = False

    def close(self):
        assert not self.closed
        self.closed = True


class MovesWhenOpened(Motors):
    def __init__(self, clock):
        super().__init__(clock)
        self.motors["A"].target = 50.0


class DoesNotStop(Motors):
    deaf = True

    def __init__(self, clock):
        super().__init__(clock)
        self.deaf = True


class IgnoresTheSpeed(Motors):
    def set_speed(self, channel, speed, acceleration):
        super().set_speed(channel, 3.0 * speed, acceleration)


class MovesToDefine(Motors):
    def define(self, channel, position):
        self._called("define", channel, position)
        self.motors[channel].target = position


class TakesAnyPosition(Motors):
    def follow(self, positions):
        self._called("follow")
        for channel, position in positions.items():
            self.motors[channel].target = position


class ReadsOneChannel(Motors):
    def read(self):
        return {"A": super().read()["A"]}


class ReadsTuples(Motors):
    def read(self):
        return {name: (state.position, state.moving) for name, state in super().read().items()}


class LeapsWhenSwitchedOn(Motors):
    def power(self, channel, on):
        super().power(channel, on)
        self.motors[channel].target = self.motors[channel].position = 100.0 * on


class FailsAsOSError(Motors):
    def _called(self, *call):
        if self.lost:
            raise OSError("no such device")
        super()._called(*call)


class AddsToThePosition(Motors):
    def follow(self, positions):
        super().follow({name: self.motors[name].position + way for name, way in positions.items()})


def of_motors(motors):
    class Kit(MotorsConformance):
        channels = ("A", "B", "C")

        def make(self):
            self.clock = ManualClock()
            return motors(self.clock)

        def now(self):
            return self.clock.now()

        def wait(self, seconds):
            self.clock.wait(seconds)

        def disconnect(self, made):
            made.lost = True

    return Kit
