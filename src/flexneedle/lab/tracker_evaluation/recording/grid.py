"""The grid of points at which a tracker is recorded: a TOML file."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from typing import Annotated

from pydantic import Field, model_validator

from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title, count
from flexneedle.types import TIP, Point

GRIDS = Library("a grid file", "grid", files(__package__) / "grids")
_LARGEST_COUNT = 100_000

_Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Lattice(Section):
    """Table `grid`: equally spaced points, x slowest and z fastest."""

    origin_mm: _Vector = (0.0, 0.0, 0.0)
    """First point, in the stage's frame."""
    spacing_mm: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] = (25.0, 25.0, 25.0)
    """Spacing along x, y, z."""
    counts: Annotated[tuple[int, int, int], Field(strict=False)] = (5, 5, 5)
    """Number of points along x, y, z."""

    @model_validator(mode="after")
    def _check_counts(self) -> "Lattice":
        wrong = min(self.counts) < 1 or self.counts[0] * self.counts[1] * self.counts[2] > _LARGEST_COUNT
        refuse(
            [
                Problem(
                    "counts",
                    self.counts,
                    f"must be at least 1 each, and at most {_LARGEST_COUNT} points in all",
                )
            ]
            * wrong
        )
        return self


class RestSettings(Section):
    """Table `rest`: when the stage is considered at rest, and the time limit for a point."""

    drift_mm: Positive = 0.2
    """Largest distance between the means of the first and the last third of a point's samples."""
    timeout_s: Positive = 30.0
    """Longest time to obtain the samples of a point."""


class GridFile(Section):
    """Contents of a grid file."""

    environment: Title
    """Value of the column `environment`."""
    samples: int = count(100, least=2, most=_LARGEST_COUNT)
    """Samples of each sensor per point and repeat."""
    repeats: int = count(5, least=1, most=_LARGEST_COUNT)
    """Number of passes through the grid."""
    sensors: dict[str, Title] = Field(default_factory=lambda: {TIP: TIP})
    """Sensors on the stage: value of the column `sensor` (tip, reference) by the tracker's name of the sensor."""
    grid: Lattice | None = None
    points_mm: Annotated[tuple[_Vector, ...], Field(strict=False)] = ()
    """List of points in the stage's frame, instead of `grid`."""
    settle_s: NonNegative = 0.0
    """Waiting time at each point before sampling."""
    rest: RestSettings = RestSettings()

    @model_validator(mode="after")
    def _check_together(self) -> "GridFile":
        ambiguous = (self.grid is None) == (not self.points_mm)
        unnamed = not self.sensors
        repeated = [point for n, point in enumerate(self.points_mm) if point in self.points_mm[:n]][:1]
        refuse(
            [Problem("grid", None, "give either the table grid or the list points_mm")] * ambiguous
            + [Problem("sensors", None, 'must name at least one sensor, such as tip = "tip"')] * unnamed
            + [Problem("points_mm", point, "is listed twice") for point in repeated]
            + _check_names(self.sensors)
        )
        return self


def _check_names(sensors: dict[str, str]) -> list[Problem]:
    """Return a problem for each sensor whose name in the table is already used."""
    first = {label: name for name, label in reversed(sensors.items())}
    return [
        Problem(f"sensors.{name}", label, f"is already the name of {first[label]}: use a different one")
        for name, label in sensors.items()
        if first[label] != name
    ]


@dataclass(frozen=True)
class GridStop:
    """A grid point in one repeat: repeat and point_id count from 1; position (mm) in the stage's frame."""

    repeat: int
    point_id: int
    position: Point


@dataclass(frozen=True)
class StageGrid:
    """The points at which a tracker is recorded, with the settings of the recording."""

    file: GridFile
    points: tuple[Point, ...]

    def stops(self) -> Iterator[GridStop]:
        """Yield all points of the first repeat, then of the next."""
        for repeat in range(1, self.file.repeats + 1):
            for number, position in enumerate(self.points, 1):
                yield GridStop(repeat, number, position)


def read_grid(source: str) -> StageGrid:
    """Return a shipped grid by its name, or the grid of a TOML file. Raises FileError."""
    file = GRIDS.load(source, GridFile)
    return StageGrid(file, file.points_mm or _list_points(file.grid or Lattice()))


def _list_points(lattice: Lattice) -> tuple[Point, ...]:
    axes = [
        [start + step * k for k in range(n)]
        for start, step, n in zip(lattice.origin_mm, lattice.spacing_mm, lattice.counts, strict=True)
    ]
    return tuple((x, y, z) for x, y, z in product(*axes))
