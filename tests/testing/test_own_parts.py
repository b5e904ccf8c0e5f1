"""The controllers, plants, drivers and trackers of the package pass their conformance kits."""

import numpy as np
import pytest

from emulated import emulated
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.devices.replay import Replay
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS
from flexneedle.phantom.tracking.field.field_tracker import FieldTracker
from flexneedle.phantom.tracking.field.poses import tip_sensor_pose
from flexneedle.phantom.tracking.field.room import Room
from flexneedle.phantom.tracking.simulated import NoisyTracker
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.testing import (
    ControllerConformance,
    DriverConformance,
    MotorsConformance,
    PlantConformance,
    TipTrackerConformance,
    TrackerConformance,
)
from flexneedle.testing.checks import short_scenario
from flexneedle.types import Frame, SensorReading
from galil_peer import CLOSE, peer
from rooms import ManualClock, environment

PERIOD = 1 / 40


class OfController(ControllerConformance):
    name: str

    def make(self):
        return CONTROLLERS[self.name]


class OfPlant(PlantConformance):
    name: str

    def make(self, truth, roll):
        return PLANTS[self.name](truth, roll)


def _add_classes(kit, names):
    for name in names:
        title = f"Test{kit.__name__[2:]}{name.title().replace('-', '')}"
        globals()[title] = type(
            title, (kit,), {"name": name, "strategy": STRATEGIES.get(name, "manipulation")}
        )


STRATEGIES = {"bevel-only": "steering"}
_add_classes(OfController, CONTROLLERS)
_add_classes(OfPlant, PLANTS)


class TestVirtualDriver(DriverConformance):
    def make(self):
        phantom = Phantom(Truth(short_scenario()), 0.0, "model")
        return phantom, phantom


class TestNoisyTracker(TipTrackerConformance):
    def make(self, scenario, phantom, rng):
        del scenario

        def direction_at(time):
            return phantom.pose_at(time)[3:]

        return NoisyTracker(
            *(phantom.tip_at, phantom, PERIOD, 0.1, rng),
            delay=0.1,
            missing=0.02,
            direction_at=direction_at,
            direction_jitter=0.005,
        )


class TestTrackerInAField(TipTrackerConformance):
    def make(self, scenario, phantom, rng):
        del scenario

        def poses_at(time):
            pose = phantom.pose_at(time)
            return {"tip": tip_sensor_pose(pose.point, pose.axis, 5.0)}

        field = FieldTracker(Room(environment(), 1), poses_at, phantom, PERIOD, rng, delay=0.1, ahead=0.1)
        return OnStage(field, field._to_tracker, 5.0)


class InSimulatedTime(TrackerConformance):
    def make_clock(self):
        return ManualClock()


class TestFieldTracker(InSimulatedTime):
    def make(self, clock):
        poses = {"tip": tip_sensor_pose((10.0, 2.0, 0.5), (1.0, 0.0, 0.0))}
        room, rng = Room(environment(), 1), np.random.default_rng(0)
        made = FieldTracker(room, lambda _: poses, clock, PERIOD, rng, missing=0.1)
        made.close = lambda: None
        return made


class TestReplay(InSimulatedTime):
    def make(self, clock):
        readings = {"tip": SensorReading((1.0, 2.0, 3.0)), "ref1": SensorReading(None, status="missing")}
        return Replay([Frame(100.0 + n * PERIOD, 7 + n, readings) for n in range(200)], clock)

    def disconnect(self, tracker):
        tracker._next = len(tracker._frames)


@pytest.fixture(scope="module")
def aurora():
    """The path of an emulated Aurora."""
    with emulated() as path:
        yield path


class TestAurora(TrackerConformance):
    seconds = 0.5

    @pytest.fixture(autouse=True)
    def _emulated(self, aurora):
        self.port = aurora

    def make(self, clock):
        return Aurora(self.port, clock)


class TestGalil(MotorsConformance):
    """In the time of the emulated controller, which advances by 5 ms with each line."""

    channels = ("A", "B")

    @pytest.fixture(autouse=True)
    def _emulated(self):
        with peer() as self.peer:
            yield

    def make(self):
        settings = {"address": f"127.0.0.1:{self.peer.port}", "reply_timeout_ms": 1000}
        return factory(settings, self.channels)

    def now(self):
        return 5e-3 * len(self.peer.lines)

    def wait(self, seconds):
        pass

    def disconnect(self, motors):
        del motors
        self.peer.damage = lambda *_: CLOSE
