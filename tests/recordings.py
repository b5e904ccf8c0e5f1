"""A recording on a grid with a simulated stage."""

import csv
from itertools import product

import numpy as np

from flexneedle.lab.tracker_evaluation.recording.grid_recording import (
    StageOperator,
    open_session,
    record_grid,
)
from flexneedle.types import VISIBLE, Frame, SensorReading

GRID = """\
environment = "ideal, by the window"
samples = 6
repeats = 2
points_mm = [[0, 0, 0], [10, 0, 0], [10, 20, 0]]
[sensors]
tip = "tip"
ref1 = "reference"
[rest]
drift_mm = 0.2
timeout_s = 2.0
"""


class Stage:
    """Tracker, clock and operator of a simulated stage; time passes only by waiting."""

    def __init__(self):
        self.time, self.position, self.speed = 0.0, np.zeros(3), 0.0
        self.moves, self.reports = [], []
        self.fault, self.status = None, VISIBLE
        self._sent = 0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def read(self):
        numbers = range(self._sent + 1, int(self.time * 40) + 1)
        self._sent = max(self._sent, int(self.time * 40))
        return tuple(map(self._frame, numbers))

    def _frame(self, number):
        x, y, z = self.position
        x += 100.0 + self.speed * number / 40
        reading = SensorReading((x, y, z), (1.0, 0.0, 0.0, 0.0), 0.02)
        return Frame(number / 40, number, {"tip": reading, "ref1": reading} | (self.fault or {}))

    def move(self, stop):
        self.moves.append((stop.repeat, stop.point_id))
        self.position = np.array(stop.position)
        self.time += 3.0

    def operator(self, **settings):
        return StageOperator(self.move, self.reports.append, **settings)


def run(out, grid, stage, **settings):
    with open_session(out, grid) as session:
        return record_grid(session, stage, stage, grid, stage.operator(**settings))


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


ALL = list(product((1, 2), (1, 2, 3)))


def assert_complete(path, samples=6, stops=ALL, sensors=("tip", "reference")):
    """Every stop has all its rows once, in order."""
    found = [(int(row["repeat"]), int(row["point_id"]), row["sensor"]) for row in rows_of(path)]
    assert found == [(*stop, name) for stop in stops for _ in range(samples) for name in sensors]
