"""The folder of runs: its runs and studies, and their files for download. A client sends a name, never a path."""

import asyncio
import io
import json
import os
import re
import stat
import zipfile
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from flexneedle.lab.page.protocol import RunsMessage
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.process import run_module
from flexneedle.record.folder import RUN_FILE, STUDY_FILE

_NAME = re.compile(r"[\w][\w .+-]*")
_MOST_RUNS = 1_000
_EXPORT_S, _NICENESS = 60.0, 10
FIGURES = ("insertion.png", "plan.png")
"""Possible names of a run's figure."""


class RunsFolder:
    """Runs and studies in a folder, which need not exist yet."""

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        self._read = dict[Path, tuple[tuple[int, int], dict[str, Any]]]()

    def list_runs(self) -> list[dict[str, Any]]:
        """Return name, kind, summary and time (s since 1970) of each run and study, newest first."""
        marked = ((name, self._find_mark(name)) for name in self._names())
        found = [(name, *record) for name, record in marked if record is not None]
        found.sort(key=lambda item: item[2].st_mtime, reverse=True)
        return sorted(
            (self._entry(*item) for item in found[:_MOST_RUNS]),
            key=lambda entry: float(entry["made"]),
            reverse=True,
        )

    async def watch(
        self,
        changed: asyncio.Event,
        seconds: float,
        wanted: Callable[[], bool],
        publish: Callable[[RunsMessage], None],
    ) -> None:
        """Publish runs and studies when they have changed; a thread reads them, since a disk may be slow.

        Args:
            changed: Set when they are read at once.
            seconds: Time between two reads.
            wanted: Whether anybody reads the messages.
            publish: Called with each message.
        """
        before: list[dict[str, Any]] | None = None
        while True:
            if wanted() or before is None:
                listed = await asyncio.to_thread(self.list_runs)
                if listed != before:
                    before = listed
                    publish(RunsMessage(runs=listed))
            changed.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await changed.wait()

    def find_run(self, name: str) -> Path:
        """Return the folder of a run. Raises Refusal for an unknown name, and for a folder with links."""
        return self._folder(name, RUN_FILE, "run")

    def find_study(self, name: str) -> Path:
        """Return the folder of a study. Raises Refusal for an unknown name, and for a folder with links."""
        return self._folder(name, STUDY_FILE, "study")

    def new(self, name: str) -> Path:
        """Return the folder of a new run. Raises Refusal if the name is taken."""
        if not _NAME.fullmatch(name):
            raise Refusal(f"{name!r}: must be letters, digits, spaces and any of . _ + -")
        folder = self.path / name
        if folder.exists() or folder.is_symlink():
            raise Refusal(f"{name}: there is already something of this name: choose another")
        return folder

    def _folder(self, name: str, file: str, what: str) -> Path:
        mark = self._find_mark(name) if name in self._names() else None
        if mark is None or mark[0] != file:
            raise Refusal(f"{name!r}: no {what} of this name in the folder of runs")
        for path in (self.path / name).iterdir():
            if path.is_symlink():
                raise Refusal(f"{name}: {path.name} is a link, which may lead elsewhere")
        return self.path / name

    def _names(self) -> list[str]:
        """Return the names of the folders here, without links, which may lead elsewhere."""
        try:
            with os.scandir(self.path) as entries:
                names = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
        except OSError:
            return []
        return [name for name in names if _NAME.fullmatch(name)]

    def _find_mark(self, name: str) -> tuple[str, os.stat_result] | None:
        """Return the file that marks a run or a study, and its state; links do not count."""
        for file in (RUN_FILE, STUDY_FILE):
            with suppress(OSError):
                found = (self.path / name / file).lstat()
                if stat.S_ISREG(found.st_mode):
                    return file, found
        return None

    def _entry(self, name: str, file: str, found: os.stat_result) -> dict[str, Any]:
        path, version = self.path / name / file, (found.st_mtime_ns, found.st_size)
        known = self._read.get(path)
        if known is None or known[0] != version:
            known = (version, _entry_of(path, name, found.st_mtime))
            self._read[path] = known
        return known[1]


def _entry_of(path: Path, name: str, changed: float) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if path.name == STUDY_FILE:
            study = values["study"]
            kind, made, summary = "study", changed, f"{study['title']}: {int(study['insertions'])} insertions"
        else:
            kind, made = str(values["kind"]), datetime.fromisoformat(values["timing"]["started"]).timestamp()
            summary = _summary(values)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        kind, made, summary = "damaged", changed, f"{path.name} cannot be read"
    return {"name": name, "kind": kind, "summary": summary, "made": made}


def _summary(values: dict[str, Any]) -> str:
    """Return title of the scenario, target and outcome in one line."""
    target = values["scenario"]["target"]
    place = [target.get(key) for key in ("depth_mm", "lateral_mm", "lateral_z_mm")]
    shown = ", ".join(f"{value:g}" for value in place if value is not None)
    result, ended = values["result"] or {}, str(values["status"])
    for key, what in (("true_error_mm", "off"), ("residual_mm", "off by the tracker")):
        if isinstance(result.get(key), int | float):
            ended += f", {result[key]:.3f} mm {what}"
            break
    return f"{values['scenario']['name']}, target {shown} mm: {ended}"


def zip_run(folder: Path) -> bytes:
    """Return the files of a run as a ZIP archive, in a folder of its name, without links."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.iterdir()):
            if path.is_file() and not path.is_symlink():
                archive.write(path, f"{folder.name}/{path.name}")
    return data.getvalue()


async def export_csv(folder: Path) -> bytes:
    """Return the control periods of a run, as `flexneedle export --csv`. Raises Refusal."""
    return await _run_command("export", str(folder), "--csv", "-")


async def export_replay(folder: Path) -> bytes:
    """Return the replay file of a run, as `flexneedle view --html`. Raises Refusal."""
    return await _run_command("view", str(folder), "--html", "-")


async def _run_command(*arguments: str) -> bytes:
    """Return the output of a command in a separate process, which keeps its imports out of the server."""
    done = await asyncio.to_thread(
        run_module, "flexneedle", *arguments, niceness=_NICENESS, seconds=_EXPORT_S
    )
    if done is None:
        raise Refusal(f"not ready after {_EXPORT_S:g} s")
    if done.returncode:
        raise Refusal(done.stderr.decode(errors="replace").strip().removeprefix("flexneedle: "))
    return done.stdout
