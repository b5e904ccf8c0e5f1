"""Scenario files by name or path; also files of environments and registrations."""

from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError

from flexneedle.arguments import expand_home, shorten
from flexneedle.errors import ScenarioError
from flexneedle.files import digest_of
from flexneedle.scenario.library import PRESETS, Library, is_world, label
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import describe
from flexneedle.scenario.sections.environment import ENVIRONMENTS, Environment
from flexneedle.scenario.sections.registration import Registration

_REGISTRATIONS = Library("a registration file", error=ScenarioError)


def load_scenario(source: str | Path | Scenario) -> Scenario:
    """Return the scenario of a preset, a world (`wide:100012`, `world:100012`) or a TOML file.

    A scenario is returned unchanged. The name of a preset means the preset, even if a file of that name exists; a name
    that begins with `wide:` or `world:` is a world.

    Raises:
        ScenarioError: One line for each problem: file, key, value, rule.
    """
    if isinstance(source, Scenario):
        return source
    if not isinstance(source, str | Path):
        raise ScenarioError(f"scenario = {shorten(source)}: must be a preset name, a path or a Scenario")
    if isinstance(source, str) and is_world(source):
        from flexneedle.scenario.worlds import named_world

        return named_world(source)
    return Scenario.from_values(_with_files(PRESETS.read(source), source), label(source))


def _with_files(values: dict[str, Any], source: str | Path) -> dict[str, Any]:
    """Return the tables of a scenario with the paths of its zones' files from its own folder, and their SHA-256."""
    zones = values.get("zone")
    if not isinstance(zones, list):
        return values
    folder = expand_home(source).absolute().parent
    return {**values, "zone": [_with_file(zone, folder) for zone in zones]}


def _with_file(zone: Any, folder: Path) -> Any:
    if not isinstance(zone, dict) or not isinstance(zone.get("file"), str):
        return zone
    path = folder / expand_home(zone["file"])
    known = {} if "sha256" in zone or not path.is_file() else {"sha256": digest_of(path)}
    return {**zone, "file": str(path), **known}


def load_environment(source: str | Path) -> Environment:
    """Return the tracker's environment of a shipped name or of a TOML file with the keys of `tracker.environment`.

    Raises:
        ScenarioError: One line for each problem: file, key, value, rule.
    """
    return ENVIRONMENTS.load(source, Environment)


def load_registration(path: Path, scenario: Scenario) -> Scenario:
    """Return the scenario with the registration of a file of `em register`. Raises ScenarioError if it has none."""
    return scenario.with_values({"tracker.registration": read_registration(path).model_dump(mode="json")})


def read_registration(path: Path) -> Registration:
    """Return the registration of a file of `em register`. Raises ScenarioError if it has none."""
    table = _REGISTRATIONS.read(path).get("tracker", {})
    if not isinstance(table, dict) or not isinstance(table.get("registration"), dict):
        raise ScenarioError(f"{label(path)}: has no table [tracker.registration]; em register writes one")
    try:
        return Registration.model_validate(table["registration"])
    except ValidationError as error:
        raise ScenarioError(*(f"{label(path)}: {line}" for line in describe(error, Registration))) from None


def dump_scenario(scenario: Scenario) -> str:
    """Return the scenario, with all defaults, as TOML that loads back equal."""
    return tomli_w.dumps(scenario.values())
