"""The folder of a study, read for its report."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.run.report.rows import Rows

__all__ = ["ROWS_FILE", "STUDY_FILE", "TIMING_FILE", "StudyRecord", "Tuning", "read_study", "read_tuning"]

STUDY_FILE, ROWS_FILE, TIMING_FILE = "study.json", "runs.parquet", "timing.parquet"
_NEEDED = ("index", "controller", "target_depth_mm", "target_lateral_mm", "seed", "true_error_mm", "outcome")


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """What a folder holds: the study as resolved, its rows ordered by index, wall-clock times if they are there."""

    folder: Path
    about: Mapping[str, Any]
    rows: Rows
    timing: Rows | None


@dataclass(frozen=True)
class Tuning:
    """What tuning chose for a controller. budget: insertions; seeds: first and last of its phantoms."""

    method: str
    chosen: Mapping[str, Any]
    budget: int
    seeds: tuple[int, int]
    score_mm: float


def read_study(folder: Path) -> StudyRecord:
    """Return what the folder of a study holds. Raises InputError, in one line, if it cannot be reported on."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: give the folder that `flexneedle study` made")
    if not (folder / ROWS_FILE).exists():
        unfinished = (folder / STUDY_FILE).exists()
        hint = (
            "the study was killed, or still goes on; with --resume it writes its tables as it ends"
            if unfinished
            else "holds no study"
        )
        raise InputError(f"{folder}: {hint}: there is no {ROWS_FILE}")
    rows = _checked(folder / ROWS_FILE, _read_table(folder / ROWS_FILE))
    timing = folder / TIMING_FILE
    return StudyRecord(
        folder,
        _read_json(folder / STUDY_FILE) or {},
        rows,
        _read_table(timing) if timing.exists() else None,
    )


def read_tuning(folder: Path) -> list[Tuning]:
    """Return the records of tuning in a folder, a JSON file each. Raises InputError if there is none, or no record."""
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InputError(f"{folder}: holds no records of tuning: there is no .json file")
    return [_tuning(path, _read_json(path) or {}) for path in paths]


def _tuning(path: Path, values: Mapping[str, Any]) -> Tuning:
    try:
        first, last = values["phantom_seeds"]
        score = float(values["trials"][0]["score_mm"])
        chosen = dict(values["chosen"])
        return Tuning(str(values["method"]), chosen, int(values["budget_insertions"]), (first, last), score)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no record of tuning: {type(error).__name__} {error}") from None


def _checked(path: Path, rows: Rows) -> Rows:
    missing = [name for name in _NEEDED if name not in rows.columns]
    if missing:
        raise InputError(f"{path}: not the rows of a study: lacks the columns {', '.join(missing)}")
    if len(rows) == 0:
        raise InputError(f"{path}: holds no insertion: there is nothing to report")
    index = rows.number("index")
    if len(np.unique(index)) < len(index):
        twice = index[np.flatnonzero(np.bincount(rows.codes("index")[0]) > 1)[0]]
        raise InputError(f"{path}: damaged: index {twice:g} stands more than once")
    order = np.argsort(index, kind="stable")
    return Rows({name: column[order] for name, column in rows.columns.items()})


def _read_table(path: Path) -> Rows:
    try:
        table = pq.read_table(path)
        return Rows({name: _column(table.column(name)) for name in table.column_names})
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged, or no Parquet file: {first}") from None


def _column(column: Any) -> NDArray[Any]:
    """Return a column as an array: numbers as such (null as NaN), everything else as objects, lists as tuples."""
    kind = column.type
    if pa.types.is_floating(kind) or (pa.types.is_integer(kind) and column.null_count == 0):
        return np.asarray(column.to_numpy())
    values = (tuple(value) if isinstance(value, list) else value for value in column.to_pylist())
    return np.fromiter(values, dtype=object, count=len(column))


def _read_json(path: Path) -> Mapping[str, Any] | None:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: damaged: must hold one JSON object")
    return values
