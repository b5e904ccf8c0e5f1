"""A sensor along the needle: the common part of all kinds.

A kind predicts what an error-free sensor measures on a needle, and gives the sizes of the errors. A reading is

    (1 + g) e^(i(ρ − φ)) (q + q' p) + o + d + w + ε

with the quantity q of the needle (`predict`), its derivative q' (`slopes`) to the places p of the sensor, gain error g,
turn ρ, offset o, drift d (which grows with the depth), wander w (correlated over time) and white noise ε; φ is the
angle of the needle for a sensor that rolls with it, else 0. The kind chooses the unit of its values, the same in all
methods.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field

from flexneedle.errors import DriverError
from flexneedle.scenario.sections.fields import LARGEST, Fraction, NonNegative, Positive, Section, Title
from flexneedle.types import Matrix, Needles, Reading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_MODEL_NOISE = 0.3  # model error of a kind without its own, over its noise


class Fault(Section):
    """Table `phantom.fault` of a `[[sensor]]`: a fault of the virtual sensor."""

    kind: Literal["lost", "frozen", "drift", "outliers", "delayed"]
    """`lost`: no more readings; `frozen`: all repeat the last; `drift`, `outliers`, `delayed`: see `size`."""
    depth_mm: Annotated[float, Field(ge=-LARGEST, le=LARGEST)] = 0.0
    """Depth of the tip at which it begins."""
    size: NonNegative = 1.0
    """Growth of the error of all values per mm of depth, over the noise (`drift`), share of readings (`outliers`), or
    further delay in s (`delayed`)."""


class SensorErrors(Section):
    """Table `phantom` of a `[[sensor]]`: errors of the virtual sensor that the observer does not know.

    They are drawn for each insertion, uniformly where a largest value is given.
    """

    clock_s: NonNegative = 0.0
    """Largest error of the time stamps, to either side."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Share of readings without a value."""
    outlier_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of readings whose error is `outlier_size` times the noise."""
    outlier_size: NonNegative = 20.0
    """Error of an outlier, over the noise."""
    fault: Fault | None = None
    """Not set: none."""


class Keys(NamedTuple):
    """Keys of a kind for its noise, offset and wander, in its `unit`."""

    noise: str = ""
    offset: str = ""
    wander: str = ""


class Sensor(Section):
    """One `[[sensor]]`. A kind is a subclass with its keys, `noise` and `predict`; all else has a default.

    A sensor has d values, `size`, in a unit that the kind chooses. `axes` is 1 for a needle in the plane, 2 in space.
    """

    paired: ClassVar[bool] = False
    """True: values are lateral quantities: y in the plane, in space y and z, one after the other, as a vector."""
    rolls: ClassVar[bool] = False
    """True: the sensor is in the needle and rolls with it. Its values are `paired`."""
    common_offset: ClassVar[bool] = False
    """True: the constant error is a shift of all values together, of each coordinate, as by a registration."""
    keys: ClassVar[Keys] = Keys()
    """Names for the results of `flexneedle sensor check`."""
    unit: ClassVar[tuple[float, str]] = 1.0, ""
    """Factor and unit with which values are shown."""

    kind: str
    """`fbg`, `slice`, `points`, `view` or `module:NAME`."""
    name: Title | None = None
    """Name in messages, tables and figures. Not set: the kind, of `module:NAME` the NAME."""
    rate_hz: Positive = 20.0
    """Readings per second."""
    delay_s: NonNegative = 0.0
    """Age of a reading on arrival, for sensors that do not report the time of measurement."""
    delay_sd_s: NonNegative = 0.0
    """Prior standard deviation of the error of time stamps. 0: they are exact."""
    gain_sd: Fraction = 0.0
    """Prior standard deviation of the gain error of each pair of values, relative."""
    turn_sd_deg: Annotated[float, Field(ge=0, le=90)] = 0.0
    """Prior standard deviation of the turn of the sensor's lateral axes about the needle; in space."""
    wander_s: Positive = 10.0
    """Time over which the wander is correlated."""
    phantom: SensorErrors = SensorErrors()

    @property
    def title(self) -> str:
        """Name in messages."""
        return self.name or self.kind.rpartition(":")[2]

    @property
    def longest_wait(self) -> float:
        """Longest time (s) from the measurement of a reading to the arrival of the next one."""
        return self.delay_s + 1.0 / self.rate_hz

    @property
    def noise(self) -> float:
        """Standard deviation of the white noise of a value, above 0."""
        raise NotImplementedError

    def predict(self, needles: Needles, axes: int) -> "Floats":
        """Return the values (m, d) of an error-free sensor on m needles, smooth functions of their poses.

        They are finite on any needle, where the sensor does not see it (`sees`), too. For a sensor that rolls with the
        needle, as if it did not.
        """
        raise NotImplementedError

    def size(self, axes: int) -> int:
        """Return the number of values d (default: 1, of a paired sensor `axes`)."""
        return axes if self.paired else 1

    def sees(self, needles: Needles, axes: int) -> "Flags":
        """Return which values (m, d) the sensor can measure on needles (default: all)."""
        return np.ones((len(needles.points), self.size(axes)), dtype=bool)

    def model_error(self, values: "Floats") -> "Floats":
        """Return standard deviations (r, d) of the model's error where these values (r, d) were measured.

        It is the error of the mean of a move, which no parameter explains. Default: 0.3 times the noise.
        """
        return np.full(values.shape, _MODEL_NOISE * self.noise)

    @property
    def alike(self) -> int:
        """Number of values in a direction whose errors of the model are the same (default: 1)."""
        return 1

    @property
    def offset_sd(self) -> float:
        """Prior standard deviation of the constant error of a value."""
        return 0.0

    @property
    def place_sds(self) -> tuple[float, ...]:
        """Prior standard deviations of the places p of the sensor, such as of each site (default: all are known)."""
        return ()

    @property
    def drift_sd(self) -> float:
        """Standard deviation of an error of all values that grows from the skin to the target's depth."""
        return 0.0

    @property
    def wander_sd(self) -> float:
        """Standard deviation of the correlated noise of a value."""
        return 0.0

    @property
    def resolution(self) -> float:
        """Step of the values; 0: repeated values are the sign of a frozen sensor."""
        return 0.0

    def slopes(self, needles: Needles, axes: int) -> "Floats":
        """Return the derivatives (m, d, p) of the values to the places of the sensor."""
        return np.zeros((len(needles.poses), self.size(axes), 0))

    def read(self, reading: Reading, needle: Needles, axes: int) -> "Floats":  # noqa: ARG002
        """Return the values (d,) of a reading, NaN where it has none; needle: as predicted at its time (m = 1).

        Default: the numbers of all rows, of a paired sensor the first `axes` of each. Raises ValueError, with the rule,
        for rows of another shape.
        """
        return flatten(reading.rows, self.size(axes), axes if self.paired else None)

    def report(self, values: "Floats", axes: int) -> Matrix:
        """Return the rows of a reading with these values (d,): the inverse of `read`, for virtual sensors."""
        return tuple(tuple(row) for row in np.reshape(values, (-1, axes if self.paired else 1)).tolist())

    def mounted(self, rng: np.random.Generator) -> Self:  # noqa: ARG002  for kinds with a place
        """Return the sensor where it really is, drawn from `phantom`."""
        return self

    def drawn_drift(self, rng: np.random.Generator, axes: int) -> "Floats":
        """Return the error (d,) of the virtual sensor at the target's depth, to which it grows evenly from the skin."""
        width = axes if self.paired else 1
        return np.tile(rng.normal(0.0, self.drift_sd, width), self.size(axes) // width)

    def drawn_offset(self, rng: np.random.Generator, axes: int) -> "Floats":
        """Return the offset (d,) of the virtual sensor."""
        size, width = self.size(axes), axes if self.paired else 1
        return np.resize(rng.normal(0.0, self.offset_sd, width if self.common_offset else size), size)


class KeyedSensor(Sensor):
    """A kind whose `keys` give the sizes of its errors."""

    @property
    def noise(self) -> float:
        """Standard deviation of the white noise of a value."""
        return self._size(self.keys.noise)

    @property
    def offset_sd(self) -> float:
        """Prior standard deviation of the constant error of a value."""
        return self._size(self.keys.offset)

    @property
    def wander_sd(self) -> float:
        """Standard deviation of the correlated noise of a value."""
        return self._size(self.keys.wander)

    def _size(self, key: str) -> float:
        return float(getattr(self, key)) / self.unit[0]


def flatten(rows: Matrix, size: int, width: int | None) -> "Floats":
    """Return the values (size,) of rows, of which the first `width` numbers count (None: all); NaN without rows."""
    if not rows:
        return np.full(size, np.nan)
    values: Floats = np.array(rows)[:, :width].ravel()
    if values.size != size:
        wanted = f"{size} numbers" if width is None else f"{size // width} rows of {width}"
        raise ValueError(f"{len(rows)} rows of {len(rows[0])} numbers, expected {wanted}")
    return values


def predict_values(sensor: Sensor, needles: Needles, axes: int) -> "Floats":
    """Return the values (m, d) of an error-free sensor on needles.

    Raises DriverError, with the sensor, for a kind whose values are of another shape or not finite.
    """
    values: Floats = np.asarray(sensor.predict(needles, axes), dtype=float)
    if rule := values_rule(values, (len(needles.poses), sensor.size(axes))):
        raise DriverError(f"sensor {sensor.title}: predict {rule}")
    return values


def values_rule(values: "Floats", shape: tuple[int, int]) -> str:
    """Return the rule that predicted values break, or ""."""
    if values.shape != shape:
        return f"must return an array of the shape {shape}, needles by values, not {values.shape}"
    if not np.isfinite(values).all():
        return "must return finite numbers for every needle"
    return ""


def read_values(sensor: Sensor, reading: Reading, needle: Needles, axes: int) -> "Floats":
    """Return the values (d,) of a reading. Raises DriverError, with the sensor, for rows that are not of its kind."""
    try:
        return sensor.read(reading, needle, axes)
    except ValueError as error:
        raise DriverError(f"sensor {sensor.title}: a reading has {error}") from error


def turn(values: "Floats", facing: Any, axes: int) -> "Floats":
    """Return values (m, d), lateral pairs in space, turned by unit numbers (m,) or (): by their cosine in the plane."""
    if axes == 1:
        flat: Floats = values * np.asarray(facing).real[..., None]
        return flat
    pairs = (values[:, ::2] + 1j * values[:, 1::2]) * np.asarray(facing)[..., None]
    turned: Floats = np.stack([pairs.real, pairs.imag], axis=-1).reshape(values.shape)
    return turned


def perturbed(values: Sequence[float], most: float, rng: np.random.Generator) -> list[float]:
    """Return values, each displaced by up to ±most."""
    return [
        value + float(off) for value, off in zip(values, rng.uniform(-most, most, len(values)), strict=True)
    ]
