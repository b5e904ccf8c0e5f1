"""Study files: what is varied, read from TOML, every problem in one line."""

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
from flexneedle.scenario.renamed import current_key
from flexneedle.scenario.sections.fields import Section, Title, count
from flexneedle.scenario.worlds import LARGEST_WORLD

SEED, ALL = "seed", "all"
WORLD, WORLD_CASE = "world", "world_case"
NAMED = ("controller", "plant", "strategy", WORLD_CASE)
_TARGET = "target"
_TARGET_KEYS = ("target.depth_mm", "target.lateral_mm")
STUDIES = Library("a study file", "study", files(__package__) / "studies")
_MOST_VALUES = 100_000
LARGEST_SEED = 2**62
"""A first seed and all that follow it fit into the 64 bits of a column."""
_LARGEST = {SEED: LARGEST_SEED, WORLD: LARGEST_WORLD}


def is_seed(value: Any) -> bool:
    """Whether a value is a whole number from 0 to `LARGEST_SEED`."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST_SEED


def _seed(value: int) -> int:
    if not is_seed(value):
        raise ValueError(f"must be from 0 to {LARGEST_SEED}")
    return value


class Axis(Section):
    """One `[[axes]]`: a key and the values that it takes, each with each of the other axes'."""

    key: Annotated[str, AfterValidator(current_key)]
    """A key of the scenario, or target, controller, plant, tracker, strategy, plan_seed, seed, world, world_case."""
    values: Any
    """A list; "all" for every controller, plant, strategy or case of a world; {from, count} for seeds or worlds that
    follow each other."""

    @model_validator(mode="after")
    def _check_values(self) -> "Axis":
        refuse(_value_problems(self.key, self.values))
        return self


class Case(Section):
    """One `[[cases]]`: values that are set together, under a name."""

    name: Title
    """In the column `case`."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key; left out, the case is the base."""

    @model_validator(mode="after")
    def _check_values(self) -> "Case":
        refuse(_settings_problems(self.values))
        return self


class StudyFile(Section):
    """A study as its file says it; nothing is looked up or multiplied out yet."""

    name: Title
    """In the name of the folder."""
    title: Title = "Study"
    """In tables and reports."""
    scenario: str = "phantom"
    """The base: a preset's name, or a path from the folder of the study file."""
    without: Annotated[tuple[Annotated[str, AfterValidator(current_key)], ...], Field(strict=False)] = ()
    """Keys of the base that are left out, such as diameters where a gauge is given."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key that hold for the whole study."""
    axes: Annotated[tuple[Axis, ...], Field(strict=False)] = ()
    cases: Annotated[tuple[Case, ...], Field(strict=False)] = ()
    repeats: int = count(1, least=1, most=_MOST_VALUES)
    """Insertions at each point of the grid, each with a seed of its own."""
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
    """Return the study of a shipped name or of a TOML file, the folder of the file, and its label in messages.

    Raises FileError with one line for each problem: file, key, value, rule.
    """
    shipped = isinstance(source, str) and source in STUDIES.names()
    return STUDIES.load(source, StudyFile), Path() if shipped else Path(source).parent, label(source)


def base_of(file: StudyFile, home: Path) -> Scenario:
    """Return the base scenario of a study whose file lies in the folder `home`. Raises ScenarioError."""
    return load_scenario(file.scenario if file.scenario in PRESETS.names() else home / file.scenario)


def of_worlds(file: StudyFile, first: int, count: int) -> StudyFile:
    """Return the study on other worlds. Raises InputError if it has no axis of worlds, or for numbers of none."""
    if all(axis.key != WORLD for axis in file.axes):
        raise InputError("has no axis of worlds")
    if not (0 <= first <= LARGEST_WORLD and 1 <= count <= _MOST_VALUES):
        rule = f"must be a first number, 0 to {LARGEST_WORLD}, and a count, 1 to {_MOST_VALUES}"
        raise InputError(f"worlds = {first}, {count}: {rule}")
    values = {"from": first, "count": count}
    axes = (Axis(key=WORLD, values=values) if axis.key == WORLD else axis for axis in file.axes)
    return file.model_copy(update={"axes": tuple(axes)})


def settings_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by dotted key, a target [depth, lateral] as the two keys of the scenario."""
    flat = {current_key(key): value for key, value in flatten(values).items()}
    if _TARGET in flat:
        flat |= dict(zip(_TARGET_KEYS, flat.pop(_TARGET), strict=True))
    return flat


def _keys_of(key: str) -> tuple[str, ...]:
    """Return the keys that an axis sets."""
    return _TARGET_KEYS if key == _TARGET else (key,)


def _value_problems(key: str, values: Any) -> Iterator[Problem]:
    if key in NAMED and values == ALL:
        return
    if key in _LARGEST and isinstance(values, dict):
        yield from _range_problems(values, _LARGEST[key])
    elif not isinstance(values, list) or not values:
        yield Problem("values", values, "must be a list of at least one value")
    elif (twice := _twice(values)) is not None:
        yield Problem("values", values, f"has {twice!r} twice")
    elif key == _TARGET:
        yield from (problem for value in values for problem in _target_problems("values", value))
    elif key in _LARGEST and not all(is_seed(value) and value <= _LARGEST[key] for value in values):
        yield Problem("values", values, f"must be whole numbers from 0 to {_LARGEST[key]}")


def _twice(values: list[Any]) -> Any:
    """Return a value that stands in a list twice, or None; equal numbers are the same value, 25 and 25.0 too."""
    times = Counter(map(_comparable, values))
    return next((value for value in values if times[_comparable(value)] > 1), None)


def _comparable(value: Any) -> Hashable:
    if isinstance(value, list):
        return tuple(map(_comparable, value))
    if isinstance(value, dict):
        return frozenset((key, _comparable(item)) for key, item in value.items())
    return (bool, value) if isinstance(value, bool) else value  # True is no 1 here


def _range_problems(values: dict[str, Any], largest: int) -> Iterator[Problem]:
    fine = set(values) == {"from", "count"} and all(map(is_seed, values.values()))
    if not fine or not 1 <= values["count"] <= _MOST_VALUES or values["from"] > largest:
        rule = (
            f"must be a list, or {{from, count}}: from a whole number, 0 to {largest}, "
            f"count 1 to {_MOST_VALUES}"
        )
        yield Problem("values", values, rule)


def _target_problems(key: str, value: Any) -> Iterator[Problem]:
    if not isinstance(value, list) or len(value) != 2:
        yield Problem(key, value, "a target must be two numbers, [depth, lateral] in mm")


def _settings_problems(values: Mapping[str, Any]) -> Iterator[Problem]:
    flat = flatten(values)
    if _TARGET in flat:
        yield from _target_problems(f"values.{_TARGET}", flat[_TARGET])
    if SEED in flat:
        rule = "seeds are set by first_seed and repeats, or by an axis"
        yield Problem(f"values.{SEED}", flat[SEED], rule)
    if WORLD in flat:
        yield Problem(f"values.{WORLD}", flat[WORLD], "worlds are set by an axis")


def _case_problems(study: StudyFile) -> Iterator[Problem]:
    for name, times in Counter(case.name for case in study.cases).items():
        if times > 1:
            yield Problem("cases", name, "two cases have this name")


def _key_problems(study: StudyFile) -> Iterator[Problem]:
    """No key is set by two axes, or by an axis and a case."""
    axes = Counter(key for axis in study.axes for key in _keys_of(axis.key))
    for key, times in axes.items():
        if times > 1:
            yield Problem("axes", key, "two axes set this key")
    for number, case in enumerate(study.cases):
        for key in settings_of(case.values):
            if key in axes:
                yield Problem(f"cases.{number}.values", key, "an axis sets this key too")


def _seed_problems(study: StudyFile) -> Iterator[Problem]:
    if any(axis.key == SEED for axis in study.axes):
        for key in sorted({"repeats", "first_seed"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "leave it out: an axis gives the seeds")


def _world_problems(study: StudyFile) -> Iterator[Problem]:
    """An axis of worlds gives the scenarios; only worlds have cases."""
    axes = {axis.key for axis in study.axes}
    if WORLD in axes:
        for key in sorted({"scenario", "without"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "leave it out: an axis gives the worlds")
    elif WORLD_CASE in axes.union(study.values, *(case.values for case in study.cases)):
        yield Problem(WORLD_CASE, None, "needs an axis of worlds")
