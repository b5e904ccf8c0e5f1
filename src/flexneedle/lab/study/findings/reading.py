"""Read the folder of a study for its report."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flexneedle.errors import InputError, describe_error
from flexneedle.lab.study.findings.rows import InsertionRows
from flexneedle.lab.study.tables import RUNS_FILE
from flexneedle.record.folder import STUDY_FILE

_REQUIRED = (
    *("index", "controller", "target_depth_mm", "target_lateral_mm", "seed"),
    *("true_error_mm", "outcome"),
)


@dataclass(frozen=True, eq=False)
class StudyTables:
    """A study folder: title, cases, axes, number of insertions and command of `study.json`; rows ordered by index.

    names: of controllers given as module:NAME.
    """

    folder: Path
    title: str
    cases: Mapping[str, Mapping[str, Any]]
    axes: Mapping[str, Sequence[Any]]
    names: Mapping[str, str]
    insertions: int
    command: str
    rows: InsertionRows


def read_study_folder(folder: Path) -> StudyTables:
    """Return the contents of a study folder. Raises InputError, in one line, if they are incomplete or damaged."""
    header, table = folder / STUDY_FILE, folder / RUNS_FILE
    if not header.exists():
        raise InputError(f"{folder}: no {STUDY_FILE}: give the folder of a `flexneedle study`")
    if not table.exists():
        hint = "the study was killed or is still running; --resume completes it and writes its tables"
        raise InputError(f"{folder}: no {RUNS_FILE}: {hint}")
    try:
        stored = json.loads(header.read_text(encoding="utf-8"))
        study, command = stored["study"], str(stored.get("command", ""))
        names = dict(study.get("names", {}))
        known = study["title"], dict(study["cases"]), dict(study["axes"]), names, int(study["insertions"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{header}: damaged: {describe_error(error)}") from None
    return StudyTables(folder, *known, command, _read_rows(table))


def _read_rows(path: Path) -> InsertionRows:
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: damaged, or not a Parquet file: {describe_error(error)}") from None
    missing = [name for name in _REQUIRED if name not in table.column_names]
    if missing:
        raise InputError(f"{path}: not the rows of a study: missing columns {', '.join(missing)}")
    if table.num_rows == 0:
        raise InputError(f"{path}: contains no insertions: nothing to report")
    return InsertionRows(table.sort_by("index"))
