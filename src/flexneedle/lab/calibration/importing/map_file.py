"""The map of a laboratory's recordings: what each column is, in which unit and which axes (a TOML file)."""

import re
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from flexneedle.lab.calibration.session import GuideOrder
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import Positive, Section
from flexneedle.scenario.sections.registration import Registration

LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "inch": 25.4}
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_AXIS = re.compile(r"[+-]?[xyz]")
MAPS = Library("a map of recordings")


def _direction(text: str) -> str:
    if not _AXIS.fullmatch(text):
        raise ValueError('must be an axis with its sign: "x", "-y" …')
    return text


Column = Annotated[str, Field(min_length=1, max_length=200)]
"""A column by its header, with a minus sign before it to invert its sign."""
Columns = Annotated[tuple[Column, ...], Field(strict=False)]
Three = Annotated[tuple[Column, Column, Column], Field(strict=False)]
Direction = Annotated[str, AfterValidator(_direction)]


class TableMap(Section):
    """Section `table`: how the tables are divided into insertions."""

    insertion: Columns = ()
    """Columns that name an insertion. Not set: each file is one."""
    session: Columns = ()
    """Columns that name a session. Not set: all files are one, with the name of their folder."""
    topics: Columns = ()
    """Pose topics of a bag, the first with the times of the rows; columns are then TOPIC.x, TOPIC.qx and so on."""


class TimeMap(Section):
    """Section `time`."""

    columns: Columns = ()
    """One column, or two: seconds and nanoseconds."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of a single column."""


class TipMap(Section):
    """Section `tip`: the measured tip."""

    position: Three
    """Columns of the position on the axes x, y, z of the tracker."""
    unit: Literal["mm", "cm", "m", "um", "inch"] = "mm"
    """Unit of the position."""
    axis: Three | None = None
    """Columns of the needle's axis, a vector on the axes of the tracker."""
    quaternion: Annotated[tuple[Column, Column, Column, Column], Field(strict=False)] | None = None
    """Columns of the sensor's orientation, instead of `axis`."""
    order: Literal["wxyz", "xyzw"] = "xyzw"
    """Order of the quaternion."""
    sensor_axis: Direction = "z"
    """Axis of the sensor that is along the needle, towards the tip."""


class StageMap(Section):
    """Section `guide` or `base`: a stage that moves the needle laterally."""

    y: Column
    """Column of the position along y of the needle's frame."""
    z: Column | None = None
    """Column of the position along z."""
    unit: Literal["mm", "cm", "m", "um", "inch"] = "mm"
    """Unit of the position."""


class RollMap(Section):
    """Section `roll`: the angle of the needle about its axis."""

    column: Column
    """Column of the angle."""
    unit: Literal["rad", "deg", "mrad"] = "rad"
    """Unit of the angle."""


class FrameMap(Section):
    """Section `frame`: the needle's frame in the axes of the tracker, which the needle enters along x."""

    x: Direction
    """Axis of the tracker along the insertion."""
    y: Direction
    """Axis of the tracker along y; z follows, right-handed."""
    skin_mm: float | None = None
    """Position of the skin along x. Not set: of the first step of each insertion, less `first_depth_mm`."""
    first_depth_mm: float = 0.0
    """Depth of the first step."""
    registration: Registration | None = None
    """Rigid map from the tracker's frame to the one whose axes `x` and `y` name. Not set: identity."""

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        if self.x[-1] == self.y[-1]:
            refuse([Problem("y", self.y, f"must be another axis than x ({self.x})")])
        return self

    @property
    def rotation(self) -> Any:
        """Rotation (3, 3) from the tracker's axes to the needle's."""
        first, second = _unit(self.x), _unit(self.y)
        return np.stack([first, second, np.cross(first, second)])


class StepMap(Section):
    """Section `steps`: how steps are found."""

    rows: Literal["steps", "stream"] = "steps"
    """"steps": each row is a step with the needle at rest. "stream": steps are the still phases of a stream of rows."""
    least_still_s: Positive = 0.5
    """Shortest time for which the needle rests in a step, in a stream."""
    guide: GuideOrder = "before"
    """Whether the guide moves before, with or after the advance to the next step."""
    gap_mm: Positive = 100.0
    """Distance between rows beyond which the recording contradicts itself."""


class RecordingMap(Section):
    """A map of recordings."""

    table: TableMap = TableMap()
    time: TimeMap = TimeMap()
    tip: TipMap
    guide: StageMap | None = None
    base: StageMap | None = None
    roll: RollMap | None = None
    frame: FrameMap
    steps: StepMap = StepMap()

    def columns(self) -> set[str]:
        """Return the names of all columns of numbers, without their signs."""
        tip = self.tip
        names = [*self.time.columns, *tip.position, *(tip.axis or ()), *(tip.quaternion or ())]
        for stage in (self.guide, self.base):
            names += [] if stage is None else [stage.y, *([stage.z] if stage.z else [])]
        names += [self.roll.column] if self.roll else []
        return {name.lstrip("+-") for name in names}


def _unit(direction: str) -> Any:
    vector = np.zeros(3)
    vector["xyz".index(direction[-1])] = -1.0 if direction.startswith("-") else 1.0
    return vector


def load_map(path: Any) -> RecordingMap:
    """Return the map of a file. Raises FileError, with one line for each problem."""
    return MAPS.load(path, RecordingMap)
