"""Read the folder of a study for its report."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from flexneedle.errors import InputError
from flexneedle.lab.study.findings.rows import InsertionRows
from flexneedle.lab.study.tables import RUNS_FILE
from flexneedle.record.folder import STUDY_FILE
from flexneedle.scenario.problems import describe

_STRICT = ConfigDict(strict=True, frozen=True)


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
class StudyTables:
    """A study folder: `study.json`, and the rows ordered by index."""

    folder: Path
    header: StudyJson
    rows: InsertionRows

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


def read_study_folder(folder: Path) -> StudyTables:
    """Return the contents of a study folder. Raises InputError, in one line, if they are incomplete or damaged."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: give the folder of a `flexneedle study`")
    if not (folder / STUDY_FILE).exists():
        raise InputError(f"{folder}: contains no study: there is no {STUDY_FILE}")
    if not (folder / RUNS_FILE).exists():
        hint = "the study was killed or is still running; --resume completes it and writes its tables"
        raise InputError(f"{folder}: {hint}: there is no {RUNS_FILE}")
    return StudyTables(folder, _read_header(folder / STUDY_FILE), _read_rows(folder / RUNS_FILE))


def _read_header(path: Path) -> StudyJson:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("must contain one JSON object")
        return StudyJson.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: damaged: {describe(error, StudyJson)[0]}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}") from None


def _read_rows(path: Path) -> InsertionRows:
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
    return InsertionRows(rows.table.sort_by("index"))


def _read_table(path: Path) -> InsertionRows:
    try:
        return InsertionRows(pq.read_table(path))
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged, or not a Parquet file: {first}") from None
