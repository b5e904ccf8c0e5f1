"""Conversion of a checked reading to exact text by key and back: one status of `/tracker/readings`.

Points and matrices are one text: numbers separated by spaces, rows by semicolons.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from flexneedle.types import CheckedMeasurement, Frame, Matrix, Measurement, SensorReading, Verdict

_POSITION, _ORIENTATION = ("x_mm", "y_mm", "z_mm"), ("qw", "qx", "qy", "qz")
_DIRECTION = ("direction_theta_rad", "direction_psi_rad")
_POINTS, _COVARIANCE, _DIRECTION_COVARIANCE = "points_mm", "covariance_mm2", "direction_covariance_rad2"

OPTIONAL: tuple[str, ...] = (*_DIRECTION, _POINTS, _COVARIANCE, _DIRECTION_COVARIANCE)
"""Keys of the optional measurements besides the position of the tip, in order."""


def to_values(checked: CheckedMeasurement) -> dict[str, str]:
    """Return the values of the tip, then of each sensor of the frame; missing values are omitted."""
    measurement, frame = checked.measurement, checked.measurement.frame
    values = {"time_s": repr(float(measurement.time))}
    values |= _numbers(_POSITION, (measurement.x, measurement.y, measurement.z))
    values |= _numbers(_DIRECTION, measurement.direction or ())
    matrices = (measurement.points or None, measurement.covariance, measurement.direction_covariance)
    for key, matrix in zip((_POINTS, _COVARIANCE, _DIRECTION_COVARIANCE), matrices, strict=True):
        if matrix is not None:
            values[key] = matrix_text(matrix)
    if frame is not None:
        values |= {"frame_time_s": repr(float(frame.time)), "frame_number": str(frame.number)}
        for name, reading in frame.readings.items():
            values |= {f"{name}.{key}": text for key, text in _sensor(reading)}
    return values


def from_values(values: Mapping[str, str], verdict: Verdict) -> CheckedMeasurement:
    """Return the reading of such a status; raises KeyError, ValueError or InputError for other values."""
    x, y, z = (_number(values, key) for key in _POSITION)
    theta, psi = (_number(values, key) for key in _DIRECTION)
    measurement = Measurement(
        float(values["time_s"]),
        x,
        y,
        z,
        _frame(values),
        direction=None if theta is None or psi is None else (theta, psi),
        points=_matrix(values, _POINTS) or (),
        covariance=_matrix(values, _COVARIANCE),
        direction_covariance=_matrix(values, _DIRECTION_COVARIANCE),
    )
    return CheckedMeasurement(measurement, verdict)


def _frame(values: Mapping[str, str]) -> Frame | None:
    if "frame_number" not in values:
        return None
    names = [key.removesuffix(".status") for key in values if key.endswith(".status")]
    readings = {name: _reading(values, name) for name in names}
    return Frame(float(values["frame_time_s"]), int(values["frame_number"]), readings)


def _reading(values: Mapping[str, str], name: str) -> SensorReading:
    x, y, z = (_number(values, f"{name}.{key}") for key in _POSITION)
    w, i, j, k = (_number(values, f"{name}.{key}") for key in _ORIENTATION)
    return SensorReading(
        None if x is None or y is None or z is None else (x, y, z),
        None if w is None or i is None or j is None or k is None else (w, i, j, k),
        _number(values, f"{name}.indicator"),
        values[f"{name}.status"],
    )


def _sensor(reading: SensorReading) -> Iterator[tuple[str, str]]:
    yield "status", reading.status
    yield from _numbers(_POSITION, reading.position or ()).items()
    yield from _numbers(_ORIENTATION, reading.orientation or ()).items()
    yield from _numbers(("indicator",), (reading.indicator,)).items()


def _numbers(keys: tuple[str, ...], values: tuple[float | None, ...]) -> dict[str, str]:
    return {key: repr(float(value)) for key, value in zip(keys, values, strict=False) if value is not None}


def _number(values: Mapping[str, str], key: str) -> float | None:
    return float(values[key]) if key in values else None


def _matrix(values: Mapping[str, str], key: str) -> Any:
    """Return the rows of a text, None without one; `Measurement` checks their number and length."""
    return parse_matrix(values[key]) if key in values else None


def matrix_text(rows: Matrix) -> str:
    """Return the rows of a matrix as exact text."""
    return "; ".join(" ".join(repr(float(value)) for value in row) for row in rows)


def parse_matrix(text: str) -> Matrix:
    """Return the rows of a text; raises ValueError for other texts."""
    return tuple(tuple(map(float, row.split())) for row in text.split(";"))
