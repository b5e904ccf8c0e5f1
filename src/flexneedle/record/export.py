"""An insertion as CSV or DataFrame: columns with units, one row per period or reading, numbers with all digits."""

import csv
import math
from collections.abc import Iterable, Iterator
from typing import IO, TYPE_CHECKING, Any

from flexneedle.arguments import check_instance
from flexneedle.errors import InputError
from flexneedle.record import readings
from flexneedle.record.fields import COLUMNS, to_row, to_values
from flexneedle.record.sensors import reading_values
from flexneedle.results import Insertion, Period
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import SensorState

if TYPE_CHECKING:
    from pandas import DataFrame

_READING = ("time_s", "period", "frame_number", "verdict", "x_mm", "y_mm", "z_mm")
_SENSOR_READING = ("time_s", "period", "sensor", "verdict", "status", "rows", "unit")
_OF_ROWS = {(1e3, "1/m"): "1/mm"}  # units by factor and unit of a sensor, others by their names
_TIP_SD = ("tip_sd_x_mm", "tip_sd_y_mm", "tip_sd_z_mm")
_SENSOR = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "indicator", "status")


def to_dataframe(insertion: Insertion) -> "DataFrame":
    """Return a pandas DataFrame with one row per control period and the columns of `flexneedle export --csv`.

    Column names end in their unit; unknown numbers are NaN. Raises InputError for another type, or if pandas is not
    installed.
    """
    checked = check_instance(
        "insertion", insertion, Insertion, "make one with flexneedle.insert(scenario, plan)"
    )
    try:
        from pandas import DataFrame
    except ModuleNotFoundError:
        raise InputError("to_dataframe needs pandas, which is not installed: pip install pandas") from None
    marked = mark_columns(checked)
    known = sensor_columns(checked)
    rows = [to_values(period) | sensor_values(period, known) | marked for period in checked.periods]
    return DataFrame(rows, columns=[*COLUMNS, *known, *marked])


def mark_columns(insertion: Insertion) -> dict[str, Any]:
    """Return the columns that mark every row of a dry run or a disturbed insertion; none for another."""
    found = {"dry_run": insertion.dry_run, "disturbed": bool(insertion.disturbed)}
    return {name: True for name, marked in found.items() if marked}


def sensor_columns(insertion: Insertion) -> list[str]:
    """Return the columns that sensors along the needle add: sd of the estimated tip, NIS and verdict of each sensor."""
    sds = _TIP_SD if any(period.tip_covariance is not None for period in insertion.periods) else ()
    names = dict.fromkeys(state.name for period in insertion.periods for state in period.sensors)
    return [*sds, *(f"{name}.{part}" for name in names for part in ("nis", "verdict"))]


def sensor_values(period: Period, columns: Iterable[str]) -> dict[str, Any]:
    """Return the values of such columns in a period, NaN if unknown."""
    covariance = period.tip_covariance
    sds = {} if covariance is None else {name: math.sqrt(covariance[k][k]) for k, name in enumerate(_TIP_SD)}
    values = {f"{one.name}.nis": one.nis for one in period.sensors}
    verdicts = {f"{one.name}.verdict": str(one.verdict) for one in period.sensors}
    return dict.fromkeys(columns, math.nan) | sds | values | verdicts


def write_csv(file: IO[str], insertion: Insertion) -> None:
    """Write periods to a text file opened with newline="". Wall-clock durations are only in the trace."""
    marked, known = mark_columns(insertion), sensor_columns(insertion)
    writer = csv.DictWriter(file, [*COLUMNS, *known, *marked], lineterminator="\n")
    writer.writeheader()
    writer.writerows(to_row(period) | sensor_values(period, known) | marked for period in insertion.periods)


def write_readings(file: IO[str], insertion: Insertion) -> None:
    """Write all readings of an insertion, one line per reading, to a text file opened with newline="".

    The tip of the needle in the stage's frame, with the direction, points and covariances that any reading has, is
    followed by each sensor in the tracker's frame, as reported: columns `NAME.x_mm` and so on, for all sensors of all
    frames. Missing values are empty.
    """
    periods, marked = insertion.periods, mark_columns(insertion)
    rows = [
        {"period": str(period.index), "verdict": str(checked.verdict)} | readings.to_values(checked) | marked
        for period in periods
        for checked in period.readings
    ]
    measured = [key for key in readings.OPTIONAL if any(key in row for row in rows)]
    sensors = (f"{name}.{part}" for name in _sensors(periods) for part in _SENSOR)
    columns = [*_READING, *measured, *sensors, *marked]
    writer = csv.DictWriter(file, columns, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)


def write_sensor_readings(file: IO[str], insertion: Insertion) -> None:
    """Write all readings of the sensors along the needle, one line per reading, to a text file opened with newline="".

    The column `rows` has what was measured, as `Reading.rows`: numbers separated by spaces, rows by semicolons; `unit`
    its unit, empty for a kind without one.
    """
    marked, scenario = mark_columns(insertion), insertion.scenario
    units = {one.title: _unit(one) for one in (scenario.sensor if scenario else ())}
    writer = csv.DictWriter(file, [*_SENSOR_READING, *marked], lineterminator="\n")
    writer.writeheader()
    for period in insertion.periods:
        for state in period.sensors:
            unit = {"unit": units.get(state.name, "")}
            writer.writerows(row | unit | marked for row in _reading_rows(period.index, state))


def _unit(sensor: Sensor) -> str:
    """Return the unit of a sensor's rows."""
    factor, name = sensor.unit
    return _OF_ROWS.get(sensor.unit, name if factor == 1.0 else f"{factor:g} {name}")


def _reading_rows(period: int, state: SensorState) -> Iterator[dict[str, Any]]:
    for one in state.readings:
        verdict = "excluded" if one.verdict.ok and not state.verdict.ok else str(one.verdict)
        where = {"period": period, "sensor": state.name, "verdict": verdict}
        yield where | reading_values(one.reading)


def _sensors(periods: Iterable[Period]) -> list[str]:
    """Return the names of all sensors in the order of their first reading."""
    measurements = (checked.measurement for period in periods for checked in period.readings)
    frames = (one.frame for one in measurements if one.frame is not None)
    return list(dict.fromkeys(name for frame in frames for name in frame.readings))
