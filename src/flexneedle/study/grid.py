"""The grid of a study: all its insertions in a fixed order, each with scenario and seed."""

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
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
from flexneedle.scenario.worlds import CASES, PLANE, REAL, RIGS, STRUCTURE, has_rig, world
from flexneedle.study.spec import (
    ALL,
    LARGEST_SEED,
    SEED,
    TARGET,
    WORLD,
    WORLD_CASE,
    WORLD_RIG,
    Axis,
    StudyFile,
    base_of,
    is_seed,
    of_worlds,
    read_study,
    settings_of,
)
from flexneedle.trace.plain import plain
from flexneedle.types import Point

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
    WORLD_RIG: RIGS,
}
_OWN = {"controller": controller_of, "plant": plant_of, "tracker": tracker_of}
_MAX_INSERTIONS = 1_000_000
_KEYS = ", ".join((*_DEFAULTS, WORLD_CASE, WORLD_RIG))
_FURTHER_KEYS = f"; further keys of a study: {_KEYS}, as an axis also {SEED}, {WORLD}"


@dataclass(frozen=True)
class GridPoint:
    """A point of the grid: the settings shared by its insertions.

    varied: values of the axes except target and world; target_number: index of the target in the study, or number of
    the world; world: that number, None if the scenario is not a world; world_case, world_rig: case and rig of the
    world; with_reach: whether the reach of its insertions is computed.
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
    world_rig: str = ""
    with_reach: bool = False


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

    @property
    def axes(self) -> list[int]:
        """Values of `setup.axes` in the study."""
        return sorted({point.scenario.setup.axes for point in self.points})

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
    targets = {case.name: case.targets for case in file.cases if case.targets is not None}
    reaching = [case.name for case in file.cases if case.reach]
    of_cases = sum(len(targets.get(case.name, [None])) for case in file.cases) or 1
    total = math.prod((of_cases, repeats, *map(len, axes.values())))
    if total > _MAX_INSERTIONS:
        raise InputError(f"insertions = {total}: must be at most {_MAX_INSERTIONS}")
    fixed = _DEFAULTS | settings_of(file.values)
    cases = {case.name: settings_of(case.values) for case in file.cases}
    names = {key: _values_of(key, fixed, cases, axes) for key in _OWN}
    own = own_controllers(names["controller"])
    base = checked(base, *own)
    _check_without(file.without, base)
    grid = _Grid(base, dict.fromkeys(file.without), fixed, cases or {"": {}}, targets, reaching, axes, own)
    points = tuple(_points(grid))
    definition = {
        "name": file.name,
        "title": file.title,
        "scenario": base.values(),
        "without": list(file.without),
        "values": fixed,
        "cases": cases,
        "targets": targets,
        "reach": reaching,
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


@dataclass(frozen=True)
class _Grid:
    """The parts of a grid: targets: those of a case by its name; reaching: cases with a reach."""

    base: Scenario
    left_out: Mapping[str, None]
    fixed: Mapping[str, Any]
    cases: Mapping[str, Mapping[str, Any]]
    targets: Mapping[str, list[Any]]
    reaching: Sequence[str]
    axes: Mapping[str, list[Any]]
    own: tuple[Method, ...]

    def choices(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Each case and its values: cases vary slowest, then their targets, then the axes in order."""
        for case in self.cases:
            own = {TARGET: self.targets[case]} if case in self.targets else {}
            axes = {**own, **self.axes}
            for values in itertools.product(*axes.values()):
                yield case, dict(zip(axes, values, strict=True))


def _points(grid: _Grid) -> Iterator[GridPoint]:
    """Yield the points; later settings override earlier ones."""
    targets: dict[Point, int] = {}
    worlds = cache(world)  # the same worlds for every controller
    for case, chosen in grid.choices():
        settings = {**grid.fixed, **grid.cases[case], **settings_of(chosen)}
        named = {"case": case, **chosen} if case else chosen
        at = printable(", ".join(f"{key} = {value}" for key, value in named.items()))
        run = {key: settings.pop(key) for key in _DEFAULTS}
        number = settings.pop(WORLD, None)
        kind = {WORLD_CASE: settings.pop(WORLD_CASE, REAL), WORLD_RIG: settings.pop(WORLD_RIG, PLANE)}
        _check_run(run | kind)
        if number is not None and _is_skipped(worlds(number), run["controller"], *kind.values()):
            continue
        start = grid.base if number is None else worlds(number, *kind.values())
        scenario = _varied(start, {**grid.left_out, **settings}, grid.own, at)
        _check_guide(run, scenario, at)
        if number is None:
            number, of_world = targets.setdefault(scenario.target.position, len(targets)), {}
        else:
            of_world = {WORLD: number, **kind}
        varied = {
            key: value for key, value in chosen.items() if key != WORLD and not key.startswith("target")
        }
        with_reach = bool(of_world) or case in grid.reaching
        yield GridPoint(
            scenario, case, **run, target_number=number, varied=varied, **of_world, with_reach=with_reach
        )


def _is_skipped(scenario: Scenario, controller: str, world_case: str, world_rig: str) -> bool:
    """Whether a world has another guide than the rig, or none that this case or the controller needs."""
    return not has_rig(scenario, world_rig) or (
        not scenario.setup.has_guide and (world_case == STRUCTURE or controller_of(controller)[1].needs_guide)
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
