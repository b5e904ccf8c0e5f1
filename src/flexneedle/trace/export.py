"""A run as CSV: a header with units, a line for each period or reading, numbers with all their digits."""

import csv
from collections.abc import Iterable, Sequence
from typing import IO

from flexneedle.trace.columns import COLUMNS, to_row
from flexneedle.trace.readings import to_values
from flexneedle.types import Period

_READING = ("time_s", "period", "frame_number", "verdict", "x_mm", "y_mm", "z_mm")
_SENSOR = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "indicator", "status")


def write_csv(file: IO[str], periods: Sequence[Period]) -> None:
    """Write periods to a text file opened with newline="". Wall-clock durations stay in the trace."""
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(map(to_row, periods))


def write_readings(file: IO[str], periods: Sequence[Period]) -> None:
    """Write all readings of periods, a line each, to a text file opened with newline="".

    The tip of the needle on the stage comes first, then each sensor as the tracker told it, in the tracker's frame:
    columns `NAME.x_mm` and so on, of all sensors that any frame names. What is not known is empty.
    """
    columns = [*_READING, *(f"{name}.{part}" for name in _sensors(periods) for part in _SENSOR)]
    writer = csv.DictWriter(file, columns, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for period in periods:
        for judged in period.readings:
            told = {"period": str(period.index), "verdict": str(judged.verdict)}
            writer.writerow(told | to_values(judged))


def _sensors(periods: Iterable[Period]) -> list[str]:
    """Return the names of all sensors, in the order in which they are first told."""
    samples = (judged.sample for period in periods for judged in period.readings)
    frames = (sample.frame for sample in samples if sample.frame is not None)
    return list(dict.fromkeys(name for frame in frames for name in frame.readings))
