"""The controllers, plants, drivers and trackers of the package pass their conformance kits."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest

from emulated import emulated
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.lab.igtl.tracker import make_tracker as make_igtl_tracker
from flexneedle.lab.link.records import NodeLoss
from flexneedle.lab.page.worker.disturbances import DisturbedPlant, DisturbedTracker
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.lab.rig.devices.replay import Replay
from flexneedle.lab.rig.dry_run import dry_run_ports
from flexneedle.lab.rig.supervised import SupervisedDriver
from flexneedle.lab.rig.supervisor.dry import DryRunMotors
from flexneedle.lab.rig.supervisor.protocol import StepCommand
from flexneedle.lab.ros import motors as ros_motors
from flexneedle.lab.ros.records import JointReading, TipReading
from flexneedle.lab.ros.tracker import RosTracker
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import Seeds, virtual_rig
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
from flexneedle.types import VISIBLE, Frame, SensorReading
from galil_peer import CLOSE, peer
from igtl_peers import DEVICE, PlusServer, transform
from igtl_peers import pose as sensor_at
from rooms import ManualClock, environment
from stages import Bench, Stage
from stages import rig_file as rig_in_memory

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


class TestDisturbedPlant(PlantConformance):
    def make(self, truth, roll):
        return DisturbedPlant(truth, roll)


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


class TestDisturbedTracker(TestNoisyTracker):
    def make(self, scenario, phantom, rng):
        return DisturbedTracker(super().make(scenario, phantom, rng))


class TestDryRunTracker(TestNoisyTracker):
    def make(self, scenario, phantom, rng):
        rig = Rig(phantom, phantom, super().make(scenario, phantom, rng))
        return dry_run_ports(rig, rig).tracker


class SupervisorOnBench:
    """A client of a supervisor in memory and in simulated time."""

    def __init__(self):
        self.bench, self.number = Bench().armed(), 0
        self.rig = rig_in_memory()

    def step(self, roll, travel, duration, expected, roll_duration):
        self.number += 1
        command = StepCommand(self.number, roll, travel, duration, expected, roll_duration)
        self.bench.core.request(command)
        return self.bench.until(self.number)

    def stop(self):
        self.bench.stop()
        self.bench.tick()


class TestSupervisedDriver(DriverConformance):
    def make(self):
        supervisor = SupervisorOnBench()
        return SupervisedDriver(supervisor, short_scenario(), 0.0), supervisor.bench.clock


class TestDryRunDriver(TestSupervisedDriver):
    def make(self):
        driver, clock = super().make()
        virtual = virtual_rig(short_scenario(), 0.0, Seeds.of(0), "model")
        ports = dry_run_ports(Rig(clock, driver, virtual.tracker), virtual)
        return ports.driver, ports.clock


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


class TestIgtlTracker(TrackerConformance):
    """A sensor at rest that a Plus server sends."""

    seconds = 0.5

    @pytest.fixture(autouse=True)
    def _served(self):
        with PlusServer(lambda: [transform(sensor_at(1.0, 2.0, 3.0))]) as self.plus:
            yield

    def make(self, clock):
        return make_igtl_tracker({"device": DEVICE, "port": self.plus.port, "axis": "z"}, clock)

    def disconnect(self, tracker):
        del tracker
        self.plus.messages = list


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


class InMemory(MotorsConformance):
    """Motors on the clock of the test."""

    @pytest.fixture(autouse=True)
    def _clock(self):
        self.clock = ManualClock()

    def now(self):
        return self.clock.now()

    def wait(self, seconds):
        self.clock.wait(seconds)


class TestDryRunMotors(InMemory):
    channels, switches_off = ("A", "B", "C"), False

    def make(self):
        return DryRunMotors(Stage(self.clock), self.clock)


class JointNode:
    """A ROS node whose joints are at once at their goals."""

    ended = ""

    def __init__(self, clock, positions):
        self.clock, self.positions = clock, positions

    def poll(self):
        if not self.ended:
            return [JointReading(self.clock.now(), dict(self.positions))]
        ended, self.ended = self.ended, "reported"
        return [] if ended == "reported" else [NodeLoss(self.clock.now(), ended)]

    def publish(self, targets):
        self.positions |= targets.positions

    def close(self):
        pass


class TestRosMotors(InMemory):
    channels, switches_off = ("insertion", "roll"), False
    distance, speed, acceleration = 0.02, 0.1, 1.0  # m, m/s, m/s²
    tolerance = 1.1e-3  # a reading is older than the set point of the same call

    @pytest.fixture(autouse=True)
    def _node(self, _clock, monkeypatch):
        def connect_at_once(connect):
            opened = Future()
            opened.set_result(connect())
            return opened

        self.node = JointNode(self.clock, dict.fromkeys(self.channels, 0.01))
        time = SimpleNamespace(monotonic=self.clock.now, time=self.clock.now, sleep=self.clock.wait)
        monkeypatch.setattr(ros_motors, "time", time)
        monkeypatch.setattr(ros_motors, "NodeClient", lambda *_, **__: self.node)
        monkeypatch.setattr(ros_motors, "connect_in_thread", connect_at_once)

    def make(self):
        return ros_motors.make_motors({}, self.channels)

    def disconnect(self, motors):
        del motors
        self.node.ended = "the ROS node has ended"


class TipNode:
    """A ROS node that receives 40 tips a second."""

    status = VISIBLE

    def __init__(self, clock):
        self.clock, self.number = clock, 0

    def poll(self):
        due = int(self.clock.now() / PERIOD) if self.status == VISIBLE else 0
        fresh = range(self.number + 1, due + 1)
        self.number = max(self.number, due)
        return [TipReading(n * PERIOD, n, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)) for n in fresh]

    def close(self):
        pass


class TestRosTracker(InSimulatedTime):
    @pytest.fixture(autouse=True)
    def _patch(self, monkeypatch):
        self.monkeypatch = monkeypatch

    def make(self, clock):
        self.monkeypatch.setattr("flexneedle.lab.ros.receiver.monotonic", clock.now)
        self.node = TipNode(clock)
        return RosTracker(self.node, clock, late_s=0.25)

    def disconnect(self, tracker):
        del tracker
        self.node.status = "the ROS node has ended"
