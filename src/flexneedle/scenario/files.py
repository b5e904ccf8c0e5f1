"""Scenario files: presets, reading, writing. Files of environments, too."""

import tomllib
from os import fspath
from pathlib import Path
from typing import IO

import tomli_w
from pydantic import ValidationError

from flexneedle.errors import InputError, ScenarioError
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.preset import WORLD, preset_names, preset_values
from flexneedle.scenario.problems import describe, printable
from flexneedle.scenario.sections.environment import Environment, environment_data, environment_names
from flexneedle.scenario.sections.registration import Registration

# A scenario has a few kB; the bound keeps an endless file such as /dev/zero from filling the memory.
_LARGEST_FILE = 1_000_000


def load_scenario(source: str | Path | Scenario) -> Scenario:
    """Return the scenario of a preset's name, of a world's (`world:100012`) or of a TOML file.

    A scenario is returned as it is. A text that is the name of a preset means the preset, also where a file has that
    name, and one that begins with `world:` a world.
    Raises ScenarioError with one line for each problem: file, key, value, rule.
    """
    if isinstance(source, Scenario):
        return source
    if not isinstance(source, str | Path):
        raise ScenarioError(f"a scenario is a preset name, a path or a Scenario, not {type(source).__name__}")
    if isinstance(source, str) and source in preset_names():
        return Scenario.from_values(preset_values(source), source)
    if isinstance(source, str) and source.startswith(WORLD):
        from flexneedle.scenario.worlds import named_world

        return named_world(source)
    data = _read(source, "a scenario file", f"preset (presets: {', '.join(preset_names())})")
    label = printable(fspath(source))
    return Scenario.from_values(_parse(data, label), label)


def load_environment(source: str | Path) -> Environment:
    """Return the tracker's environment of a shipped name or of a TOML file, whose keys are those of
    `tracker.environment`.

    Raises ScenarioError with one line for each problem: file, key, value, rule.
    """
    names = environment_names()
    if isinstance(source, str) and source in names:
        data = environment_data(source)
    else:
        data = _read(source, "an environment file", f"environment (environments: {', '.join(names)})")
    label = printable(fspath(source))
    try:
        return Environment.model_validate(_parse(data, label))
    except ValidationError as error:
        raise ScenarioError(*(f"{label}: {line}" for line in describe(error, Environment))) from None


def load_registration(path: Path, scenario: Scenario) -> Scenario:
    """Return the scenario with the registration of a file. Raises InputError for a file that has none."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        table = values["tracker"]["registration"]
        Registration.model_validate(table)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no TOML: {error}") from None
    except (KeyError, TypeError):
        raise InputError(f"{path}: has no table [tracker.registration]; em register writes one") from None
    except ValidationError as error:
        raise InputError("\n".join(f"{path}: {line}" for line in describe(error, Registration))) from None
    return scenario.with_values({"tracker.registration": table})


def dump_scenario(scenario: Scenario) -> str:
    """Return the scenario, with all defaults, as TOML that loads back equal."""
    return tomli_w.dumps(scenario.values())


def _read(source: str | Path, kind: str, shipped: str) -> bytes:
    """Read a file; kind: "a scenario file"; shipped: what else its name might have been."""
    label = printable(fspath(source)) or '""'
    try:
        with Path(source).open("rb") as file:
            return _read_bounded(file, label, kind)
    except FileNotFoundError:
        raise ScenarioError(f"{label}: no such file, and no such {shipped}") from None
    except IsADirectoryError:
        raise ScenarioError(f"{label}: is a directory, not {kind}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ScenarioError(f"{label}: cannot be read: {reason}") from None


def _read_bounded(file: IO[bytes], label: str, kind: str) -> bytes:
    data = file.read(_LARGEST_FILE + 1)
    if len(data) > _LARGEST_FILE:
        raise ScenarioError(f"{label}: larger than {_LARGEST_FILE} bytes, not {kind}")
    return data


def _parse(data: bytes, label: str) -> dict[str, object]:
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"{label}: not UTF-8 (at line {line}): save the file as UTF-8") from None
    except RecursionError:
        raise ScenarioError(f"{label}: not TOML: nested too deeply") from None
    except ValueError as error:
        raise ScenarioError(f"{label}: not TOML: {printable(str(error))}") from None
