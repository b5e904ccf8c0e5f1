"""The folder of a study, read for its report."""

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
from flexneedle.scenario.problems import describe
from flexneedle.study.report.rows import Rows
from flexneedle.study.tables import RUNS_FILE, TIMING_FILE
from flexneedle.trace.folder import STUDY_FILE

_SHIPPED = files("flexneedle.study") / "tuning"
_STRICT = ConfigDict(strict=True, frozen=True)
Record = TypeVar("Record", bound=BaseModel)


class Asked(BaseModel):
    """The study of `study.json` as the runner wrote it: what it varies and how many insertions it asks for."""

    model_config = _STRICT
    name: str
    title: str
    cases: dict[str, dict[str, Any]]
    axes: dict[str, list[Any]]
    insertions: int = Field(ge=1)


class About(BaseModel):
    """`study.json`: the study, and the command that began it."""

    model_config = _STRICT
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


class Row(BaseModel):
    """What a report needs in each row of `runs.parquet`."""

    model_config = _STRICT
    index: int
    controller: str
    target_depth_mm: FiniteFloat
    target_lateral_mm: FiniteFloat
    seed: int
    true_error_mm: FiniteFloat | None
    outcome: str


class Trial(BaseModel):
    """Settings that tuning tried: mean score."""

    model_config = _STRICT
    score_mm: float


class Tuning(BaseModel):
    """What tuning chose for a controller.

    budget_insertions: of all trials, the best first; phantom_seeds: first and last; note: what else went into it.
    """

    model_config = _STRICT
    method: str
    chosen: dict[str, Any]
    budget_insertions: int
    phantom_seeds: list[int] = Field(min_length=2, max_length=2)
    note: str = ""
    trials: list[Trial] = Field(min_length=1)


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
    about = _read(About, folder / STUDY_FILE, "damaged")
    return StudyRecord(folder, about, rows, _read_table(timing) if timing.exists() else None)


def read_tuning(folder: Path | None = None) -> list[Tuning]:
    """Return the records of tuning in a folder, a JSON file each; by default those that the package ships.

    Raises InputError if there is none, or a file holds no record.
    """
    place: Traversable = _SHIPPED if folder is None else folder
    found = [item for item in place.iterdir() if item.name.endswith(".json")] if place.is_dir() else []
    if not found:
        raise InputError(f"{place}: holds no records of tuning: there is no .json file")
    return [_read(Tuning, item, "no record of tuning") for item in sorted(found, key=lambda item: item.name)]


def _read(model: type[Record], path: Traversable, problem: str) -> Record:
    """Return what a JSON file holds as a model. Raises InputError, with the problem, if it is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("must hold one JSON object")
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: {problem}: {describe(error, model)[0]}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {problem}: {error}") from None


def _checked(path: Path) -> Rows:
    rows = _read_table(path)
    missing = [name for name in Row.model_fields if name not in rows.names]
    if missing:
        raise InputError(f"{path}: not the rows of a study: lacks the columns {', '.join(missing)}")
    for number, values in enumerate(zip(*map(rows.values, Row.model_fields), strict=True), 1):
        try:
            Row.model_validate(dict(zip(Row.model_fields, values, strict=True)))
        except ValidationError as error:
            problem = describe(error, Row)[0]
            raise InputError(f"{path}: not the rows of a study: row {number}: {problem}") from None
    if len(rows) == 0:
        raise InputError(f"{path}: has no insertion: there is nothing to report")
    index, times = np.unique(rows.number("index"), return_counts=True)
    if times.max() > 1:
        raise InputError(f"{path}: damaged: index {index[times.argmax()]:.0f} occurs more than once")
    return Rows(rows.table.sort_by("index"))


def _read_table(path: Path) -> Rows:
    try:
        return Rows(pq.read_table(path))
    except (pa.ArrowException, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged, or no Parquet file: {first}") from None
