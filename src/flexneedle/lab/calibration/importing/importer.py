"""Import of recordings: files, read with a map, as steps in the needle's frame."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.map_file import RecordingMap
from flexneedle.lab.calibration.importing.recordings import LEAST_STEPS, read_recordings
from flexneedle.lab.calibration.importing.runs import GUIDE_ORDER, find_run, read_runs
from flexneedle.lab.calibration.importing.summary import summarize
from flexneedle.lab.calibration.importing.suspicions import find_suspicions
from flexneedle.lab.calibration.session import GuideOrder, Recording, Session

_NUMBER = re.compile(r"(\d+)")


@dataclass(frozen=True, eq=False)
class Imported:
    """A session, what was understood, and what was left out or is suspicious, line by line."""

    session: Session
    understood: tuple[str, ...]
    suspected: tuple[str, ...]


def import_recordings(files: Sequence[Path], recording_map: RecordingMap | None = None) -> Imported:
    """Return the session of files and folders; a map is needed unless all are run folders of the package.

    Raises InputError, in one line, for files that contradict themselves, each other or the map.
    """
    sensors = recording_map.sensor if recording_map else ()
    pairs = [(path, each.path(path)) for each in sensors for path in files]
    beside = {table.resolve() for path, table in pairs if table != path}
    sources = _name_sessions(_in_natural_order([path for path in files if path.resolve() not in beside]))
    runs = [(folder, session) for path, session in sources if (folder := find_run(path)) is not None]
    tables = [(path, session) for path, session in sources if find_run(path) is None]
    order = _guide_order(tables, runs, recording_map)
    found = [read_runs(runs)]
    if recording_map is not None and tables:
        found.insert(0, read_recordings(tables, recording_map))
    recordings = [one for each in found for one in each.recordings]
    _check_together(recordings, files)
    frames = {name: frame.rotation.round(9).tolist() for name, frame in found[0].frames.items()}
    session = Session(tuple(recordings), order, {"files": [str(path) for path in files], "frames": frames})
    notes = (note for each in found for note in each.notes)
    suspected = find_suspicions(session, recording_map if tables else None)
    return Imported(session, tuple(summarize(session, found[0])), (*notes, *suspected))


def _in_natural_order(files: Sequence[Path]) -> Sequence[Path]:
    """Return files as given, or with numbers in the order of their values if a shell has sorted the names."""

    def parts(path: Path) -> list[tuple[int, int, str]]:
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in _NUMBER.split(str(path))]

    return sorted(files, key=parts) if list(files) == sorted(files) else files


def _name_sessions(files: Sequence[Path]) -> list[tuple[Path, str]]:
    """Return each file with the name of its session: its folder, relative to the folder that all files share."""
    parents = [Path(os.path.abspath(path)).parent for path in files]  # noqa: PTH100  links stay as named
    shared = Path(os.path.commonpath(parents))
    names = [
        str(parent.relative_to(shared)) if parent != shared else shared.name or "session"
        for parent in parents
    ]
    return list(zip(files, names, strict=True))


def _guide_order(
    tables: Sequence[tuple[Path, str]], runs: Sequence[tuple[Path, str]], recording_map: RecordingMap | None
) -> GuideOrder:
    """Return when the guide moves in all files. Raises InputError if files differ, or tables have no map."""
    if not tables:
        return GUIDE_ORDER
    if recording_map is None:
        raise InputError(f"{tables[0][0]}: is no run folder: give the map of its columns with --map")
    order = recording_map.steps.guide
    if runs and order != GUIDE_ORDER:
        raise InputError(
            f'{runs[0][0]}: the guide of a run moves "{GUIDE_ORDER}" the advance, and steps.guide = "{order}": '
            "import runs separately"
        )
    return order


def _check_together(recordings: Sequence[Recording], files: Sequence[Path]) -> None:
    """Raise InputError without a recording, or if their axes differ."""
    if not recordings:
        raise InputError(
            f"{files[0]}: no insertion has {LEAST_STEPS} steps: check the map, in particular [steps]"
        )
    first = recordings[0]
    for one in recordings:
        if one.axes != first.axes:
            raise InputError(
                f"{one.session}/{one.name} has {one.axes} lateral axes, and {first.session}/{first.name} has "
                f"{first.axes}: import them separately"
            )
