"""The grid that a tracker is measured on: a TOML file, every problem in one line."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from typing import Annotated

from pydantic import Field, model_validator

from flexneedle.rig.tracking.table import TIP
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title, count
from flexneedle.types import Point

GRIDS = Library("a grid file", "grid", files(__package__) / "grids")
_MOST = 100_000

_Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Lattice(Section):
    """Table `grid`: points at even distances, x slowest and z fastest."""

    origin_mm: _Vector = (0.0, 0.0, 0.0)
    """The first point, in the frame of the stage."""
    spacing_mm: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] = (25.0, 25.0, 25.0)
    """Distance between neighbours along x, y, z."""
    counts: Annotated[tuple[int, int, int], Field(strict=False)] = (5, 5, 5)
    """Points along x, y, z."""

    @model_validator(mode="after")
    def _check_counts(self) -> "Lattice":
        wrong = min(self.counts) < 1 or self.counts[0] * self.counts[1] * self.counts[2] > _MOST
        refuse(
            [Problem("counts", self.counts, f"must be at least 1 each, and {_MOST} points at most")] * wrong
        )
        return self


class Rest(Section):
    """Table `rest`: when the stage counts as at rest, and for how long a point is tried."""

    drift_mm: Positive = 0.2
    """The means of the first and the last third of a point's samples may differ by this distance."""
    timeout_s: Positive = 30.0
    """Longest wait for the samples of a point."""


class GridFile(Section):
    """A grid as in its file."""

    environment: Title
    """Goes into the column `environment`."""
    samples: int = count(100, least=2, most=_MOST)
    """Of each sensor at each point, in each repeat."""
    repeats: int = count(5, least=1, most=_MOST)
    """Number of visits of the whole grid."""
    sensors: dict[str, Title] = Field(default_factory=lambda: {TIP: TIP})
    """Sensors on the stage: the tracker's name, and the name in the column `sensor` (tip, reference)."""
    grid: Lattice | None = None
    points_mm: Annotated[tuple[_Vector, ...], Field(strict=False)] = ()
    """Points in the frame of the stage, instead of `grid`."""
    settle_s: NonNegative = 0.0
    """Wait at each point before the samples are taken."""
    rest: Rest = Rest()

    @model_validator(mode="after")
    def _check_together(self) -> "GridFile":
        both = (self.grid is None) == (not self.points_mm)
        none = not self.sensors
        twice = [place for n, place in enumerate(self.points_mm) if place in self.points_mm[:n]][:1]
        refuse(
            [Problem("grid", None, "give either the table grid or the list points_mm")] * both
            + [Problem("sensors", None, 'must name at least one sensor, such as tip = "tip"')] * none
            + [Problem("points_mm", place, "is listed twice") for place in twice]
            + _shared_names(self.sensors)
        )
        return self


def _shared_names(sensors: dict[str, str]) -> list[Problem]:
    """Two sensors of one name in the table could not be distinguished."""
    first = {own: name for name, own in reversed(sensors.items())}
    return [
        Problem(f"sensors.{name}", own, f"is the name of {first[own]}, too: give each sensor its own")
        for name, own in sensors.items()
        if first[own] != name
    ]


@dataclass(frozen=True)
class Stop:
    """A point in one repeat: repeat and point_id count from 1; place (mm) in the frame of the stage."""

    repeat: int
    point_id: int
    place: Point


@dataclass(frozen=True)
class Grid:
    """A grid to visit. sensors: name in the table by name in the tracker's frames."""

    file: GridFile
    points: tuple[Point, ...]

    def stops(self) -> Iterator[Stop]:
        """All points of the first repeat, then of the next."""
        for repeat in range(1, self.file.repeats + 1):
            for number, place in enumerate(self.points, 1):
                yield Stop(repeat, number, place)


def read_grid(source: str) -> Grid:
    """Return the grid of a shipped name or of a TOML file. Raises FileError: file, key, value, rule."""
    file = GRIDS.load(source, GridFile)
    return Grid(file, file.points_mm or _lattice_points(file.grid or Lattice()))


def _lattice_points(lattice: Lattice) -> tuple[Point, ...]:
    axes = [
        [start + step * k for k in range(n)]
        for start, step, n in zip(lattice.origin_mm, lattice.spacing_mm, lattice.counts, strict=True)
    ]
    return tuple((x, y, z) for x, y, z in product(*axes))
