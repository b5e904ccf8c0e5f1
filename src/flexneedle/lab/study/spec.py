"""Study files in TOML; every problem in one line."""

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from flexneedle.errors import InputError
from flexneedle.scenario.dotted import flatten
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.library import Library, label
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.preset import PRESETS
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import Section, Title, count
from flexneedle.scenario.worlds import LARGEST_WORLD

SEED, ALL = "seed", "all"
WORLD, WORLD_CASE, WORLD_RIG = "world", "world_case", "world_rig"
NAMED = ("controller", "plant", "strategy", WORLD_CASE, WORLD_RIG)
TARGET = "target"
TARGET_KEYS = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
STUDIES = Library("a study file", "study", files(__package__) / "studies")
_MAX_VALUES = 100_000
LARGEST_SEED = 2**62
"""Largest first seed: all following seeds of a study fit into a 64-bit column."""
_LARGEST = {SEED: LARGEST_SEED, WORLD: LARGEST_WORLD}


def is_seed(value: Any) -> bool:
    """Whether a value is an integer from 0 to `LARGEST_SEED`."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST_SEED


def _seed(value: int) -> int:
    if not is_seed(value):
        raise ValueError(f"must be from 0 to {LARGEST_SEED}")
    return value


class Axis(Section):
    """One `[[axes]]`: a key and its values; axes are combined in all ways."""

    key: str
    """A key of the scenario, or target, controller, plant, tracker, strategy, plan_seed, seed, world, world_case,
    world_rig."""
    values: Any
    """A list; "all" for every controller, plant, strategy, case or rig of a world; {from, count} for consecutive seeds
    or worlds."""

    @model_validator(mode="after")
    def _check_values(self) -> "Axis":
        refuse(_value_problems(self.key, self.values))
        return self


class Case(Section):
    """One `[[cases]]`: a named set of values."""

    name: Title
    """Name in the column `case`."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key; omitted: the base case."""
    targets: Any = None
    """Targets of the case, in place of an axis of targets: each [depth, y] or [depth, y, z] in mm."""
    reach: bool = False
    """Whether `reach_mm` is computed in this case, too, as in worlds."""

    @model_validator(mode="after")
    def _check_values(self) -> "Case":
        refuse(_settings_problems(self.values))
        if self.targets is not None:
            refuse(_value_problems(TARGET, self.targets, "targets"))
            refuse(_target_twice(self.values))
        return self


class StudyFile(Section):
    """Contents of a study file, before names are looked up and the grid is expanded."""

    name: Title
    """Name, used in the name of the folder."""
    title: Title = "Study"
    """Title of tables and reports."""
    scenario: str = "phantom"
    """Base scenario: name of a preset, or path relative to the folder of the study file."""
    without: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Keys of the base to remove, for example diameters if a gauge is set."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key for the whole study."""
    axes: Annotated[tuple[Axis, ...], Field(strict=False)] = ()
    cases: Annotated[tuple[Case, ...], Field(strict=False)] = ()
    repeats: int = count(1, least=1, most=_MAX_VALUES)
    """Insertions at each point of the grid, each with its own seed."""
    first_seed: Annotated[int, AfterValidator(_seed)] = 0
    """Seed of the first insertion."""

    @model_validator(mode="after")
    def _check_together(self) -> "StudyFile":
        refuse(
            (
                *_settings_problems(self.values),
                *_case_problems(self),
                *_key_problems(self),
                *_seed_problems(self),
                *_world_problems(self),
            )
        )
        return self


def read_study(source: str | Path) -> tuple[StudyFile, Path, str]:
    """Return the study of a shipped name or a TOML file, the folder of the file, and its label in messages.

    Raises FileError with one line for each problem: file, key, value, rule.
    """
    shipped = isinstance(source, str) and source in STUDIES.names()
    return STUDIES.load(source, StudyFile), Path() if shipped else Path(source).parent, label(source)


def base_of(file: StudyFile, home: Path) -> Scenario:
    """Return the base scenario of a study; home: folder of the study file. Raises ScenarioError."""
    return load_scenario(file.scenario if file.scenario in PRESETS.names() else home / file.scenario)


def of_worlds(file: StudyFile, first: int, count: int) -> StudyFile:
    """Return the study with other worlds. Raises InputError if it has no axis of worlds, or for invalid numbers."""
    if all(axis.key != WORLD for axis in file.axes):
        raise InputError("no axis of worlds: --worlds needs one")
    if not (0 <= first <= LARGEST_WORLD and 1 <= count <= _MAX_VALUES):
        rule = f"must be the first number, 0 to {LARGEST_WORLD}, and a count, 1 to {_MAX_VALUES}"
        raise InputError(f"worlds = {first}, {count}: {rule}")
    values = {"from": first, "count": count}
    axes = (Axis(key=WORLD, values=values) if axis.key == WORLD else axis for axis in file.axes)
    return file.model_copy(update={"axes": tuple(axes)})


def settings_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by dotted key; a target [depth, y] or [depth, y, z] becomes the three keys of the scenario."""
    flat = flatten(values)
    if TARGET in flat:
        x, y, z = (*flat.pop(TARGET), 0.0)[:3]
        flat |= dict(zip(TARGET_KEYS, (x, y, z), strict=True))
    return flat


def _keys_of(key: str) -> tuple[str, ...]:
    """Return the scenario keys of an axis."""
    return TARGET_KEYS if key == TARGET else (key,)


def _value_problems(key: str, values: Any, name: str = "values") -> Iterator[Problem]:
    if key in NAMED and values == ALL:
        return
    if key in _LARGEST and isinstance(values, dict):
        yield from _range_problems(values, _LARGEST[key])
    elif not isinstance(values, list) or not values:
        yield Problem(name, values, "must be a list of at least one value")
    elif (twice := _twice(values)) is not None:
        yield Problem(name, values, f"contains {twice!r} twice")
    elif key == TARGET:
        yield from (problem for value in values for problem in _target_problems(name, value))
    elif key in _LARGEST and not all(is_seed(value) and value <= _LARGEST[key] for value in values):
        yield Problem("values", values, f"must be whole numbers from 0 to {_LARGEST[key]}")


def _twice(values: list[Any]) -> Any:
    """Return a duplicate value of a list, or None; equal numbers are duplicates, also 25 and 25.0."""
    times = Counter(map(_comparable, values))
    return next((value for value in values if times[_comparable(value)] > 1), None)


def _comparable(value: Any) -> Hashable:
    if isinstance(value, list):
        return tuple(map(_comparable, value))
    if isinstance(value, dict):
        return frozenset((key, _comparable(item)) for key, item in value.items())
    return (bool, value) if isinstance(value, bool) else value  # True is not equal to 1 here


def _range_problems(values: dict[str, Any], largest: int) -> Iterator[Problem]:
    fine = set(values) == {"from", "count"} and all(map(is_seed, values.values()))
    if not fine or not 1 <= values["count"] <= _MAX_VALUES or values["from"] > largest:
        rule = (
            f"must be a list, or {{from, count}}: from a whole number, 0 to {largest}, "
            f"count 1 to {_MAX_VALUES}"
        )
        yield Problem("values", values, rule)


def _target_problems(key: str, value: Any) -> Iterator[Problem]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        yield Problem(key, value, "must be two or three numbers, [depth, y] or [depth, y, z] in mm")


def _target_twice(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Targets of a case that its values set, too."""
    for key in settings_of(values):
        if key in TARGET_KEYS:
            yield Problem(f"values.{key}", None, "also set by targets")


def _settings_problems(values: Mapping[str, Any]) -> Iterator[Problem]:
    flat = flatten(values)
    if TARGET in flat:
        yield from _target_problems(f"values.{TARGET}", flat[TARGET])
    if SEED in flat:
        rule = "not allowed here: set seeds with first_seed and repeats, or with an axis"
        yield Problem(f"values.{SEED}", flat[SEED], rule)
    if WORLD in flat:
        yield Problem(f"values.{WORLD}", flat[WORLD], "not allowed here: set worlds with an axis")


def _case_problems(study: StudyFile) -> Iterator[Problem]:
    for name, times in Counter(case.name for case in study.cases).items():
        if times > 1:
            yield Problem("cases", name, "names must be unique")


def _key_problems(study: StudyFile) -> Iterator[Problem]:
    """Keys set by two axes, or by an axis and a case."""
    axes = Counter(key for axis in study.axes for key in _keys_of(axis.key))
    for key, times in axes.items():
        if times > 1:
            yield Problem("axes", key, "set by two axes")
    for number, case in enumerate(study.cases):
        for key in settings_of(case.values):
            if key in axes:
                yield Problem(f"cases.{number}.values", key, "also set by an axis")
        if case.targets is not None and axes.keys() & {*TARGET_KEYS, WORLD}:
            yield Problem(f"cases.{number}.targets", None, "also set by an axis")


def _seed_problems(study: StudyFile) -> Iterator[Problem]:
    if any(axis.key == SEED for axis in study.axes):
        for key in sorted({"repeats", "first_seed"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "remove it: an axis sets the seeds")


def _world_problems(study: StudyFile) -> Iterator[Problem]:
    """An axis of worlds sets the scenarios; only worlds have cases."""
    axes = {axis.key for axis in study.axes}
    if WORLD in axes:
        for key in sorted({"scenario", "without"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "remove it: an axis sets the worlds")
    else:
        for key in (WORLD_CASE, WORLD_RIG):
            if key in axes.union(study.values, *(case.values for case in study.cases)):
                yield Problem(key, None, "needs an axis of worlds")
