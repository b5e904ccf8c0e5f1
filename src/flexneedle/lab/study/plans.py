"""The plans of a study: one for all points with the same planner inputs, stored as JSON beside the tables."""

import hashlib
import json
from pathlib import Path
from typing import Any

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
    inputs = [{name: values[name] for name in (*PLANNER_INPUTS, *sections)}, *settings]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]


class StudyPlans:
    """Plans by key, in memory and in a folder. Points without a plan (`refusals`) are planned again on resume.

    Raises InputError if the path exists and is not a folder.
    """

    def __init__(self, folder: Path) -> None:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: not a folder, needed for the plans: move it away")
        self._folder = folder
        self._made: dict[str, tuple[Plan, float]] = {}
        self.refusals: dict[str, str] = {}

    def plan(self, key: str) -> Plan | None:
        """Return the plan of a key as stored on disk, or None if there is none (yet)."""
        made = self._find(key)
        return made[0] if made else None

    def seconds(self, key: str) -> float | None:
        """Return the planning time (s), or None if there is no plan."""
        made = self._find(key)
        return made[1] if made else None

    def keep(self, key: str, planned: PlanResult) -> None:
        """Store a plan, or the reason why planning failed."""
        if planned.refusal:
            self.refusals[key] = planned.refusal
        else:
            self._folder.mkdir(exist_ok=True)
            text = to_text({"seconds": planned.seconds, "plan": planned.values})
            replace_file(self._path(key), text.encode())

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"

    def _find(self, key: str) -> tuple[Plan, float] | None:
        if key not in self._made and self._path(key).exists():
            self._made[key] = _read_plan(self._path(key))
        return self._made.get(key)


def _read_plan(path: Path) -> tuple[Plan, float]:
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
        return plan_from_values(values["plan"]), float(values["seconds"])
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}: remove it to plan again") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: {describe_error(error)}: remove it to plan again") from None
