"""A rig file, and motors and a tracker that record their calls."""

import copy
import tomllib
from dataclasses import replace

from flexneedle.errors import DriverError
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.ports import MotorState
from flexneedle.types import VISIBLE, Frame, SensorReading

TEXT = """\
name = "Bench"

[driver]
kind = "bench"

[axes.insertion]
channel = "A"
counts_per_mm = 1000
range_mm = [0, 120]
speed_mm_s = 10
acceleration_mm_s2 = 100
home = "reverse-limit"

[axes.rotation]
channel = "B"
counts_per_deg = 100
range_deg = [-10, 190]
speed_deg_s = 360
acceleration_deg_s2 = 1800

[axes.guide_y]
channel = "C"
direction = -1
counts_per_mm = 500
range_mm = [-15, 15]
speed_mm_s = 5
acceleration_mm_s2 = 50
home = "absolute"

[tracker]
kind = "bench"
"""
VALUES = tomllib.loads(TEXT)


def values(changes=None):
    """Return the values of the rig file, changed by dotted key; None removes a key."""
    changed = copy.deepcopy(VALUES)
    for key, value in (changes or {}).items():
        *way, last = key.split(".")
        table = changed
        for part in way:
            table = table.setdefault(part, {})
        if value is None:
            del table[last]
        else:
            table[last] = value
    return changed


def rig(**changes):
    """Return the rig with values changed; `axes__insertion__home="here"` is a dotted key."""
    return RigFile.model_validate(values({key.replace("__", "."): value for key, value in changes.items()}))


class Motors:
    """The port `Motors`: states by channel, and the received calls. fails: reason of the error of each reading."""

    def __init__(self, channels=("A", "B", "C"), fails=""):
        self.states = {channel: MotorState(0.0, 0.0) for channel in channels}
        self.calls, self.fails, self.closed = [], fails, False

    def set(self, channel, **values):
        self.states[channel] = replace(self.states[channel], **values)

    def read(self):
        if self.fails:
            raise DriverError(self.fails)
        return dict(self.states)

    def _called(self, *call):
        self.calls.append(call)

    def set_speed(self, channel, speed, acceleration):
        self._called("set_speed", channel, speed, acceleration)

    def follow(self, positions):
        self._called("follow", dict(positions))

    def stop(self):
        self._called("stop")

    def define(self, channel, position):
        self._called("define", channel, position)

    def power(self, channel, on):
        self._called("power", channel, on)

    def reconnect(self):
        self._called("reconnect")

    def close(self):
        self.closed = True


class Tracker:
    """The port `Tracker` on a clock: frames at `rate` (Hz) with these sensors, from its start."""

    place = (-28.5, 0.1, 0.2)

    def __init__(self, clock, rate=40.0, sensors=("tip",), status=VISIBLE):
        self.clock, self.rate, self.sensors, self.status = clock, rate, sensors, status
        self.start, self.number, self.closed = clock.now(), 0, False

    def read(self):
        due = int((self.clock.now() - self.start) * self.rate + 1e-9)
        taken, self.number = range(self.number, due), due
        readings = {name: SensorReading(self.place) for name in self.sensors}
        return tuple(Frame(self.start + n / self.rate, n, readings) for n in taken)

    def close(self):
        self.closed = True


def drivers(_settings, channels):
    """Return motors: a driver of a rig file."""
    return Motors(channels)


def trackers(settings, clock):
    """Return a tracker: a tracker of a rig file."""
    return Tracker(clock, **settings)
