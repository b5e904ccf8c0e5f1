"""The folder of a study: `study.json`, `journal.jsonl`, `plans/`, and the tables, written at the end.

`study.json` contains the definition of the study, the package versions and the first command. It is written once.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError, describe_error, make_printable, one_line
from flexneedle.files import replace_file
from flexneedle.lab.study.grid import ExpandedStudy, StudyInsertion, restore_study
from flexneedle.lab.study.journal import StudyJournal, read_rows
from flexneedle.lab.study.provenance import compare_modules
from flexneedle.record.folder import STUDY_FILE, versions
from flexneedle.record.plain import to_text
from flexneedle.scenario.dotted import flatten

JOURNAL_FILE, PLANS_FOLDER = "journal.jsonl", "plans"
_FORMAT = 1
_SOURCE, _OWN = "versions.source", "study.own."


@dataclass(frozen=True, eq=False)
class RecordedStudy:
    """A study in its folder, finished or not.

    versions: of the packages that made it; own: digests of the files of custom modules, by module and file; rows:
    finished rows by index.
    """

    folder: Path
    study: ExpandedStudy
    versions: Mapping[str, str]
    own: Mapping[str, Mapping[str, str]]
    rows: Mapping[int, Mapping[str, Any]]

    def insertion(self, index: int) -> StudyInsertion:
        """Return the insertion of a row. Raises InputError if this version does not accept its settings."""
        try:
            return self.study.insertion(index)
        except InputError as error:
            raise InputError(f"{self.folder}: row {index}: {one_line(error)}") from None


def read_folder(path: Path) -> RecordedStudy:
    """Return the study in a folder, also while it runs.

    Raises InputError if there is none, if it is damaged, or if a custom module is missing.
    """
    stored = _read_identity(path)
    if stored["format"] != _FORMAT:
        raise InputError(f"{path}: not a study of this version of flexneedle: format must be {_FORMAT}")
    try:
        study = restore_study(stored["study"])
        made_by = dict(stored["versions"]), dict(stored["study"]["own"])
    except InputError as error:
        raise InputError(f"{path}: {one_line(error)}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path / STUDY_FILE}: damaged: {describe_error(error)}") from None
    return RecordedStudy(path, study, *made_by, read_rows(path / JOURNAL_FILE, len(study)))


def open_folder(path: Path, study: ExpandedStudy, resume: bool, command: str = "") -> StudyJournal:
    """Return the journal of a new study in the folder `path`, or with `resume` of the study in it.

    An empty or missing folder starts a new study in either case. Raises InputError if the folder contains other
    files, a study without `resume`, another study, or one of other package versions; or if another process is
    writing to it.
    """
    try:
        _check(path, study, resume)
        path.mkdir(parents=True, exist_ok=True)
        journal = StudyJournal(path / JOURNAL_FILE, len(study))
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        _check(path, study, resume)  # again, now that no other process can create one here
        if not (path / STUDY_FILE).exists():
            replace_file(path / STUDY_FILE, to_text({**_identify(study), "command": command}).encode())
    except BaseException:
        journal.__exit__(None, None, None)
        raise
    return journal


def _identify(study: ExpandedStudy) -> dict[str, Any]:
    return {"format": _FORMAT, "versions": versions(), "study": study.definition}


def _check(path: Path, study: ExpandedStudy, resume: bool) -> None:
    if (path / STUDY_FILE).exists():
        if not resume:
            raise InputError(
                f"{path}: already contains a study: add --resume to continue it, or set another --out"
            )
        _check_same(path, study)
    elif path.exists() and not (path.is_dir() and {item.name for item in path.iterdir()} <= {JOURNAL_FILE}):
        raise InputError(f"{path}: exists and is not an empty folder: set another with --out")


def _check_same(path: Path, study: ExpandedStudy) -> None:
    """Raise InputError, with the first difference, unless the folder contains this study with these versions."""
    key = _find_difference(_read_identity(path), _identify(study))
    if key is not None:
        raise InputError(f"{path}: cannot resume: {key}")


def _read_identity(path: Path) -> dict[str, Any]:
    """Return the recorded result of `_identify` for the study in a folder."""
    try:
        values = json.loads((path / STUDY_FILE).read_text(encoding="utf-8"))
        if not all(isinstance(files, dict) for files in values["study"]["own"].values()):
            raise ValueError("study.own: must be tables of files")
        return {name: values[name] for name in ("format", "versions", "study")}
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: contains no study: {STUDY_FILE} is missing") from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path / STUDY_FILE}: cannot be read: {error}") from None


def _find_difference(stored: Mapping[str, Any], current: Mapping[str, Any]) -> str | None:
    there, here = flatten(stored), flatten(json.loads(json.dumps(current)))
    for key in there | here:
        if there.get(key) != here.get(key):
            if key.startswith(_OWN):
                changed = compare_modules(stored["study"]["own"], current["study"]["own"])
                return f"a module has changed since the start of the study: {changed}"
            name = key.removeprefix("study.")
            before, now = (_format_value(values, key) for values in (there, here))
            edited = (
                "the code of flexneedle has changed since the start of the study: " if key == _SOURCE else ""
            )
            return make_printable(f"{edited}{name} is {before} in the folder, {now} now")
    return None


def _format_value(values: Mapping[str, Any], key: str) -> str:
    return str(values[key]) if key in values else "not recorded"
