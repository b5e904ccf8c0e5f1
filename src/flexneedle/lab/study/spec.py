"""Study files in TOML; every problem in one line."""

from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from flexneedle.arguments import expand_home
from flexneedle.errors import InputError
from flexneedle.scenario.alternatives import find_replaced, spell
from flexneedle.scenario.dotted import flatten
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.library import PRESETS, Library, label
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import Section, Title, count
from flexneedle.scenario.worlds import LARGEST_WORLD

SEED, ALL = "seed", "all"
WORLD, WORLD_CASE, WORLD_RIG, WORLD_KIND = "world", "world_case", "world_rig", "world_kind"
NAMED = ("controller", "plant", "strategy", WORLD_CASE, WORLD_RIG, WORLD_KIND)
TARGET = "target"
TARGET_KEYS = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
STUDIES = Library("a study file", "study", files(__package__) / "studies")
_MAX_VALUES = 100_000
LARGEST_SEED = 2**62
"""Largest first seed: all following seeds of a study fit into a 64-bit column."""
_LARGEST = {SEED: LARGEST_SEED, WORLD: LARGEST_WORLD}


def is_seed(value: Any) -> bool:
    """Return whether a value is an integer from 0 to `LARGEST_SEED`."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST_SEED


def _check_seed(value: int) -> int:
    if not is_seed(value):
        raise ValueError(f"must be from 0 to {LARGEST_SEED}")
    return value


class StudyAxis(Section):
    """One `[[axes]]`: a key and its values; axes are combined in all ways."""

    key: Annotated[str, AfterValidator(spell)]
    """A key of the scenario, or target, controller, plant, tracker, strategy, plan_seed, seed, world, world_case,
    world_rig, world_kind."""
    values: Any
    """A list; "all" for every controller, plant, strategy, case, rig or kind of a world; {from, count} for consecutive
    seeds or worlds."""

    @model_validator(mode="after")
    def _check_values(self) -> "StudyAxis":
        refuse(_check_axis_values(self.key, self.values))
        return self


class StudyCase(Section):
    """One `[[cases]]`: a named set of values."""

    name: Title
    """Name in the column `case`."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key; omitted: the base case."""
    targets: Any = None
    """Targets of the case, in place of an axis of targets: each [depth, y] or [depth, y, z] in mm."""
    reach: bool = False
    """Whether `reach_mm` is also computed in this case, as in worlds."""

    @model_validator(mode="after")
    def _check_values(self) -> "StudyCase":
        refuse(_check_settings(self.values))
        if self.targets is not None:
            refuse(_check_axis_values(TARGET, self.targets, "targets"))
            refuse(_check_target_once(self.values))
        return self


class StudyFile(Section):
    """Contents of a study file, before names are resolved and the grid is expanded."""

    name: Title
    """Name, used in the name of the folder."""
    title: Title = "Study"
    """Title of tables and reports."""
    scenario: str = "phantom"
    """Base scenario: name of a preset, or path relative to the folder of the study file."""
    without: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Keys of the base to remove, for example `setup.guide_to_skin_mm`."""
    values: dict[str, Any] = Field(default_factory=dict)
    """Values by dotted key for the whole study."""
    axes: Annotated[tuple[StudyAxis, ...], Field(strict=False)] = ()
    cases: Annotated[tuple[StudyCase, ...], Field(strict=False)] = ()
    repeats: int = count(1, least=1, most=_MAX_VALUES)
    """Insertions at each point of the grid, each with its own seed."""
    first_seed: Annotated[int, AfterValidator(_check_seed)] = 0
    """Seed of the first insertion."""

    @model_validator(mode="after")
    def _check_together(self) -> "StudyFile":
        refuse(
            (
                *_check_settings(self.values),
                *_check_cases(self),
                *_check_keys(self),
                *_check_seeds(self),
                *_check_worlds(self),
            )
        )
        return self


def read_study_file(source: str | Path) -> tuple[StudyFile, Path, str]:
    """Return the study of a shipped name or a TOML file, the folder of the file, and its label in messages.

    Raises FileError with one line for each problem: file, key, value, rule.
    """
    shipped = isinstance(source, str) and source in STUDIES.names()
    return STUDIES.load(source, StudyFile), Path() if shipped else expand_home(source).parent, label(source)


def load_base(file: StudyFile, home: Path) -> Scenario:
    """Return the base scenario of a study; home: folder of the study file. Raises ScenarioError."""
    return load_scenario(
        file.scenario if file.scenario in PRESETS.names() else home / expand_home(file.scenario)
    )


def with_worlds(file: StudyFile, first: int, count: int) -> StudyFile:
    """Return the study with other worlds. Raises InputError if it has no axis of worlds, or for invalid numbers."""
    if all(axis.key != WORLD for axis in file.axes):
        raise InputError("no axis of worlds: --worlds needs one")
    if not (0 <= first <= LARGEST_WORLD and 1 <= count <= _MAX_VALUES):
        rule = f"must be the first number, 0 to {LARGEST_WORLD}, and a count, 1 to {_MAX_VALUES}"
        raise InputError(f"worlds = {first}, {count}: {rule}")
    values = {"from": first, "count": count}
    axes = (StudyAxis(key=WORLD, values=values) if axis.key == WORLD else axis for axis in file.axes)
    return file.model_copy(update={"axes": tuple(axes)})


def flatten_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by dotted key; a target [depth, y] or [depth, y, z] becomes the three keys of the scenario."""
    flat = {spell(key): value for key, value in flatten(values).items()}
    if TARGET in flat:
        x, y, z = (*flat.pop(TARGET), 0.0)[:3]
        flat |= dict(zip(TARGET_KEYS, (x, y, z), strict=True))
    return flat


def _list_keys(key: str) -> tuple[str, ...]:
    """Return the scenario keys of an axis."""
    return TARGET_KEYS if key == TARGET else (key,)


def _check_axis_values(key: str, values: Any, name: str = "values") -> Iterator[Problem]:
    if key in NAMED and values == ALL:
        return
    if key in _LARGEST and isinstance(values, dict):
        yield from _check_range(values, _LARGEST[key])
    elif not isinstance(values, list) or not values:
        choice = f', or "{ALL}"' if key in NAMED else ""
        yield Problem(name, values, f"must be a list of at least one value{choice}")
    elif (twice := _find_duplicate(values)) is not None:
        yield Problem(name, values, f"contains {twice!r} twice")
    elif key == TARGET:
        yield from (problem for value in values for problem in _check_target(name, value))
    elif key in _LARGEST and not all(is_seed(value) and value <= _LARGEST[key] for value in values):
        yield Problem("values", values, f"must be whole numbers from 0 to {_LARGEST[key]}")


def _find_duplicate(values: list[Any]) -> Any:
    """Return a duplicate value of a list, or None; equal values are duplicates, also 25 and 25.0."""
    times = Counter(map(_make_comparable, values))
    return next((value for value in values if times[_make_comparable(value)] > 1), None)


def _make_comparable(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_make_comparable, value))
    if isinstance(value, dict):
        return frozenset((key, _make_comparable(item)) for key, item in value.items())
    return value


def _check_range(values: dict[str, Any], largest: int) -> Iterator[Problem]:
    fine = set(values) == {"from", "count"} and all(map(is_seed, values.values()))
    if not fine or not 1 <= values["count"] <= _MAX_VALUES or values["from"] > largest:
        rule = (
            f"must be a list, or {{from, count}}: from a whole number, 0 to {largest}, "
            f"count 1 to {_MAX_VALUES}"
        )
        yield Problem("values", values, rule)


def _check_target(key: str, value: Any) -> Iterator[Problem]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        yield Problem(key, value, "must be two or three numbers, [depth, y] or [depth, y, z] in mm")


def _check_target_once(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield the targets of a case that its values also set."""
    for key in flatten_settings(values):
        if key in TARGET_KEYS:
            yield Problem(f"values.{key}", None, "also set by targets")


def _check_settings(values: Mapping[str, Any]) -> Iterator[Problem]:
    flat = flatten(values)
    if TARGET in flat:
        yield from _check_target(f"values.{TARGET}", flat[TARGET])
    if SEED in flat:
        rule = "not allowed here: set seeds with first_seed and repeats, or with an axis"
        yield Problem(f"values.{SEED}", flat[SEED], rule)
    if WORLD in flat:
        yield Problem(f"values.{WORLD}", flat[WORLD], "not allowed here: set worlds with an axis")


def _check_cases(study: StudyFile) -> Iterator[Problem]:
    for name, times in Counter(case.name for case in study.cases).items():
        if times > 1:
            yield Problem("cases", name, "names must be unique")


def _check_keys(study: StudyFile) -> Iterator[Problem]:
    """Yield the keys set by two axes, or by an axis and a case."""
    axes = Counter(key for axis in study.axes for key in _list_keys(axis.key))
    for key, times in axes.items():
        if times > 1:
            yield Problem("axes", key, "set by two axes")
    taken = {*axes, *find_replaced(dict.fromkeys(axes, 0.0))}
    for number, case in enumerate(study.cases):
        for key in flatten_settings(case.values):
            if key in taken:
                yield Problem(f"cases.{number}.values", key, "also set by an axis")
        if case.targets is not None and axes.keys() & {*TARGET_KEYS, WORLD}:
            yield Problem(f"cases.{number}.targets", None, "also set by an axis")


def _check_seeds(study: StudyFile) -> Iterator[Problem]:
    if any(axis.key == SEED for axis in study.axes):
        for key in sorted({"repeats", "first_seed"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "remove it: an axis sets the seeds")


def _check_worlds(study: StudyFile) -> Iterator[Problem]:
    """Yield keys that conflict with an axis of worlds, or need one."""
    axes = {axis.key for axis in study.axes}
    if WORLD in axes:
        for key in sorted({"scenario", "without"} & study.model_fields_set):
            yield Problem(key, getattr(study, key), "remove it: an axis sets the worlds")
    else:
        for key in (WORLD_CASE, WORLD_RIG, WORLD_KIND):
            if key in axes.union(study.values, *(case.values for case in study.cases)):
                yield Problem(key, None, "needs an axis of worlds")
