"""The folder of a study, read for its report."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.scenario.problems import printable
from flexneedle.study.report.checking import column_problems, shape_problems
from flexneedle.study.report.rows import Rows

STUDY_FILE, ROWS_FILE, TIMING_FILE = "study.json", "runs.parquet", "timing.parquet"
_SHIPPED = files("flexneedle.study") / "tuning"


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """What a folder holds: the study as resolved, its rows ordered by index, wall-clock times if they are there."""

    folder: Path
    about: Mapping[str, Any]
    rows: Rows
    timing: Rows | None


@dataclass(frozen=True)
class Tuning:
    """What tuning chose for a controller.

    budget: insertions; seeds: first and last of its phantoms; note: what else went into it, or "".
    """

    method: str
    chosen: Mapping[str, Any]
    budget: int
    seeds: tuple[int, int]
    note: str
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
        _read_about(folder / STUDY_FILE),
        rows,
        _read_table(timing) if timing.exists() else None,
    )


def asked(about: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a study asks for: name, title, cases, axes, repeats, as far as it says."""
    inner: Mapping[str, Any] = about.get("study", about)
    return inner


def read_tuning(folder: Path | None = None) -> list[Tuning]:
    """Return the records of tuning in a folder, a JSON file each; by default those that the package ships.

    Raises InputError if there is none, or a file holds no record.
    """
    place: Traversable = _SHIPPED if folder is None else folder
    found = [item for item in place.iterdir() if item.name.endswith(".json")] if place.is_dir() else []
    if not found:
        raise InputError(f"{place}: holds no records of tuning: there is no .json file")
    return [_tuning(item, _read_json(item) or {}) for item in sorted(found, key=lambda item: item.name)]


def _tuning(path: Traversable, values: Mapping[str, Any]) -> Tuning:
    try:
        first, last = values["phantom_seeds"]
        score = float(values["trials"][0]["score_mm"])
        chosen, note = dict(values["chosen"]), str(values.get("note", ""))
        return Tuning(
            str(values["method"]), chosen, int(values["budget_insertions"]), (first, last), note, score
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no record of tuning: {type(error).__name__} {error}") from None


def _read_about(path: Path) -> Mapping[str, Any]:
    about = _read_json(path) or {}
    problem = next(shape_problems(about), None)
    if problem is not None:
        raise InputError(f"{path}: damaged: {problem}")
    return about


def _checked(path: Path, rows: Rows) -> Rows:
    problem = next(column_problems(rows), None)
    if problem is not None:
        raise InputError(f"{path}: not the rows of a study: {problem}")
    if len(rows) == 0:
        raise InputError(f"{path}: holds no insertion: there is nothing to report")
    codes, index = rows.codes("index")
    if len(index) < len(codes):
        twice = index[int(np.argmax(np.bincount(codes) > 1))]
        raise InputError(f"{path}: damaged: index {twice} stands more than once")
    order = np.argsort(rows.columns["index"], kind="stable")
    return Rows({name: column[order] for name, column in rows.columns.items()})


def _read_table(path: Path) -> Rows:
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged, or no Parquet file: {first}") from None
    for column in table.schema:
        if not _is_known(column.type):
            rule = "columns must be of numbers, text, booleans, or lists of those"
            raise InputError(
                f"{path}: not a table of a study: {printable(column.name)} is {column.type}: {rule}"
            )
    return Rows({name: _column(table.column(name)) for name in table.column_names})


def _is_known(kind: Any) -> bool:
    """Whether a column's values can be told apart and written down."""
    of = pa.types
    kind = kind.value_type if of.is_list(kind) or of.is_dictionary(kind) else kind
    known = (of.is_null, of.is_boolean, of.is_integer, of.is_floating, of.is_string, of.is_large_string)
    return any(is_of(kind) for is_of in known)


def _column(column: Any) -> NDArray[Any]:
    """Return a column as an array: numbers as such (null as NaN), everything else as objects, lists as tuples."""
    kind = column.type
    if pa.types.is_floating(kind) or (pa.types.is_integer(kind) and column.null_count == 0):
        return np.asarray(column.to_numpy())
    values = (tuple(value) if isinstance(value, list) else value for value in column.to_pylist())
    return np.fromiter(values, dtype=object, count=len(column))


def _read_json(path: Traversable) -> Mapping[str, Any] | None:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: damaged: must hold one JSON object")
    return values
