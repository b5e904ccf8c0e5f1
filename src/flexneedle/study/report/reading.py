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
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flexneedle.errors import InputError
from flexneedle.scenario.problems import describe, printable
from flexneedle.study.report.checking import column_problems
from flexneedle.study.report.rows import Rows
from flexneedle.study.tables import RUNS_FILE, TIMING_FILE
from flexneedle.trace.folder import STUDY_FILE

_SHIPPED = files("flexneedle.study") / "tuning"


class Asked(BaseModel):
    """The study of `study.json` as the runner wrote it: what it varies and how many insertions it asks for."""

    model_config = ConfigDict(strict=True, frozen=True)
    name: str
    title: str
    cases: dict[str, dict[str, Any]]
    axes: dict[str, list[Any]]
    insertions: int = Field(ge=1)


class About(BaseModel):
    """`study.json`: the study, and the command that began it."""

    model_config = ConfigDict(strict=True, frozen=True)
    study: Asked
    command: str = ""


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """What a folder holds: `study.json`, the rows ordered by index, and wall-clock times if they are there."""

    folder: Path
    about: About
    rows: Rows
    timing: Rows | None

    @property
    def asked(self) -> Asked:
        """What the study varies and asks for."""
        return self.about.study


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
    if not (folder / STUDY_FILE).exists():
        raise InputError(f"{folder}: holds no study: there is no {STUDY_FILE}")
    if not (folder / RUNS_FILE).exists():
        hint = "the study was killed or is still running; --resume completes it and writes its tables"
        raise InputError(f"{folder}: {hint}: there is no {RUNS_FILE}")
    rows, timing = _checked(folder / RUNS_FILE), folder / TIMING_FILE
    about = _read_about(folder / STUDY_FILE)
    return StudyRecord(folder, about, rows, _read_table(timing) if timing.exists() else None)


def read_tuning(folder: Path | None = None) -> list[Tuning]:
    """Return the records of tuning in a folder, a JSON file each; by default those that the package ships.

    Raises InputError if there is none, or a file holds no record.
    """
    place: Traversable = _SHIPPED if folder is None else folder
    found = [item for item in place.iterdir() if item.name.endswith(".json")] if place.is_dir() else []
    if not found:
        raise InputError(f"{place}: holds no records of tuning: there is no .json file")
    return [_tuning(item, _read_json(item)) for item in sorted(found, key=lambda item: item.name)]


def _tuning(path: Traversable, values: Mapping[str, Any]) -> Tuning:
    try:
        first, last = values["phantom_seeds"]
        score = float(values["trials"][0]["score_mm"])
        chosen, note = dict(values["chosen"]), str(values.get("note", ""))
        budget = int(values["budget_insertions"])
        return Tuning(str(values["method"]), chosen, budget, (first, last), note, score)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no record of tuning: {type(error).__name__} {error}") from None


def _read_about(path: Path) -> About:
    try:
        return About.model_validate(_read_json(path))
    except ValidationError as error:
        raise InputError(f"{path}: damaged: {describe(error, About)[0]}") from None


def _checked(path: Path) -> Rows:
    rows = _read_table(path)
    problem = next(column_problems(rows), None)
    if problem is not None:
        raise InputError(f"{path}: not the rows of a study: {problem}")
    if len(rows) == 0:
        raise InputError(f"{path}: has no insertion: there is nothing to report")
    index, times = np.unique(rows.number("index"), return_counts=True)
    if times.max() > 1:
        raise InputError(f"{path}: damaged: index {index[times.argmax()]:.0f} occurs more than once")
    return Rows(rows.table.sort_by("index"))


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
    return Rows(table)


def _is_known(kind: Any) -> bool:
    """Whether values of a column can be compared and written as text."""
    of = pa.types
    kind = kind.value_type if of.is_list(kind) or of.is_dictionary(kind) else kind
    known = (of.is_null, of.is_boolean, of.is_integer, of.is_floating, of.is_string, of.is_large_string)
    return any(is_of(kind) for is_of in known)


def _read_json(path: Traversable) -> Mapping[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: damaged: must hold one JSON object")
    return values
