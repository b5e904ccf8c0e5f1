"""Reproduce an insertion of a study: its command, and the scenario file that the command needs."""

import shlex
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import Any

from flexneedle.control.controllers import check_tables
from flexneedle.errors import ScenarioError
from flexneedle.files import replace_file
from flexneedle.lab.study.findings.rows import InsertionRows
from flexneedle.plugins import is_own
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.preset import PRESETS
from flexneedle.scenario.worlds import PLANE, world_name

_SECTIONS = frozenset(Scenario.model_fields)
_OPTIONS = {"--controller": "controller", "--phantom": "plant", "--strategy": "strategy"}


def write_commands(rows: InsertionRows, listed: Iterable[int], folder: Path) -> dict[int, str]:
    """Return the command of each listed row, to be run in `folder`.

    Scenarios that are neither presets nor worlds are written to that folder.
    The command is "" if the settings of the row are not a valid scenario of this version.
    """
    sources = {_identify_settings(check_tables(load_scenario(name))): name for name in PRESETS.names()}
    numbers = count(1)
    found = {}
    for row in dict.fromkeys(listed):
        scenario = _read_scenario(rows, row)
        if scenario is None:
            found[row] = ""
            continue
        key = _identify_settings(scenario)
        if name := _name_world(rows, row):
            sources.setdefault(_identify_settings(check_tables(load_scenario(name))), name)
        if key not in sources:
            sources[key] = f"scenario-{next(numbers)}.toml"
            replace_file(folder / sources[key], dump_scenario(scenario).encode())
        found[row] = _make_command(rows, row, sources[key])
    return found


def _read_scenario(rows: InsertionRows, row: int) -> Scenario | None:
    """Return the scenario of a row, or None if its settings are not valid in this version."""
    keys = [name for name in rows.names if "." in name and name.split(".")[0] in _SECTIONS]
    settings = {key: rows.value(key, row) for key in keys}
    known = {key: value for key, value in settings.items() if value is not None}
    try:
        return Scenario.from_values({"name": "Scenario of a study", **_nest(known)})
    except (ScenarioError, TypeError):
        return None


def _name_world(rows: InsertionRows, row: int) -> str:
    """Return the name of the world of a row, or ""."""
    number = rows.value("world", row)
    if number is None:
        return ""
    return world_name(int(number), rows.value("world_case", row), rows.value("world_rig", row) or PLANE)


def _make_command(rows: InsertionRows, row: int, source: str) -> str:
    words = ["flexneedle", "insert", source, "--target"]
    words += map(_format_number, rows.target(row))
    words += ["--seed", _format_number(rows.value("seed", row))]
    plan_seed = rows.value("plan_seed", row)
    if plan_seed is not None and plan_seed != rows.value("seed", row):
        words += ["--plan-seed", _format_number(plan_seed)]
    for option, name in _OPTIONS.items():
        value = rows.value(name, row)
        words += [option, str(value)] if value is not None else []
    tracker = rows.value("tracker", row)
    words += ["--tracker", str(tracker)] if is_own(tracker) else []
    return shlex.join(words)


def _identify_settings(scenario: Scenario) -> str:
    values = scenario.values()
    return repr({name: value for name, value in values.items() if name not in ("name", "target")})


def _nest(settings: dict[str, Any]) -> Any:
    """Return values by dotted key as nested tables; tables whose keys are 0, 1, … are lists."""
    tables: dict[str, dict[str, Any]] = {}
    for key, value in settings.items():
        head, dot, rest = key.partition(".")
        tables.setdefault(head, {})[rest if dot else ""] = list(value) if isinstance(value, tuple) else value
    nested = {head: inner[""] if "" in inner else _nest(inner) for head, inner in tables.items()}
    if nested and all(key.isdigit() for key in nested):
        return [nested[key] for key in sorted(nested, key=int)]
    return nested


def _format_number(value: Any) -> str:
    short = f"{value:g}" if isinstance(value, float) else ""
    return short if short and float(short) == value else repr(value)
