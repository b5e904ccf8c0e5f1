"""The plans of a study: one for all points with the same planner inputs, stored as JSON beside the tables."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from flexneedle.errors import InputError, describe_error
from flexneedle.files import replace_file
from flexneedle.lab.study.grid import StudyPoint
from flexneedle.lab.study.jobs import PlanResult
from flexneedle.planning.origin import PLANNER_INPUTS
from flexneedle.record.plain import plan_from_values, to_text
from flexneedle.results import Plan


def digest_plan_inputs(point: StudyPoint) -> str:
    """Return the key of a point's plan: a digest of all planner inputs."""
    return _digest(point, (), point.strategy, point.plan_seed)


def digest_reach_inputs(point: StudyPoint) -> str:
    """Return a digest of all inputs of the reach of a point's phantoms, except the seed."""
    return _digest(point, ("phantom",), point.plant, point.strategy)


def _digest(point: StudyPoint, sections: tuple[str, ...], *settings: object) -> str:
    values = point.scenario.values()
    inputs = [{name: values.get(name) for name in (*PLANNER_INPUTS, *sections)}, *settings]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]


class StudyPlans:
    """Plans by key, in memory and in a folder. Points without a plan (`refusals`) are planned again on resume.

    Raises InputError if the path exists and is not a folder.
    """

    def __init__(self, folder: Path) -> None:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: not a folder, needed for the plans: move it away")
        self._folder = folder
        self._made: dict[str, _Stored] = {}
        self.refusals: dict[str, str] = {}

    def plan(self, key: str) -> Plan | None:
        """Return the plan of a key as stored on disk, or None if there is none (yet)."""
        made = self._find(key)
        return made.plan if made else None

    def plan_for(self, key: str, point: StudyPoint) -> Plan | None:
        """Return the plan of a key with the scenario of a point and the entry that the plan has chosen."""
        made = self._find(key)
        if made is None or not made.entry:
            return made.plan if made else None
        entry = {f"entry.{name}": value for name, value in made.entry.items()}
        return replace(made.plan, scenario=point.scenario.with_values(entry))

    def seconds(self, key: str) -> float | None:
        """Return the planning time (s), or None if there is no plan."""
        made = self._find(key)
        return made.seconds if made else None

    def keep(self, key: str, planned: PlanResult) -> None:
        """Store a plan, or the reason why planning failed."""
        if planned.refusal:
            self.refusals[key] = planned.refusal
        else:
            self._folder.mkdir(exist_ok=True)
            text = to_text({"seconds": planned.seconds, "entry": planned.entry, "plan": planned.values})
            replace_file(self._path(key), text.encode())

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"

    def _find(self, key: str) -> "_Stored | None":
        if key not in self._made and self._path(key).exists():
            self._made[key] = _read_plan(self._path(key))
        return self._made.get(key)


class _Stored(NamedTuple):
    """A plan without its scenario, its planning time (s), and the values of the entry that it has chosen, if any."""

    plan: Plan
    seconds: float
    entry: dict[str, float]


def _read_plan(path: Path) -> _Stored:
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
        return _Stored(plan_from_values(values["plan"]), float(values["seconds"]), values.get("entry", {}))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}: remove it to plan again") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: {describe_error(error)}: remove it to plan again") from None
