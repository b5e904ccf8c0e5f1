"""Plants, drivers and trackers of the tip for the conformance kits: sound ones, and each with one fault."""

import math
from dataclasses import replace

import numpy as np

from flexneedle import Control, Motion
from flexneedle.errors import CommandError
from flexneedle.testing import DriverConformance, PlantConformance, TipTrackerConformance
from flexneedle.types import VISIBLE, Measurement


def with_values(part, **values):
    return type(f"{part.__name__}With{'And'.join(values)}", (part,), values)


class Unicycle:
    """A plant: the tip cuts a circle, and base and guide move it."""

    strain_energy, least_stretch, converged = 0.0, 1.0, True
    metres, degrees, side, slips = 1.0, 1.0, 1.0, 0.0

    def __init__(self, truth, roll):
        self.truth, self.roll = truth, roll
        self.at = np.array([truth.scenario.setup.start_tip_x, 0.0, 0.0, 0.0, 0.0])

    @property
    def tip(self):
        return self.at.copy()

    def step(self, row):
        move = Control.of(row)
        self.roll += self.degrees * move.roll
        slope = self.at[3] + 1e-3 * self.side * math.cos(self.roll) * move.db_x
        way = self.metres * move.db_x + self.slips
        self.at = np.array(
            [self.at[0] + way * math.cos(slope), self.at[1] + way * math.sin(slope), 0.0, slope, 0.0]
        )


class ChangesItsRow(Unicycle):
    def step(self, row):
        super().step(row)
        row[:] = 0.0


class SharesItsState(Unicycle):
    shared = None

    def __init__(self, truth, roll):
        super().__init__(truth, roll)
        SharesItsState.shared = self.at

    @property
    def tip(self):
        return SharesItsState.shared.copy()

    def step(self, row):
        super().step(row)
        SharesItsState.shared = self.at


class MovesWhenRead(Unicycle):
    @property
    def tip(self):
        self.at = self.at + 1e-3
        return self.at.copy()


def of_plant(plant):
    return type("Kit", (PlantConformance,), {"make": lambda _, truth, roll: plant(truth, roll)})


class Axes:
    """A driver, and its clock."""

    limit, unit, first, stops = 1.0, 1.0, 0.0, 0.0

    def __init__(self):
        self.time = 10.0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def stop(self):
        self.time += self.stops

    def apply(self, command, duration):
        if abs(command.db_x) > self.limit:
            raise CommandError("db_x", command.db_x, self.limit, f"must be at most {self.limit} mm")
        begun = self.time
        self.time += abs(command.roll) + self.first + duration
        turned = begun + abs(command.roll) + self.first if command.roll or self.first else None
        return self.report(Motion(command, begun, self.time, turned))

    def report(self, motion):
        return motion


def reporting(change):
    return type("Reporting", (Axes,), {"report": lambda _, motion: change(motion)})


def of_driver(driver):
    def make(_):
        made = driver()
        return made, made

    return type("Kit", (DriverConformance,), {"make": make})


class Camera:
    """A tracker of the tip: 20 images a second, with 0.01 mm noise."""

    status, unit, lag, rate, order, late = VISIBLE, 1.0, 0.0, 20.0, 1, 0

    def __init__(self, scenario, phantom, rng):
        del scenario
        self.phantom, self.rng, self.next = phantom, rng, 0

    def read(self):
        due = math.floor(self.phantom.now() * self.rate + 1e-6) + 1 - self.late
        taken, self.next = range(self.next, due), max(self.next, due)
        return tuple(map(self.image, taken))[:: self.order]

    def image(self, number):
        time = number / self.rate
        x, y = (self.unit * value + self.rng.normal(0.0, 0.01) for value in self.phantom.tip_at(time)[:2])
        return Measurement(time + self.lag, x, y)


class Repeats(Camera):
    def read(self):
        return (*super().read(), self.image(self.next - 1))


class Waits(Camera):
    def read(self):
        self.phantom.wait(0.05)
        return super().read()


class DrawsFromTheGlobalGenerator(Camera):
    def image(self, number):
        one = super().image(number)
        return replace(one, y=one.y + 0.01 * np.random.normal())  # noqa: NPY002


def of_camera(camera):
    def make(_, scenario, phantom, rng):
        return camera(scenario, phantom, rng)

    return type("Kit", (TipTrackerConformance,), {"make": make})
