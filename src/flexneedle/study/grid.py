"""The grid of a study: every insertion that it asks for, in a fixed order, each with its scenario and seed."""

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
    is_own,
    own_controllers,
    plant_of,
    tracker_of,
)
from flexneedle.rig.phantom.plants import DEFAULT_PLANT, PLANTS
from flexneedle.scenario.model import Scenario
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
_MOST_INSERTIONS = 1_000_000
_BESIDES = f"; besides: {', '.join(_DEFAULTS)}, {WORLD_CASE}, as an axis also {SEED}, {WORLD}"


@dataclass(frozen=True)
class GridPoint:
    """A point of the grid: everything that its insertions share.

    varied: what the axes chose, but for target and world; target_number: place of the target among those of the
    study, or the number of its world; world: that number, None if the scenario is no world; world_case: which case.
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
    """One insertion of a study: its row, its point, which repeat it is, and the seed of its phantom."""

    index: int
    point: GridPoint
    repeat: int
    seed: int


@dataclass(frozen=True)
class Study:
    """A study, multiplied out. definition: all that it depends on, as plain values; seeds: of an axis, else ()."""

    definition: Mapping[str, Any]
    points: tuple[GridPoint, ...]
    repeats: int
    first_seed: int
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name in the name of the folder."""
        return str(self.definition["name"])

    @property
    def title(self) -> str:
        """Title in tables and reports."""
        return str(self.definition["title"])

    def __len__(self) -> int:
        return len(self.points) * self.repeats

    def insertion(self, index: int) -> StudyInsertion:
        """Return the insertion of a row.

        Without an axis of seeds, every target (or world) and repeat has a phantom of its own, and the same one at
        every other setting of the study: comparisons are paired.
        """
        number, repeat = divmod(index, self.repeats)
        point = self.points[number]
        own = self.first_seed + point.target_number * self.repeats + repeat
        return StudyInsertion(index, point, repeat, self.seeds[repeat] if self.seeds else own)


def load_study(source: str | Path | Study, worlds: tuple[int, int] | None = None) -> Study:
    """Return the study of a shipped name or a TOML file; a study is returned as it is.

    worlds: first number and count, instead of those of the file's axis of worlds.
    Raises InputError with one line for each problem: file, key, value, rule.
    """
    if isinstance(source, Study):
        return source
    file, home, label = read_study(source)
    try:
        return _multiplied(file if worlds is None else of_worlds(file, *worlds), base_of(file, home))
    except InputError as error:
        raise InputError("\n".join(f"{label}: {line}" for line in str(error).splitlines())) from None


def _multiplied(file: StudyFile, base: Scenario) -> Study:
    axes = {axis.key: _values(axis) for axis in file.axes}
    seeds = tuple(axes.pop(SEED, ()))
    repeats = len(seeds) or file.repeats
    wanted = math.prod((len(file.cases) or 1, repeats, *map(len, axes.values())))
    if wanted > _MOST_INSERTIONS:
        raise InputError(f"asks for {wanted} insertions: must be at most {_MOST_INSERTIONS}")
    fixed = _DEFAULTS | settings_of(file.values)
    cases = {case.name: settings_of(case.values) for case in file.cases}
    given = {key: _given(key, fixed, cases, axes) for key in _OWN}
    own = own_controllers(given["controller"])
    base = checked(base, *own)
    _check_left_out(file.without, base)
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
        "own": digests(name for names in given.values() for name in names),
    }
    return Study(plain(definition), points, repeats, file.first_seed, seeds)


def _given(
    key: str,
    fixed: Mapping[str, Any],
    cases: Mapping[str, Mapping[str, Any]],
    axes: Mapping[str, list[Any]],
) -> list[Any]:
    """All values that a study gives to a key."""
    return [fixed[key], *(case[key] for case in cases.values() if key in case), *axes.get(key, ())]


def _values(axis: Axis) -> list[Any]:
    if axis.key in _CHOICES and axis.values == ALL:
        return list(_CHOICES[axis.key])
    if isinstance(axis.values, dict):
        first = axis.values["from"]
        return list(range(first, first + axis.values["count"]))
    return list(axis.values)


def _check_left_out(keys: tuple[str, ...], base: Scenario) -> None:
    for key in keys:
        if key not in base.flat():
            raise InputError(f"without = {json.dumps(key)}: the scenario has no such value")


def _points(
    base: Scenario,
    left_out: Mapping[str, None],
    fixed: Mapping[str, Any],
    cases: Mapping[str, Mapping[str, Any]],
    axes: Mapping[str, list[Any]],
    own: tuple[Method, ...],
) -> Iterator[GridPoint]:
    """Yield the points: cases vary slowest, then the axes in their order; later settings go over earlier ones."""
    targets: dict[tuple[float, float], int] = {}
    worlds = cache(world)  # a point each: every controller has the same ones
    for case, values in itertools.product(cases, itertools.product(*axes.values())):
        chosen = dict(zip(axes, values, strict=True))
        settings = {**fixed, **cases[case], **settings_of(chosen)}
        named = {"case": case, **chosen} if case else chosen
        where = printable(", ".join(f"{key} = {value}" for key, value in named.items()))
        run = {key: settings.pop(key) for key in _DEFAULTS}
        number, world_case = settings.pop(WORLD, None), settings.pop(WORLD_CASE, REAL)
        _check_run(run | {WORLD_CASE: world_case})
        if number is not None and _is_skipped(worlds(number), run["controller"], world_case):
            continue
        start = base if number is None else worlds(number, world_case)
        scenario = _varied(start, {**left_out, **settings}, own, where)
        _check_guide(run, scenario, where)
        if number is None:
            number, of_world = targets.setdefault(scenario.target.position, len(targets)), {}
        else:
            of_world = {WORLD: number, WORLD_CASE: world_case}
        varied = {
            key: value for key, value in chosen.items() if key != WORLD and not key.startswith("target")
        }
        yield GridPoint(scenario, case, **run, target_number=number, varied=varied, **of_world)


def _is_skipped(scenario: Scenario, controller: str, world_case: str) -> bool:
    """Whether a world without a guide has no such case, or the controller nothing to steer with."""
    return not scenario.setup.has_guide and (
        world_case == STRUCTURE or controller_of(controller)[1].needs_guide
    )


def _check_guide(run: Mapping[str, Any], scenario: Scenario, where: str) -> None:
    try:
        check_guide(controller_of(run["controller"])[1], scenario.setup, run["strategy"])
    except InputError as error:
        raise InputError(f"{error}{_at(where)}") from None


def _at(where: str) -> str:
    return f" (at {where})" if where else ""


def _check_run(run: Mapping[str, Any]) -> None:
    for key, choices in _CHOICES.items():
        if key in _OWN and is_own(run[key]):
            _OWN[key](run[key])
        elif run[key] not in choices:
            more = ", or module:NAME of your own" if key in _OWN else ""
            raise InputError(to_line(Problem(key, run[key], f"must be one of {', '.join(choices)}{more}")))
    if not is_seed(run["plan_seed"]):
        rule = f"must be a whole number from 0 to {LARGEST_SEED}"
        raise InputError(to_line(Problem("plan_seed", run["plan_seed"], rule)))


def _varied(base: Scenario, settings: Mapping[str, Any], own: tuple[Method, ...], where: str) -> Scenario:
    try:
        return checked(base.with_values(settings), *own)
    except ScenarioError as error:
        besides = (_BESIDES if "unknown key" in problem else "" for problem in error.problems)
        lines = (problem + more + _at(where) for problem, more in zip(error.problems, besides, strict=True))
        raise InputError("\n".join(lines)) from None
