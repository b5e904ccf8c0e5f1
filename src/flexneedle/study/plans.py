"""The plans of a study: one for all points that plan the same, kept as JSON beside the tables."""

import hashlib
import json
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.planning.origin import SEEN_BY_THE_PLANNER
from flexneedle.study.grid import GridPoint
from flexneedle.study.rows import Planned
from flexneedle.trace.files import replace_file
from flexneedle.trace.plain import plan_from_values, to_text
from flexneedle.types import Plan


def plan_key(point: GridPoint) -> str:
    """Return the name of a point's plan: a digest of all that the planner sees."""
    return _digest(point, (), point.strategy, point.plan_seed)


def truth_key(point: GridPoint) -> str:
    """Return a digest of all that the reach of a point's phantoms depends on, but for the seed."""
    return _digest(point, ("phantom",), point.plant, point.strategy)


def _digest(point: GridPoint, sections: tuple[str, ...], *settings: object) -> str:
    values = point.scenario.values()
    seen = [{name: values[name] for name in (*SEEN_BY_THE_PLANNER, *sections)}, *settings]
    return hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()[:16]


class Plans:
    """Plans by key, in memory and in a folder. A point that has none (`refusals`) is planned again next time.

    Raises InputError if what has the name of the folder is none.
    """

    def __init__(self, folder: Path) -> None:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is no folder, which plans need: move it away")
        self._folder = folder
        self._made: dict[str, tuple[Plan, float]] = {}
        self.refusals: dict[str, str] = {}

    def plan(self, key: str) -> Plan | None:
        """Return the plan of a key, as it stands on disk, or None if there is none (yet)."""
        made = self._find(key)
        return made[0] if made else None

    def seconds(self, key: str) -> float | None:
        """Return the seconds that a plan took, or None if there is no plan."""
        made = self._find(key)
        return made[1] if made else None

    def keep(self, key: str, planned: Planned) -> None:
        """Keep what planning came to."""
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
            self._made[key] = _read(self._path(key))
        return self._made.get(key)


def _read(path: Path) -> tuple[Plan, float]:
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
        return plan_from_values(values["plan"]), float(values["seconds"])
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}: remove it to plan again") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: damaged: {type(error).__name__} {error}: remove it to plan again"
        ) from None
