from optical import open_tracker
from stage import open_stage

from flexneedle.testing import MotorsConformance, TrackerConformance


class TestStage(MotorsConformance):
    channels, distance, speed, acceleration = ("X",), 500.0, 5000.0, 100_000.0  # counts, counts/s, counts/s²

    def make(self):
        return open_stage({"port": "/dev/ttyACM0"}, self.channels)


class TestOptical(TrackerConformance):
    def make(self, clock):
        return open_tracker({"rate_hz": 40}, clock)
