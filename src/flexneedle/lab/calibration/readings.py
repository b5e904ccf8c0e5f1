"""Readings of sensors along the needle at the steps of recorded insertions, and their table, `readings.parquet`."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from flexneedle.errors import InputError
from flexneedle.types import Floats, Matrix

READINGS_FILE = "readings.parquet"
_WIDEST = 3  # numbers in a row of any sensor
_VALUES = [f"value_{k}" for k in range(1, _WIDEST + 1)]


class StepReading(NamedTuple):
    """A reading of a sensor with the needle at rest.

    Attributes:
        sensor: Name of the sensor, as in the scenario.
        step: Step of the insertion.
        rows: Values as of `flexneedle.Reading`, in the needle's frame: curvatures (1/mm), positions (mm) or pixels.
    """

    sensor: str
    step: int
    rows: Matrix


class SensorTable(NamedTuple):
    """Readings of a sensor over an insertion: times (r,) in s, and their rows."""

    sensor: str
    time: Floats
    rows: tuple[Matrix, ...]
    within_s: float

    def at_steps(self, times: Floats) -> Iterator[StepReading]:
        """Yield the readings at most `within_s` from the nearest of the times (k,) of the steps."""
        for time, rows in zip(self.time.tolist(), self.rows, strict=True):
            apart = np.abs(times - time)
            step = int(apart.argmin())
            if apart[step] <= self.within_s and rows:
                yield StepReading(self.sensor, step, rows)


def to_reading_columns(keys: Sequence[tuple[str, str]], readings: Sequence[Sequence[StepReading]]) -> Any:
    """Return the columns of the table; keys: session and insertion, each with its readings."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("session", "insertion", "sensor", "step", "reading", *_VALUES)
    }
    for (session, name), found in zip(keys, readings, strict=True):
        for number, each in enumerate(found):
            for row in each.rows:
                cells = (session, name, each.sensor, each.step, number)
                padded = (*row, *[np.nan] * (_WIDEST - len(row)))
                for column, value in zip(columns, (*cells, *padded), strict=True):
                    columns[column].append(value)
    return columns


def from_reading_columns(
    columns: Mapping[str, Any], steps: Mapping[tuple[str, str], int]
) -> dict[tuple[str, str], tuple[StepReading, ...]]:
    """Return the readings by session and insertion; steps: number of steps of each.

    Raises KeyError for a missing column, InputError for readings of an unknown insertion or step, or without a number.
    """
    values = np.stack([np.asarray(columns[name], dtype=float) for name in _VALUES], axis=1)
    names = ("session", "insertion", "sensor", "step", "reading")
    heads = [*zip(*(columns[name].tolist() for name in names), strict=True)]
    found: dict[tuple[str, str], list[StepReading]] = {}
    for head, group in groupby(range(len(heads)), key=heads.__getitem__):
        session, name, sensor, step, _ = head
        if not 0 <= step < steps.get((session, name), 0):
            raise InputError(
                f"{sensor}: session {session}, insertion {name}, step {step}: is not in the steps"
            )
        rows = values[[*group]]
        width = int(np.isfinite(rows).any(axis=0).nonzero()[0].max(initial=-1)) + 1
        if not width or np.isinf(rows).any():
            raise InputError(f"{sensor}: session {session}, insertion {name}, step {step}: must be finite")
        found.setdefault((session, name), []).append(
            StepReading(sensor, int(step), tuple(map(tuple, rows[:, :width].tolist())))
        )
    return {key: tuple(each) for key, each in found.items()}
