"""The map of a laboratory's recordings: what each column is, in which unit and which axes (a TOML file)."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from flexneedle.lab.calibration.session import GuideOrder
from flexneedle.scenario.files import read_registration
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import Positive, Section, count
from flexneedle.scenario.sections.registration import Registration

LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "inch": 25.4}
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FIT = "fit"
"""An axis of the frame that is estimated."""
MAPS = Library("a map of recordings")
_AXIS = re.compile(r"[+-]?[xyz]")


def _direction(text: str) -> str:
    if not _AXIS.fullmatch(text):
        raise ValueError('must be an axis with its sign: "x", "-y" …')
    return text


def _fitted(text: str) -> str:
    if text != FIT and not _AXIS.fullmatch(text):
        raise ValueError('must be an axis with its sign, "x", "-y" …, or "fit"')
    return text


Column = Annotated[str, Field(min_length=1, max_length=200, json_schema_extra={"allowed": "column"})]
"""A column by its name, with a minus sign before it to invert its sign."""


def _list(shown: str, **bounds: Any) -> Any:
    """Return the field of a list, with the values that the reference shows."""
    return Field(strict=False, json_schema_extra={"allowed": shown}, **bounds)


Columns = Annotated[tuple[Column, ...], _list("list of columns")]
Times = Annotated[tuple[Column, ...], _list("1 or 2 columns", max_length=2)]
Position = Annotated[tuple[Column, ...], _list("2 or 3 columns", min_length=2, max_length=3)]
Angles = Annotated[tuple[Column, ...], _list("1 or 2 columns", min_length=1, max_length=2)]
Three = Annotated[tuple[Column, Column, Column], _list("3 columns")]
Four = Annotated[tuple[Column, Column, Column, Column], _list("4 columns")]
Texts = Annotated[tuple[str, ...], _list("list of texts")]
Numbers = Annotated[tuple[float, ...], _list("list of numbers")]
Direction = Annotated[str, AfterValidator(_direction), Field(json_schema_extra={"allowed": "`x`, `-y` …"})]
FrameAxis = Annotated[
    str, AfterValidator(_fitted), Field(json_schema_extra={"allowed": "`x`, `-y` …, `fit`"})
]
LengthUnit = Literal["mm", "cm", "m", "um", "inch"]
AngleUnit = Literal["rad", "deg", "mrad"]
TimeUnit = Literal["s", "ms", "us", "ns"]


class TableMap(Section):
    """Section `table`: rows and columns of the files, and their division into insertions."""

    insertion: Columns = ()
    """Columns whose values name an insertion. Not set: each file is one, with the name of the file."""
    session: Columns = ()
    """Columns whose values name a session: one needle, rig and tissue. Not set: the folder of the file."""
    columns: Columns = ()
    """Names of all columns of a text file without a line of names."""
    lines_after_header: int = count(0, least=0, most=1000)
    """Lines between the names of the columns and the first row, such as a line of units."""
    where: dict[str, str] = Field(default={}, json_schema_extra={"allowed": "table of texts"})
    """Values by column: other rows are ignored, such as rows of other sensors."""
    missing: Numbers = ()
    """Numbers, such as -999 or 0: a position whose coordinates all are one of them is missing."""


class TimeMap(Section):
    """Section `time`: optional for keyed steps. Bags have the time at which a message was recorded."""

    columns: Times = ()
    """A column of numbers, dates (ISO 8601) or times of day; or two, which are added: seconds and nanoseconds, or date
    and time of day."""
    unit: TimeUnit = "s"
    """Unit of the first column."""
    second_unit: TimeUnit = "ns"
    """Unit of the second column."""


class TipMap(Section):
    """Section `tip`: the measured tip, and the direction of the needle there in one of three forms."""

    position: Position
    """Columns of the position on the axes x, y, z of the tracker; two columns, x and y, for data in a plane."""
    unit: LengthUnit = "mm"
    """Unit of the position."""
    axis: Position | None = None
    """Columns of the needle's axis, a unit vector on the axes of the tracker, towards the tip."""
    quaternion: Four | None = None
    """Columns of the sensor's orientation, a unit quaternion from the sensor's axes to the tracker's."""
    order: Literal["wxyz", "xyzw"] = "xyzw"
    """Order of the quaternion."""
    sensor_axis: Direction = "z"
    """Axis of the sensor along the needle, towards the tip."""
    angle: Angles | None = None
    """Columns of the angle of the needle from x of its frame towards y, in space also towards z."""
    angle_unit: AngleUnit = "rad"
    """Unit of the angles."""
    status: str | None = None
    """Column of the sensor's status; rows with another status than `ok` have no position."""
    ok: Texts = ("ok",)
    """Values of the status of a measured position, in capital or small letters."""

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        given = [name for name in ("axis", "quaternion", "angle") if getattr(self, name) is not None]
        problems = [
            Problem(each, getattr(self, each), f"not beside {given[0]}: keep one") for each in given[1:]
        ]
        three = [name for name in given if len(getattr(self, name)) > 2 and name != "angle"]
        if three and len(self.position) == 2:
            problems.append(Problem("position", self.position, f"must have three columns beside {three[0]}"))
        refuse(problems)
        return self


class StageMap(Section):
    """A stage that moves the guide or the base of the needle laterally."""

    y: Column | None = None
    """Column of the position along y of the needle's frame."""
    z: Column | None = None
    """Column of the position along z."""
    position: Three | None = None
    """Instead of y and z: columns of the position on the axes x, y, z of the tracker."""
    unit: LengthUnit = "mm"
    """Unit of the position."""

    @model_validator(mode="after")
    def _check_columns(self) -> Self:
        if (self.position is None) == (self.y is None and self.z is None):
            refuse([Problem((), None, "must have y, z or both; or position alone")])
        return self


class RollMap(Section):
    """Section `roll`: the rotation of the needle about its axis. Not set: the needle is not rotated."""

    column: Column
    """Column of the angle from y towards z."""
    unit: AngleUnit = "rad"
    """Unit of the angle."""


class FrameMap(Section):
    """Section `frame`: the needle's frame in the axes of the tracker, which the needle enters along x."""

    x: FrameAxis = "x"
    """Axis of the tracker along the insertion. "fit": the mean direction at the start of a session's insertions."""
    y: FrameAxis = "y"
    """Axis of the tracker along y, or closest to y if x is fitted; z follows, right-handed. "fit": from the turns of
    the tip after motions of the guide."""
    plane: bool = False
    """Leave z out, so that the session has one lateral axis. Positions of two columns are in a plane in any case."""
    skin_mm: float | None = None
    """Position of the skin along x. Not set: `first_depth_mm` before the first step of each insertion."""
    first_depth_mm: float = 0.0
    """Depth of the first step; negative: the needle starts in air."""
    registration: Registration | None = None
    """Rigid map from the tracker's frame to the one whose axes `x` and `y` name. Not set: identity."""
    registration_file: str | None = None
    """Instead of `registration`: the file of `flexneedle em register`, relative to the map."""

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        problems = []
        if self.x != FIT and self.x[-1] == self.y[-1]:
            problems.append(Problem("y", self.y, f"must be another axis than x ({self.x})"))
        if self.skin_mm is not None and self.first_depth_mm != 0.0:
            problems.append(Problem("first_depth_mm", self.first_depth_mm, "not beside skin_mm: keep one"))
        if self.x == FIT and self.skin_mm is not None:
            problems.append(Problem("skin_mm", self.skin_mm, 'not with x = "fit": set first_depth_mm'))
        if self.registration is not None and self.registration_file is not None:
            problems.append(
                Problem("registration_file", self.registration_file, "not beside registration: keep one")
            )
        refuse(problems)
        return self


class StepMap(Section):
    """Section `steps`: the states of the needle at rest."""

    rows: Literal["steps", "stream"] = "steps"
    """"steps": each row is a step, with the needle at rest. "stream": rows are a continuous recording, and its still
    phases are steps."""
    least_still_s: Positive = 1.0
    """Shortest rest of a step in a stream."""
    every_mm: Positive | None = None
    """A step in a stream each time that the tip has advanced by this distance, for insertions without rests."""
    guide: GuideOrder = "before"
    """Motion of the guide before, with or after the advance to the next step."""
    gap_mm: Positive = 100.0
    """Distance between two rows beyond which a recording is refused."""
    retreat_mm: Positive = 2.0
    """Retreat of the tip at which a recording ends: a withdrawal."""

    @model_validator(mode="after")
    def _check_stream(self) -> Self:
        if self.every_mm is not None and self.rows == "steps":
            refuse([Problem("every_mm", self.every_mm, 'needs rows = "stream"')])
        return self


class SensorMap(Section):
    """One `[[sensor]]`: readings of a sensor along the needle, in the same file as the tip or in a table beside it."""

    name: Annotated[str, Field(min_length=1)]
    """Name of the sensor in the scenario: its `name`, or its `kind`."""
    file: str = "{name}{suffix}"
    """Its table, relative to the tip's file, whose name without and with its suffix replace `{name}` and `{suffix}`:
    "{name}_fbg.csv" or "fbg/{name}.csv". Not set: the tip's file."""
    time: TimeMap | None = None
    """Time of a reading, on the clock of the tip. Not set: columns and units of `[time]`."""
    curvature: Columns = ()
    """Columns of the curvature towards y of each site, from the tip on; in space of y, then z at each site. Axes: the
    needle's frame where the roll is 0."""
    curvature_unit: Literal["1/m", "1/mm"] = "1/m"
    """Unit of the curvatures."""
    position: Columns = ()
    """Instead of curvatures: columns x, y, z of a point on the axes of the tracker, or of several points in a row. Rows
    with the same time are one reading."""
    unit: LengthUnit = "mm"
    """Unit of the positions."""
    pixels: Columns = ()
    """Instead of curvatures: column and row of a point in an image, or of several. Rows with the same time are one
    reading."""
    within_s: Positive = 0.5
    """Longest time from the time of a step to a reading that counts for it; the needle must be at rest."""

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        given = [key for key in ("curvature", "position", "pixels") if getattr(self, key)]
        if len(given) != 1:
            refuse([Problem((), None, "must have one of curvature, position and pixels")])
        size = {"curvature": 1, "position": 3, "pixels": 2}[given[0]]
        if len(self.values) % size:
            refuse([Problem(given[0], self.values, f"must be {size} columns for each point")])
        return self

    @property
    def values(self) -> tuple[str, ...]:
        """Columns of the values."""
        return self.curvature or self.position or self.pixels

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the columns of numbers, without their signs."""
        return tuple(dict.fromkeys(map(to_name, self.values)))

    def path(self, tip: Path) -> Path:
        """Return the file of the sensor for the tip's file."""
        return tip.parent / self.file.replace("{name}", tip.stem).replace("{suffix}", tip.suffix)


class RecordingMap(Section):
    """A map of recordings."""

    table: TableMap = TableMap()
    time: TimeMap = TimeMap()
    tip: TipMap
    guide: StageMap | None = None
    base: StageMap | None = None
    roll: RollMap | None = None
    frame: FrameMap = FrameMap()
    steps: StepMap = StepMap()
    sensor: Annotated[tuple[SensorMap, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        named = [(key, to_name(column)) for key, column in self._columns()]
        first = {name: key for key, name in reversed(named)}
        problems = [
            Problem(key, name, f"is the column of {first[name]}, too")
            for key, name in named
            if first[name] != key
        ]
        if len(self.tip.position) == 2 and (self.frame.registration or self.frame.registration_file):
            rule = "must have three columns beside frame.registration"
            problems.append(Problem("tip.position", self.tip.position, rule))
        if len(self.tip.position) == 2 and "z" in (self.frame.x + self.frame.y):
            problems.append(
                Problem("frame", None, "x and y must be the axes x and y, as tip.position has two columns")
            )
        problems += self._check_sensors()
        refuse(problems)
        return self

    def _check_sensors(self) -> Iterator[Problem]:
        names = [each.name for each in self.sensor]
        for n, each in enumerate(self.sensor):
            if each.name in names[:n]:
                yield Problem(("sensor", n, "name"), each.name, "another sensor has this name")
            if len(each.curvature) % self.axes:
                yield Problem(("sensor", n, "curvature"), each.curvature, "must be y and z of each site")

    @property
    def axes(self) -> int:
        """Lateral axes of the session."""
        return 1 if self.frame.plane or len(self.tip.position) == 2 else 2

    @property
    def text(self) -> tuple[str, ...]:
        """Names of the columns of text."""
        status = [self.tip.status] if self.tip.status else []
        return (*self.table.session, *self.table.insertion, *self.table.where, *status)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the columns of numbers, without their signs; the tip's are first."""
        return tuple(dict.fromkeys(to_name(column) for _, column in self._columns()))

    def _columns(self) -> Iterator[tuple[str, str]]:
        """Yield the key and the column of each number but the time."""
        tip = self.tip
        for name in ("position", "axis", "quaternion", "angle"):
            for k, column in enumerate(getattr(tip, name) or ()):
                yield f"tip.{name}[{k}]", column
        for key in ("guide", "base"):
            stage = getattr(self, key)
            if stage is not None:
                yield from ((f"{key}.{axis}", getattr(stage, axis)) for axis in "yz" if getattr(stage, axis))
                yield from ((f"{key}.position[{k}]", each) for k, each in enumerate(stage.position or ()))
        if self.roll:
            yield "roll.column", self.roll.column


def to_name(column: str) -> str:
    """Return the name of a column without its sign."""
    return column[1:] if column[:1] in ("+", "-") and len(column) > 1 else column


def load_map(path: Path) -> RecordingMap:
    """Return the map of a file. Raises FileError, with one line for each problem, and for its registration."""
    found = MAPS.load(path, RecordingMap)
    if found.frame.registration_file is None:
        return found
    given = read_registration(path.parent / found.frame.registration_file)
    frame = found.frame.model_copy(update={"registration": given, "registration_file": None})
    return found.model_copy(update={"frame": frame})
