"""Positions along the needle in space, as a segmentation of an image gives them."""

from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import LARGEST, NonNegative, Positive
from flexneedle.scenario.sensors.crossing import cross, passed, to_stations
from flexneedle.scenario.sensors.sensor import KeyedSensor, Keys, SensorErrors
from flexneedle.types import Matrix, Needles, Reading, X

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_STATIONS = 12
_MODEL_MM = 0.03

Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class PlaceErrors(SensorErrors):
    """Table `phantom` of a sensor `points`."""

    place_mm: NonNegative = 0.3
    """Largest displacement of all points, on each axis."""


class Range(KeyedSensor):
    """A sensor that measures the needle from one x to another."""

    from_mm: Coordinate = 0.0
    """x from which points are used."""
    to_mm: Coordinate
    """x up to which points are used."""

    @model_validator(mode="after")
    def _rise(self) -> Self:
        if self.to_mm <= self.from_mm:
            refuse([Problem("to_mm", self.to_mm, f"must be above from_mm ({self.from_mm:g})")])
        return self


class Points(Range):
    """One `[[sensor]]` with `kind = "points"`."""

    common_offset = True
    paired = True
    keys = Keys("noise_mm", "place_sd_mm", "wander_mm")
    unit = 1.0, "mm"

    kind: Literal["points"]
    rate_hz: Positive = 2.0
    """Readings per second."""
    delay_s: NonNegative = 0.2
    """Age of a reading on arrival."""
    noise_mm: Positive = 0.5
    """Standard deviation of the white noise of a coordinate across the needle."""
    place_sd_mm: NonNegative = 0.3
    """Prior standard deviation of the constant error of a coordinate, by the registration."""
    wander_mm: NonNegative = 0.0
    """Standard deviation of noise that is correlated over `wander_s`."""
    phantom: PlaceErrors = PlaceErrors()

    @property
    def stations(self) -> "Floats":
        """X (s,) at which readings are compared; a point is shifted to the nearest along the predicted needle."""
        return np.linspace(self.from_mm, self.to_mm, _STATIONS)

    @property
    def alike(self) -> int:
        """Return the number of stations: the model's error is one of the shape."""
        return _STATIONS

    def size(self, axes: int) -> int:
        """Return the number of coordinates across the needle."""
        return axes * _STATIONS

    def predict(self, needles: Needles, axes: int) -> "Floats":
        """Return the lateral positions (m, d), mm, at the stations."""
        points = needles.points
        return cross(points[..., X], points[..., 1 : 1 + axes], self.stations).reshape(len(points), -1)

    def sees(self, needles: Needles, axes: int) -> "Flags":
        """Return which stations are between base and tip (m, d)."""
        return passed(needles.points[..., X], self.stations, axes)

    def model_error(self, values: "Floats") -> "Floats":
        """Return standard deviations (r, d), mm."""
        return np.full(values.shape, _MODEL_MM)

    def read(self, reading: Reading, needle: Needles, axes: int) -> "Floats":
        """Return the lateral positions at the stations of points x, y, z (mm)."""
        if not reading.rows:
            return np.full(self.size(axes), np.nan)
        rows, nodes = np.array(reading.rows), needle.points[0]
        if rows.shape[1] != 3:
            raise ValueError(f"rows of {rows.shape[1]} numbers, expected x, y, z")
        curve = nodes[:, X], nodes[:, 1 : 1 + axes]
        return to_stations(rows[:, X], rows[:, 1 : 1 + axes], self.stations, curve)

    def report(self, values: "Floats", axes: int) -> Matrix:
        """Return x, y, z (mm) of the stations with values."""
        across = np.zeros((_STATIONS, 2))
        across[:, :axes] = values.reshape(-1, axes)
        rows = np.column_stack([self.stations, across])
        return tuple(tuple(row) for row in rows[np.isfinite(rows).all(axis=1)].tolist())

    def drawn_offset(self, rng: np.random.Generator, axes: int) -> "Floats":
        """Return the displacement of all points; along the needle it acts by the slope, which is small."""
        return np.tile(rng.uniform(-1.0, 1.0, axes) * self.phantom.place_mm, _STATIONS)
