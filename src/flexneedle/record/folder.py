"""The folder of a run: created once, with a `run.json` that is always complete.

`run.json` has format, kind ("plan", "insertion" or "map"), status, reason, seed, versions, scenario, result, timing
and plans; for an insertion also controller, controller_name, phantom, tracker, rig, dry_run and disturbed. A plan that
chose where the needle enters has its own section `entry`; the scenario of an insertion has the entry of its plan. All
except `timing`, the date and the wall-clock times, is the same for the same seed.
"""

import hashlib
import json
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError, ScenarioError
from flexneedle.files import create_folder, replace_file
from flexneedle.record.plain import plan_from_values, plan_values, to_text
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario

RUN_FILE, TRACE_FILE, STUDY_FILE = "run.json", "trace.mcap", "study.json"
ENTRIES_FILE = "entries.json"
_PACKAGE = Path(__file__).parents[1]
_SOURCES = (".py", ".toml", ".json")
_DIGITS = 12
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class RunFile:
    """Contents of `run.json`; status: "running" (or killed), "done", "held", "failed" or "interrupted".

    controller, phantom, tracker, rig: of an insertion, "" if not recorded; dry_run: true if the rig did not move;
    disturbed: disturbances by a person, with their times.
    """

    folder: Path
    kind: str
    status: str
    reason: str
    seed: int
    scenario: Scenario
    plans: dict[str, Plan]
    result: Mapping[str, Any] | None
    timing: Mapping[str, Any]
    controller: str
    phantom: str
    tracker: str
    rig: str = ""
    dry_run: bool = False
    disturbed: str = ""
    controller_name: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(eq=False)
class Folder:
    """A folder of a run and the values of its `run.json`, written by `write`.

    problems: a line for each file of the record that could not be written at the end of the run; undrawn: a line for
    each figure that could not be drawn, which is no part of the record.
    """

    path: Path
    values: dict[str, Any]
    timing: dict[str, Any]
    plans: dict[str, Plan] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    undrawn: list[str] = field(default_factory=list)

    @classmethod
    def claim(
        cls,
        out: Path | None,
        name: str,
        kind: str,
        scenario: Scenario,
        seed: int,
        made_by: Mapping[str, str] | None = None,
    ) -> "Folder":
        """Create the folder `out`, or one in `runs/` named by date, `name` and seed, with the status "running".

        made_by: versions that made a loaded record (default: the present ones). Raises InputError if the folder already
        contains a run or a study, or cannot be created.
        """
        now = datetime.now(UTC)
        path = _make(create_folder(name, str(seed), now=now) if out is None else out)
        values = {
            "format": _FORMAT,
            "kind": kind,
            "status": "running",
            "reason": "",
            "seed": seed,
            "versions": dict(made_by or versions()),
            "scenario": scenario.values(),
            "result": None,
        }
        folder = cls(path, values, {"started": f"{now:%Y-%m-%dT%H:%M:%SZ}"})
        folder.write()
        return folder

    def write(self) -> None:
        """Write `run.json` in one step: readers get the old or the new text, never a part. Raises RecordError."""
        plans = {name: self._chosen_entry(plan) | plan_values(plan) for name, plan in self.plans.items()}
        text = to_text({**self.values, "timing": self.timing, "plans": plans})
        replace_file(self.path / RUN_FILE, text.encode())

    def _chosen_entry(self, plan: Plan) -> dict[str, Any]:
        """Return the section `entry` of a plan if it differs from the entry of the run's scenario."""
        if plan.scenario is None:
            return {}
        entry = plan.scenario.values()["entry"]
        return {} if entry == self.values["scenario"]["entry"] else {"entry": entry}

    def end(self, status: str, reason: str = "") -> None:
        """Set the final status, and write."""
        self.values |= {"status": status, "reason": reason}
        self.write()


def versions() -> dict[str, str]:
    """Return the versions on which the numbers of a run depend.

    Of packages, as loaded, even if others have been installed since; source: digest of the code and data of this
    package, to tell an edited copy from the release.
    """
    return {
        "flexneedle": version("flexneedle"),
        "python": platform.python_version(),
        **{name: _loaded_version(name) for name in ("numpy", "numba", "scipy")},
        "source": source_digest(_PACKAGE),
    }


def _loaded_version(package: str) -> str:
    return str(getattr(sys.modules.get(package), "__version__", None) or version(package))


@cache
def source_digest(package: Path) -> str:
    """Return a digest of the sources in a folder: of the relative path and the bytes of each."""
    digest = hashlib.sha256()
    found = (path for path in package.rglob("*") if path.suffix in _SOURCES and path.is_file())
    paths = {path.relative_to(package).as_posix(): path for path in found}
    for name in sorted(paths):
        data = paths[name].read_bytes()
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()[:_DIGITS]


def read_run(folder: Path) -> RunFile:
    """Return the contents of `run.json` in a folder. Raises InputError if it is missing or damaged."""
    path = folder / RUN_FILE
    if folder.is_file():
        raise InputError(f"{folder}: is a file: must be the folder of a run{_folder_of(folder)}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{folder}: contains no run: {RUN_FILE} is missing") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}") from None
    return _check_run(path, values)


def _folder_of(file: Path) -> str:
    return f", here {file.parent}" if (file.parent / RUN_FILE).is_file() else ""


def _check_run(path: Path, values: Any) -> RunFile:
    if not isinstance(values, dict) or values.get("format") != _FORMAT:
        raise InputError(f"{path}: not a run of this version of flexneedle: format must be {_FORMAT}")
    try:
        read = values["plans"].items()
        named = {name: values[name] for name in ("kind", "status", "reason", "seed", "result", "timing")}
        named |= {
            name: values.get(name, "")
            for name in ("controller", "controller_name", "phantom", "tracker", "rig", "disturbed")
        }
        named["versions"] = dict(values["versions"])
        named["dry_run"] = values.get("dry_run", False) is True
        scenario = Scenario.from_values(values["scenario"])
        plans = {
            name: replace(_plan(plan, values["scenario"]), versions=named["versions"]) for name, plan in read
        }
        return RunFile(path.parent, scenario=scenario, plans=plans, **named)
    except ScenarioError as error:
        raise InputError(f"{path}: damaged: {error.problems[0]}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: damaged: {type(error).__name__} {error}") from None


def _plan(values: dict[str, Any], scenario: dict[str, Any]) -> Plan:
    """Return the plan of a run, with the run's scenario, at the entry that the plan has chosen."""
    chosen = {name: values[name] for name in ("entry",) if name in values}
    plan = plan_from_values({name: value for name, value in values.items() if name not in chosen})
    return replace(plan, scenario=Scenario.from_values(scenario | chosen))


def _make(path: Path) -> Path:
    try:
        found = next((name for name in (RUN_FILE, TRACE_FILE, STUDY_FILE) if (path / name).exists()), None)
        if found is not None:
            kind = "study" if found == STUDY_FILE else "run"
            raise InputError(f"{path}: already contains a {kind} ({found}): choose another folder")
        path.mkdir(parents=True, exist_ok=True)
        (path / RUN_FILE).touch(exist_ok=False)  # of two simultaneous runs one gets the folder
    except FileExistsError:
        raise InputError(
            f"{path}: already exists and is not an empty folder: choose another folder"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror}") from None
    return path
