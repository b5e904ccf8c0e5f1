"""The grid of a study: all its insertions in a fixed order, each with scenario and seed."""

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from flexneedle.control.guide import check_guide
from flexneedle.control.interface import Method
from flexneedle.control.methods import DEFAULT, METHODS, checked
from flexneedle.errors import InputError, ScenarioError
from flexneedle.planning.planner import STRATEGIES
from flexneedle.rig.parts import (
    SCENARIO_TRACKER,
    controller_of,
    digests,
    own_controllers,
    plant_of,
    tracker_of,
)
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PLANTS
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.own import is_own
from flexneedle.scenario.problems import Problem, printable, to_line
from flexneedle.scenario.worlds import CASES, REAL, STRUCTURE, world
from flexneedle.study.spec import (
    ALL,
    LARGEST_SEED,
    SEED,
    WORLD,
    WORLD_CASE,
    Axis,
    StudyFile,
    base_of,
    is_seed,
    of_worlds,
    read_study,
    settings_of,
)
from flexneedle.trace.plain import plain

_DEFAULTS = {
    "controller": DEFAULT,
    "plant": DEFAULT_PLANT,
    "tracker": SCENARIO_TRACKER,
    "strategy": STRATEGIES[0],
    "plan_seed": 0,
}
_CHOICES = {
    "controller": tuple(METHODS),
    "plant": tuple(PLANTS),
    "tracker": (SCENARIO_TRACKER,),
    "strategy": STRATEGIES,
    WORLD_CASE: CASES,
}
_OWN = {"controller": controller_of, "plant": plant_of, "tracker": tracker_of}
_MAX_INSERTIONS = 1_000_000
_FURTHER_KEYS = (
    f"; further keys of a study: {', '.join(_DEFAULTS)}, {WORLD_CASE}, as an axis also {SEED}, {WORLD}"
)


@dataclass(frozen=True)
class GridPoint:
    """A point of the grid: the settings shared by its insertions.

    varied: values of the axes except target and world; target_number: index of the target in the study, or number of
    the world; world: that number, None if the scenario is not a world; world_case: case of the world.
    """

    scenario: Scenario
    case: str
    controller: str
    plant: str
    tracker: str
    strategy: str
    plan_seed: int
    target_number: int
    varied: Mapping[str, Any]
    world: int | None = None
    world_case: str = ""


@dataclass(frozen=True)
class StudyInsertion:
    """One insertion of a study: index of its row, grid point, number of the repeat, seed of the phantom."""

    index: int
    point: GridPoint
    repeat: int
    seed: int


@dataclass(frozen=True)
class Study:
    """An expanded study. definition: all its settings as plain values; seeds: values of an axis of seeds, else ()."""

    definition: Mapping[str, Any]
    points: tuple[GridPoint, ...]
    repeats: int
    first_seed: int
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name, used in the name of the folder."""
        return str(self.definition["name"])

    @property
    def title(self) -> str:
        """Title of tables and reports."""
        return str(self.definition["title"])

    def __len__(self) -> int:
        return len(self.points) * self.repeats

    def insertion(self, index: int) -> StudyInsertion:
        """Return the insertion of a row.

        Without an axis of seeds, every target (or world) and repeat has its own phantom, which is the same at all
        other settings of the study: comparisons are paired.
        """
        number, repeat = divmod(index, self.repeats)
        point = self.points[number]
        own = self.first_seed + point.target_number * self.repeats + repeat
        return StudyInsertion(index, point, repeat, self.seeds[repeat] if self.seeds else own)


def load_study(source: str | Path | Study, worlds: tuple[int, int] | None = None) -> Study:
    """Return the study of a shipped name or a TOML file; a Study is returned unchanged.

    worlds: first number and count, in place of those of the axis of worlds.
    Raises InputError with one line for each problem: file, key, value, rule.
    """
    if isinstance(source, Study):
        return source
    file, home, label = read_study(source)
    try:
        return _expanded(file if worlds is None else of_worlds(file, *worlds), base_of(file, home))
    except InputError as error:
        raise InputError("\n".join(f"{label}: {line}" for line in str(error).splitlines())) from None


def _expanded(file: StudyFile, base: Scenario) -> Study:
    axes = {axis.key: _axis_values(axis) for axis in file.axes}
    seeds = tuple(axes.pop(SEED, ()))
    repeats = len(seeds) or file.repeats
    total = math.prod((len(file.cases) or 1, repeats, *map(len, axes.values())))
    if total > _MAX_INSERTIONS:
        raise InputError(f"insertions = {total}: must be at most {_MAX_INSERTIONS}")
    fixed = _DEFAULTS | settings_of(file.values)
    cases = {case.name: settings_of(case.values) for case in file.cases}
    names = {key: _values_of(key, fixed, cases, axes) for key in _OWN}
    own = own_controllers(names["controller"])
    base = checked(base, *own)
    _check_without(file.without, base)
    points = tuple(_points(base, dict.fromkeys(file.without), fixed, cases or {"": {}}, axes, own))
    definition = {
        "name": file.name,
        "title": file.title,
        "scenario": base.values(),
        "without": list(file.without),
        "values": fixed,
        "cases": cases,
        "axes": axes,
        "repeats": repeats,
        "first_seed": file.first_seed,
        "seeds": list(seeds),
        "insertions": len(points) * repeats,
        "own": digests(name for of_key in names.values() for name in of_key),
    }
    return Study(plain(definition), points, repeats, file.first_seed, seeds)


def _values_of(
    key: str,
    fixed: Mapping[str, Any],
    cases: Mapping[str, Mapping[str, Any]],
    axes: Mapping[str, list[Any]],
) -> list[Any]:
    """All values of a key in a study."""
    return [fixed[key], *(case[key] for case in cases.values() if key in case), *axes.get(key, ())]


def _axis_values(axis: Axis) -> list[Any]:
    if axis.key in _CHOICES and axis.values == ALL:
        return list(_CHOICES[axis.key])
    if isinstance(axis.values, dict):
        first = axis.values["from"]
        return list(range(first, first + axis.values["count"]))
    return list(axis.values)


def _check_without(keys: tuple[str, ...], base: Scenario) -> None:
    for key in keys:
        if key not in base.flat():
            raise InputError(f"without = {json.dumps(key)}: not a key of the scenario")


def _points(
    base: Scenario,
    left_out: Mapping[str, None],
    fixed: Mapping[str, Any],
    cases: Mapping[str, Mapping[str, Any]],
    axes: Mapping[str, list[Any]],
    own: tuple[Method, ...],
) -> Iterator[GridPoint]:
    """Yield the points: cases vary slowest, then the axes in order; later settings override earlier ones."""
    targets: dict[tuple[float, float], int] = {}
    worlds = cache(world)  # the same worlds for every controller
    for case, values in itertools.product(cases, itertools.product(*axes.values())):
        chosen = dict(zip(axes, values, strict=True))
        settings = {**fixed, **cases[case], **settings_of(chosen)}
        named = {"case": case, **chosen} if case else chosen
        at = printable(", ".join(f"{key} = {value}" for key, value in named.items()))
        run = {key: settings.pop(key) for key in _DEFAULTS}
        number, world_case = settings.pop(WORLD, None), settings.pop(WORLD_CASE, REAL)
        _check_run(run | {WORLD_CASE: world_case})
        if number is not None and _is_skipped(worlds(number), run["controller"], world_case):
            continue
        start = base if number is None else worlds(number, world_case)
        scenario = _varied(start, {**left_out, **settings}, own, at)
        _check_guide(run, scenario, at)
        if number is None:
            number, of_world = targets.setdefault(scenario.target.position, len(targets)), {}
        else:
            of_world = {WORLD: number, WORLD_CASE: world_case}
        varied = {
            key: value for key, value in chosen.items() if key != WORLD and not key.startswith("target")
        }
        yield GridPoint(scenario, case, **run, target_number=number, varied=varied, **of_world)


def _is_skipped(scenario: Scenario, controller: str, world_case: str) -> bool:
    """Whether a world without a guide lacks this case, or the controller needs a guide."""
    return not scenario.setup.has_guide and (
        world_case == STRUCTURE or controller_of(controller)[1].needs_guide
    )


def _check_guide(run: Mapping[str, Any], scenario: Scenario, at: str) -> None:
    try:
        check_guide(controller_of(run["controller"])[1], scenario.setup, run["strategy"])
    except InputError as error:
        raise InputError(f"{error}{_suffix(at)}") from None


def _suffix(at: str) -> str:
    return f" (at {at})" if at else ""


def _check_run(run: Mapping[str, Any]) -> None:
    for key, choices in _CHOICES.items():
        if key in _OWN and is_own(run[key]):
            _OWN[key](run[key])
        elif run[key] not in choices:
            more = ", or module:NAME for your own" if key in _OWN else ""
            raise InputError(to_line(Problem(key, run[key], f"must be one of {', '.join(choices)}{more}")))
    if not is_seed(run["plan_seed"]):
        rule = f"must be a whole number from 0 to {LARGEST_SEED}"
        raise InputError(to_line(Problem("plan_seed", run["plan_seed"], rule)))


def _varied(base: Scenario, settings: Mapping[str, Any], own: tuple[Method, ...], at: str) -> Scenario:
    try:
        return checked(base.with_values(settings), *own)
    except ScenarioError as error:
        further = (_FURTHER_KEYS if "unknown key" in problem else "" for problem in error.problems)
        lines = (problem + more + _suffix(at) for problem, more in zip(error.problems, further, strict=True))
        raise InputError("\n".join(lines)) from None
