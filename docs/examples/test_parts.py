from bench import Bench
from camera import Camera
from follow_path import CONTROLLER
from proximity import Proximity
from unicycle import Unicycle

from flexneedle.testing import (
    ControllerConformance,
    DriverConformance,
    PlantConformance,
    SensorConformance,
    TipTrackerConformance,
)


class TestFollowPath(ControllerConformance):
    def make(self):
        return CONTROLLER


class TestUnicycle(PlantConformance):
    def make(self, truth, roll):
        return Unicycle(truth, roll)


class TestCamera(TipTrackerConformance):
    def make(self, scenario, phantom, rng):
        return Camera(scenario, phantom, rng)


class TestProximity(SensorConformance):
    def make(self):
        return Proximity(kind="proximity:Proximity", at_mm=5.0)


class TestBench(DriverConformance):
    def make(self):
        bench = Bench(tip_x=-4.0)
        return bench, bench
