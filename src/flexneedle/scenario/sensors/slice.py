"""An image plane that the needle crosses, such as a slice of ultrasound, CT or MRI."""

import math
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, field_validator

from flexneedle.scenario.sections.environment import Direction
from flexneedle.scenario.sections.fields import LARGEST, NonNegative, Positive
from flexneedle.scenario.sensors.crossing import cross, passed
from flexneedle.scenario.sensors.sensor import KeyedSensor, Keys, SensorErrors
from flexneedle.types import Matrix, Needles, Reading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_MODEL_MM = 0.03
_MOST_TILT_DEG = 80.0


class PlaneErrors(SensorErrors):
    """Table `phantom` of a sensor `slice`."""

    place_mm: NonNegative = 0.3
    """Largest displacement of the image, on each axis."""
    tilt_deg: NonNegative = 1.0
    """Largest rotation of the image, about each axis."""


class Slice(KeyedSensor):
    """One `[[sensor]]` with `kind = "slice"`."""

    paired = True
    keys = Keys("noise_mm", "pose_sd_mm", "wander_mm")
    unit = 1.0, "mm"

    kind: Literal["slice"]
    plane_mm: Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
    """x at which the plane meets the insertion axis."""
    normal: Direction = (1.0, 0.0, 0.0)
    """Normal x, y, z of the plane, of any length, at most 80° from x."""
    rate_hz: Positive = 10.0
    """Images per second."""
    delay_s: NonNegative = 0.1
    """Age of an image on arrival."""
    noise_mm: Positive = 0.5
    """Standard deviation of the white noise of a coordinate in the plane."""
    pose_sd_mm: NonNegative = 0.3
    """Prior standard deviation of the constant error of a coordinate: of the plane's pose."""
    wander_mm: NonNegative = 0.0
    """Standard deviation of noise that is correlated over `wander_s`."""
    phantom: PlaneErrors = PlaneErrors()
    _shift: Any = PrivateAttr((0.0, 0.0, 0.0))  # of the true image (mm)
    _turn: Any = PrivateAttr((0.0, 0.0, 0.0))  # its rotation vector (rad)

    @field_validator("normal")
    @classmethod
    def _crosses(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        angle = math.degrees(math.acos(min(1.0, abs(normal[0]) / math.hypot(*normal))))
        if angle > _MOST_TILT_DEG:
            raise ValueError(f"must be at most {_MOST_TILT_DEG:g}° from x, not {angle:.1f}°")
        return normal

    @cached_property
    def frame(self) -> "Floats":
        """Rows (3, 3): normal, and the directions in the plane nearest to y and to z."""
        normal = np.array(self.normal) / np.linalg.norm(self.normal)
        normal *= math.copysign(1.0, normal[0])
        across = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
        across /= np.linalg.norm(across)
        return np.array([normal, across, np.cross(normal, across)])

    def _in_frame(self, points: "Floats", count: int = 3) -> "Floats":
        """Return the first coordinates (…, count) of points (…, 3): the distance from the plane, and two in it."""
        frame = self.frame
        if any(self._turn):
            frame = frame + np.cross(self._turn, frame)  # of a small rotation
        origin = [self.plane_mm + self._shift[0], *self._shift[1:]]
        found: Floats = points @ frame[:count].T - frame[:count] @ origin
        return found

    def predict(self, needles: Needles, axes: int) -> "Floats":
        """Return the coordinates (m, axes), mm, of the crossing in the plane."""
        points = needles.points
        crossing = cross(self._in_frame(points, 1)[..., 0], points, np.zeros(1))[:, 0]
        return self._in_frame(crossing)[:, 1 : 1 + axes]

    def sees(self, needles: Needles, axes: int) -> "Flags":
        """Return flags (m, axes): True for needles that have passed the plane."""
        return passed(self._in_frame(needles.points, 1)[..., 0], np.zeros(1), axes)

    def model_error(self, values: "Floats") -> "Floats":
        """Return standard deviations (r, d), mm."""
        return np.full(values.shape, _MODEL_MM)

    def read(self, reading: Reading, needle: Needles, axes: int) -> "Floats":
        """Return the coordinates in the plane of x, y, z (mm)."""
        del needle
        if not reading.rows:
            return np.full(axes, np.nan)
        if np.shape(reading.rows) != (1, 3):
            raise ValueError(
                f"{len(reading.rows)} rows of {len(reading.rows[0])} numbers, expected one x, y, z"
            )
        return self._in_frame(np.array(reading.rows[0]))[1 : 1 + axes]

    def report(self, values: "Floats", axes: int) -> Matrix:
        """Return x, y, z (mm) of coordinates in the plane."""
        inside = np.append(values, 0.0)[:2] if axes == 1 else values
        x, y, z = ([self.plane_mm, 0.0, 0.0] + inside @ self.frame[1:]).tolist()
        return ((x, y, z),)

    def mounted(self, rng: np.random.Generator) -> Self:
        """Return the sensor with its image displaced and rotated; its values are in the image's own axes."""
        image = self.model_copy()
        image._shift = rng.uniform(-1.0, 1.0, 3) * self.phantom.place_mm
        image._turn = np.radians(rng.uniform(-1.0, 1.0, 3) * self.phantom.tilt_deg)
        return image

    def drawn_offset(self, rng: np.random.Generator, axes: int) -> "Floats":
        """Return 0: its pose has the error."""
        del rng
        return np.zeros(axes)
