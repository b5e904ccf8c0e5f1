"""Read the folder of a study for its report."""

import json
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from flexneedle.errors import InputError
from flexneedle.lab.study.findings.rows import Rows
from flexneedle.lab.study.tables import RUNS_FILE, TIMING_FILE
from flexneedle.record.folder import STUDY_FILE
from flexneedle.scenario.problems import describe

_SHIPPED = files("flexneedle.lab.study") / "tuning"
_STRICT = ConfigDict(strict=True, frozen=True)
Record = TypeVar("Record", bound=BaseModel)


class StudyDefinition(BaseModel):
    """The study of `study.json`: cases, axes and number of insertions."""

    model_config = _STRICT
    name: str
    title: str
    cases: dict[str, dict[str, Any]]
    axes: dict[str, list[Any]]
    insertions: int = Field(ge=1)


class StudyJson(BaseModel):
    """`study.json`: the study and its first command."""

    model_config = _STRICT
    study: StudyDefinition
    command: str = ""


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A study folder: `study.json`, the rows ordered by index, and wall-clock times if available."""

    folder: Path
    header: StudyJson
    rows: Rows
    timing: Rows | None

    @property
    def definition(self) -> StudyDefinition:
        """Cases, axes and number of insertions."""
        return self.header.study


class RequiredColumns(BaseModel):
    """Columns of `runs.parquet` that a report needs, checked in each row."""

    model_config = _STRICT
    index: int
    controller: str
    target_depth_mm: FiniteFloat
    target_lateral_mm: FiniteFloat
    seed: int
    true_error_mm: FiniteFloat | None
    outcome: str


class Trial(BaseModel):
    """Settings tried in tuning, with their score."""

    model_config = _STRICT
    score_mm: float


class Tuning(BaseModel):
    """Tuning record of a controller: chosen settings and all trials, the best first.

    budget_insertions: over all trials; phantom_seeds: first and last; note: remark on the tuning.
    """

    model_config = _STRICT
    method: str
    chosen: dict[str, Any]
    budget_insertions: int
    phantom_seeds: list[int] = Field(min_length=2, max_length=2)
    note: str = ""
    trials: list[Trial] = Field(min_length=1)


def read_study_folder(folder: Path) -> StudyRecord:
    """Return the contents of a study folder. Raises InputError, in one line, if they are incomplete or damaged."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: give the folder of a `flexneedle study`")
    if not (folder / STUDY_FILE).exists():
        raise InputError(f"{folder}: contains no study: there is no {STUDY_FILE}")
    if not (folder / RUNS_FILE).exists():
        hint = "the study was killed or is still running; --resume completes it and writes its tables"
        raise InputError(f"{folder}: {hint}: there is no {RUNS_FILE}")
    rows, timing = _checked(folder / RUNS_FILE), folder / TIMING_FILE
    header = _read(StudyJson, folder / STUDY_FILE, "damaged")
    return StudyRecord(folder, header, rows, _read_table(timing) if timing.exists() else None)


def read_tuning(folder: Path | None = None) -> list[Tuning]:
    """Return the tuning records of a folder, one JSON file each (default: those of the package).

    Raises InputError if there is none, or if a file is not a record.
    """
    source: Traversable = _SHIPPED if folder is None else folder
    found = [item for item in source.iterdir() if item.name.endswith(".json")] if source.is_dir() else []
    if not found:
        raise InputError(f"{source}: contains no tuning records: there is no .json file")
    return [_read(Tuning, item, "not a tuning record") for item in sorted(found, key=lambda item: item.name)]


def _read(model: type[Record], path: Traversable, problem: str) -> Record:
    """Return the contents of a JSON file as a model. Raises InputError, with the problem, if they do not fit."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("must contain one JSON object")
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: {problem}: {describe(error, model)[0]}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {problem}: {error}") from None


def _checked(path: Path) -> Rows:
    rows = _read_table(path)
    missing = [name for name in RequiredColumns.model_fields if name not in rows.names]
    if missing:
        raise InputError(f"{path}: not the rows of a study: missing columns {', '.join(missing)}")
    for number, values in enumerate(zip(*map(rows.values, RequiredColumns.model_fields), strict=True), 1):
        try:
            RequiredColumns.model_validate(dict(zip(RequiredColumns.model_fields, values, strict=True)))
        except ValidationError as error:
            problem = describe(error, RequiredColumns)[0]
            raise InputError(f"{path}: not the rows of a study: row {number}: {problem}") from None
    if len(rows) == 0:
        raise InputError(f"{path}: contains no insertions: nothing to report")
    index, times = np.unique(rows.number("index"), return_counts=True)
    if times.max() > 1:
        raise InputError(f"{path}: damaged: index {index[times.argmax()]:.0f} occurs more than once")
    return Rows(rows.table.sort_by("index"))


def _read_table(path: Path) -> Rows:
    try:
        return Rows(pq.read_table(path))
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged, or not a Parquet file: {first}") from None
