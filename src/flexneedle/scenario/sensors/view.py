"""A calibrated camera, or an X-ray projection: points of the needle in its image."""

from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive
from flexneedle.scenario.sensors.crossing import cross, passed, to_stations
from flexneedle.scenario.sensors.points import Coordinate, Range
from flexneedle.scenario.sensors.sensor import Keys
from flexneedle.types import Matrix, Needles, Reading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_STATIONS = 12
_MODEL_MM = 0.03

Row = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate], Field(strict=False)]


class View(Range):
    """One `[[sensor]]` with `kind = "view"`.

    A value is a coordinate across the insertion axis in the image; coordinates along it are not used.
    """

    common_offset = True
    keys = Keys("noise_px", "pose_sd_px", "wander_px")
    unit = 1.0, "px"

    kind: Literal["view"]
    projection: Annotated[
        tuple[Row, Row, Row], Field(strict=False, json_schema_extra={"allowed": "3 lists of 4 numbers"})
    ]
    """Matrix (3, 4): (column w, row w, w) in pixels = projection · (x, y, z, 1) in mm."""
    rate_hz: Positive = 10.0
    """Images per second."""
    delay_s: NonNegative = 0.1
    """Age of an image on arrival."""
    noise_px: Positive = 1.0
    """Standard deviation of the white noise across the needle."""
    pose_sd_px: NonNegative = 1.0
    """Prior standard deviation of the constant error across the needle, by the calibration."""
    wander_px: NonNegative = 0.0
    """Standard deviation of noise that is correlated over `wander_s`."""

    @model_validator(mode="after")
    def _sees_the_axis(self) -> Self:
        image = np.array(self.projection) @ [[self.from_mm, self.to_mm], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]
        if image[2].prod() <= 0.0:
            rule = "the insertion axis must be in front of the camera"
            refuse([Problem("projection", self.projection[2], rule)])
        if np.linalg.norm(np.diff(image[:2] / image[2])) < 1.0:
            rule = "must show the insertion axis longer than a pixel"
            refuse([Problem("projection", self.projection[0], rule)])
        return self

    def _pixels(self, points: "Floats") -> "Floats":
        """Return pixels (…, 2) of points (…, 3), mm."""
        matrix = np.array(self.projection)
        image = points @ matrix[:, :3].T + matrix[:, 3]
        found: Floats = image[..., :2] / image[..., 2:]
        return found

    @property
    def _axis(self) -> tuple["Floats", "Floats", float]:
        """Pixel at `from_mm`, directions along and across the insertion axis (2, 2), and its length in pixels."""
        start, end = self._pixels(np.array([[self.from_mm, 0.0, 0.0], [self.to_mm, 0.0, 0.0]]))
        length = float(np.linalg.norm(end - start))
        along, down = (end - start) / length
        return start, np.array([[along, down], [-down, along]]), length

    def _in_image(self, pixels: "Floats") -> tuple["Floats", "Floats"]:
        """Return pixels (…, 2) along (…) and across (…, 1) the insertion axis."""
        start, directions, _ = self._axis
        places = (pixels - start) @ directions.T
        return places[..., 0], places[..., 1:]

    @property
    def stations(self) -> "Floats":
        """Pixels (s,) along the axis at which readings are compared."""
        return np.linspace(0.0, self._axis[2], _STATIONS)

    @property
    def alike(self) -> int:
        """Return the number of stations: the model's error is one of the shape."""
        return _STATIONS

    def size(self, axes: int) -> int:
        """Return the number of stations."""
        del axes
        return _STATIONS

    def predict(self, needles: Needles, axes: int) -> "Floats":
        """Return the pixels (m, s) across the axis at the stations."""
        del axes
        along, across = self._in_image(self._pixels(needles.points))
        return cross(along, across, self.stations)[..., 0]

    def sees(self, needles: Needles, axes: int) -> "Flags":
        """Return which stations are between base and tip (m, s)."""
        del axes
        return passed(self._in_image(self._pixels(needles.points))[0], self.stations, 1)

    def model_error(self, values: "Floats") -> "Floats":
        """Return standard deviations (r, d), pixels."""
        return np.full(values.shape, _MODEL_MM * self._axis[2] / (self.to_mm - self.from_mm))

    def read(self, reading: Reading, needle: Needles, axes: int) -> "Floats":
        """Return the pixels across the axis at the stations of points in the image."""
        del axes
        if not reading.rows:
            return np.full(_STATIONS, np.nan)
        rows = np.array(reading.rows)
        if rows.shape[1] != 2:
            raise ValueError(f"rows of {rows.shape[1]} numbers, expected column and row")
        along, across = self._in_image(rows)
        return to_stations(along, across, self.stations, self._in_image(self._pixels(needle.points[0])))

    def report(self, values: "Floats", axes: int) -> Matrix:
        """Return column and row of the stations with values."""
        del axes
        start, directions, _ = self._axis
        rows = start + np.column_stack([self.stations, values]) @ directions
        return tuple(tuple(row) for row in rows[np.isfinite(rows).all(axis=1)].tolist())
