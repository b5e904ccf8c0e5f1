"""The folder of a study: `study.json`, `journal.jsonl`, `plans/`, and in the end the tables.

`study.json` says what is studied, with which versions, and the command that began it. It is written once.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.scenario.dotted import flatten
from flexneedle.scenario.problems import printable
from flexneedle.study.grid import Study
from flexneedle.study.journal import Journal
from flexneedle.trace.files import replace_file
from flexneedle.trace.folder import STUDY_FILE, versions
from flexneedle.trace.plain import to_text

JOURNAL_FILE, PLANS_FOLDER = "journal.jsonl", "plans"
_FORMAT = 1
_SOURCE = "versions.source"


def open_folder(path: Path, study: Study, resume: bool, command: str = "") -> Journal:
    """Return the journal of a new study in the folder `path`, or with `resume` of the one that it holds.

    A folder that is empty, or not there, is begun in either case. Raises InputError if the folder holds
    something else, a study without `resume`, another study, or one of other versions; or if another process
    is at work on it.
    """
    try:
        _check(path, study, resume)
        path.mkdir(parents=True, exist_ok=True)
        journal = Journal(path / JOURNAL_FILE, len(study))
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        _check(path, study, resume)  # again, now that no other process can begin one here
        if not (path / STUDY_FILE).exists():
            replace_file(path / STUDY_FILE, to_text({**_identity(study), "command": command}).encode())
    except BaseException:
        journal.__exit__(None, None, None)
        raise
    return journal


def _identity(study: Study) -> dict[str, Any]:
    return {"format": _FORMAT, "versions": versions(), "study": study.definition}


def _check(path: Path, study: Study, resume: bool) -> None:
    if (path / STUDY_FILE).exists():
        if not resume:
            raise InputError(
                f"{path}: holds a study already: go on with it by --resume, or give another --out"
            )
        _check_same(path, study)
    elif path.exists() and not (path.is_dir() and {item.name for item in path.iterdir()} <= {JOURNAL_FILE}):
        raise InputError(f"{path}: is there already, and no empty folder: give another with --out")


def _check_same(path: Path, study: Study) -> None:
    """Raise InputError, with the first difference, unless the folder holds this study of these versions."""
    try:
        values = json.loads((path / STUDY_FILE).read_text(encoding="utf-8"))
        stored = {name: values[name] for name in ("format", "versions", "study")}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path / STUDY_FILE}: cannot be read: {error}") from None
    key = _first_difference(stored, _identity(study))
    if key is not None:
        raise InputError(f"{path}: cannot resume: {key}")


def _first_difference(stored: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    there, here = flatten(stored), flatten(json.loads(json.dumps(asked)))
    for key in there | here:
        if there.get(key) != here.get(key):
            name = key.removeprefix("study.")
            before, now = (_told(values, key) for values in (there, here))
            edited = "the code of flexneedle is not that which began the study: " if key == _SOURCE else ""
            return printable(f"{edited}{name} is {before} in the folder, {now} now")
    return None


def _told(values: Mapping[str, Any], key: str) -> str:
    return str(values[key]) if key in values else "not recorded"
