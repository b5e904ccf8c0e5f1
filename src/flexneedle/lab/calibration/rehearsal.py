"""Rehearsals: recordings of a simulated phantom, to try a calibration before a laboratory's own."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flexneedle.lab.calibration.readings import StepReading
from flexneedle.lab.calibration.session import Recording, Session
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import poses_of
from flexneedle.phantom.plants import ExactPlant, Plant, PlantFactory
from flexneedle.phantom.tracking.along import VirtualSensor
from flexneedle.types import COLUMNS, DB_X, DG_Y, Floats, Point, Pose

_ADVANCE_MM, _GUIDE_MM = 1.0, 0.5  # longest motions in a step of the plant
_STEP_S = 10.0  # between two readings
_READINGS = 10  # of a sensor along the needle at a step


@dataclass(frozen=True, eq=False)
class Schedule:
    """Motions of an insertion: at each step the guide moves, then the needle advances and rests.

    Attributes:
        depths: Depths (k,) in mm to which the needle is advanced; the first ≥ −`setup.tip_to_skin_mm`.
        guide: y and, in space, z (k, axes) of the guide from its home, in mm.
    """

    depths: Floats
    guide: Floats

    @classmethod
    def draw(
        cls, rng: np.random.Generator, depth: float, steps: int, axes: int, *, travel: float, moves: int = 4
    ) -> "Schedule":
        """Return equal steps from the skin to a depth, with moves of the guide in the upper two thirds.

        Each move goes to a position of up to ± travel (mm) on each axis; the others are uniform within it.
        """
        guide = np.zeros((steps + 1, axes))
        for k in np.unique(np.linspace(0.1 * steps, 0.65 * steps, moves).astype(int)):
            guide[k + 1 :] = rng.uniform(-travel, travel, axes)
        return cls(np.linspace(0.0, depth, steps + 1), guide)


@dataclass(frozen=True)
class SensorErrors:
    """Errors of a sensor at the tip.

    Attributes:
        position_mm: Standard deviation of each coordinate.
        slope: Standard deviation (rad) of each slope.
        axis: Slopes y, z (rad) of the sensor from the needle's axis.
    """

    position_mm: float = 0.1
    slope: float = 2e-3
    axis: Sequence[float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A phantom and a sensor, with which insertions are recorded, and the sensors along the needle of its scenario.

    Attributes:
        truth: The phantom. Each insertion starts from its start pose, with the bevel towards +y.
        rng: Randomness of the sensor.
        errors: Errors of the sensor.
        plant: Makes the needle (default: the geometrically exact rod).
    """

    truth: Truth
    rng: np.random.Generator
    errors: SensorErrors = field(default_factory=SensorErrors)
    plant: PlantFactory = ExactPlant

    def record(self, schedules: Sequence[Schedule], name: str = "rehearsal") -> Session:
        """Return a session of insertions; the guide moves before the advance to a step."""
        begin, poses = -self.truth.scenario.setup.tip_to_skin_mm, list[Floats]()
        recordings = []
        for k, schedule in enumerate(schedules):
            plant, tips = self.plant(self.truth, 0.0), []
            for _ in rests(plant, schedule, begin):
                tips.append(plant.tip)
                if self.truth.scenario.sensor:
                    poses.append(poses_of(plant))
            recordings.append(self._record(np.array(tips), schedule, name, f"{k:02}"))
        return Session(tuple(self._measure(recordings, Rests(poses))), "before")

    def _measure(self, recordings: Sequence[Recording], needles: "Rests") -> Iterator[Recording]:
        """Yield recordings with the readings of the sensors along the needle, which keep their errors."""
        scenario, found = self.truth.scenario, list[tuple[int, StepReading]]()
        for sensor in scenario.sensor:
            slow = sensor.model_copy(update={"rate_hz": _READINGS / _STEP_S, "delay_s": 0.0})
            depth, length = scenario.target.depth_mm, scenario.needle.length_mm
            made = VirtualSensor(slow, needles, scenario.setup.axes, depth, length, self.rng)
            for each in made.read():
                step = needles.step(each.time)
                found += [(step, StepReading(sensor.title, step, each.rows))] if each.rows else []
        first = 0
        for one in recordings:
            last = first + len(one.depth)
            own = (each._replace(step=step - first) for step, each in found if first <= step < last)
            yield replace(one, readings=tuple(own))
            first = last

    def _record(self, tips: Floats, schedule: Schedule, session: str, name: str) -> Recording:
        count, axes = schedule.guide.shape
        axis = np.array([Pose(*tip).axis for tip in tips.tolist()])
        points = tips[:, : 1 + axes] + self.rng.normal(0.0, self.errors.position_mm, (count, 1 + axes))
        slope = axis[:, 1 : 1 + axes] / axis[:, :1] + np.array(self.errors.axis[:axes])
        return Recording(
            session,
            name,
            time=_STEP_S * np.arange(count, dtype=float),
            depth=points[:, 0],
            position=points[:, 1:] - points[0, 1:],
            slope=slope + self.rng.normal(0.0, self.errors.slope, (count, axes)),
            guide=schedule.guide - schedule.guide[0],
            base=np.zeros((count, axes)),
            roll=np.zeros(count),
        )


@dataclass(frozen=True)
class Rests:
    """Poses (n, 5) of needles at rest, one after another, as a `MeasuredNeedle`."""

    poses: Sequence[Floats]

    def now(self) -> float:
        """Return the time (s) of the end."""
        return _STEP_S * len(self.poses) - 1e-6

    def step(self, time: float) -> int:
        """Return the number of the needle at a time (s), in whole seconds, as clocks are wrong by less."""
        return min(int(round(time) // _STEP_S), len(self.poses) - 1)

    def tip_at(self, time: float) -> Point:
        """Return x, y, z (mm) of the tip."""
        x, y, z = self.shape_at(time)[0][-1, :3].tolist()
        return x, y, z

    def shape_at(self, time: float) -> tuple[Floats, float]:
        """Return the poses (n, 5), and the roll, 0."""
        return self.poses[self.step(time)], 0.0


def carry_out(plant: Plant, schedule: Schedule, start: float) -> Floats:
    """Return the poses (k, 5) of the tip at the steps of a schedule, from a depth (mm) at the start."""
    return np.array([plant.tip for _ in rests(plant, schedule, start)])


def rests(plant: Plant, schedule: Schedule, start: float) -> Iterator[None]:
    """Move the needle from a depth (mm) at the start to each step of a schedule, and yield there."""
    advances = np.diff(schedule.depths, prepend=start)
    moves = np.diff(schedule.guide, axis=0, prepend=np.zeros((1, schedule.guide.shape[1])))
    for advance, move in zip(advances.tolist(), moves, strict=True):
        row = np.zeros(len(COLUMNS))
        row[DG_Y : DG_Y + move.size] = move
        _move(plant, row, float(np.abs(move).max()) / _GUIDE_MM)
        row = np.zeros(len(COLUMNS))
        row[DB_X] = advance
        _move(plant, row, abs(advance) / _ADVANCE_MM)
        yield


def _move(plant: Plant, row: Floats, parts: float) -> None:
    """Move by a command in equal parts, not fewer than given."""
    count = math.ceil(parts - 1e-9)
    for _ in range(count):
        plant.step(row / count)
