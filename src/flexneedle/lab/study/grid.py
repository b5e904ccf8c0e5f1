"""The grid of a study: all its insertions in a fixed order, each with scenario and seed."""

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from flexneedle.control.controllers import (
    CONTROLLERS,
    DEFAULT,
    check_tables,
    find_controller,
    find_own_controllers,
)
from flexneedle.control.interface import Controller
from flexneedle.control.limits import check_guide, check_tracker
from flexneedle.errors import InputError, ScenarioError, make_printable
from flexneedle.lab.study.spec import (
    ALL,
    LARGEST_SEED,
    SEED,
    TARGET,
    TARGET_KEYS,
    WORLD,
    WORLD_CASE,
    WORLD_KIND,
    WORLD_RIG,
    StudyAxis,
    StudyFile,
    flatten_settings,
    is_seed,
    load_base,
    read_study_file,
    with_worlds,
)
from flexneedle.loop.virtual import SCENARIO_TRACKER, find_tracker
from flexneedle.phantom.plants import DEFAULT_PLANT, PLANTS, find_plant
from flexneedle.planning import STRATEGIES
from flexneedle.plugins import digest_modules, is_own
from flexneedle.record.plain import plain
from flexneedle.scenario.alternatives import SHEAR, YOUNG, override, spell
from flexneedle.scenario.library import WORLD_KINDS
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.settings import Target
from flexneedle.scenario.worlds import CASES, PLANE, REAL, RIGS, SOFT, STRUCTURE, has_rig, world

_DEFAULTS = {
    "controller": DEFAULT,
    "plant": DEFAULT_PLANT,
    "tracker": SCENARIO_TRACKER,
    "strategy": STRATEGIES[0],
    "plan_seed": 0,
}
_KIND = {WORLD_CASE: REAL, WORLD_RIG: PLANE, WORLD_KIND: SOFT}
_CHOICES = {
    "controller": tuple(CONTROLLERS),
    "plant": tuple(PLANTS),
    "tracker": (SCENARIO_TRACKER,),
    "strategy": STRATEGIES,
    WORLD_CASE: CASES,
    WORLD_RIG: RIGS,
    WORLD_KIND: WORLD_KINDS,
}
_DEFAULT_TARGET: dict[str, Any] = dict(zip(TARGET_KEYS, Target().position, strict=True))
_OWN = {"controller": find_controller, "plant": find_plant, "tracker": find_tracker}
_CUSTOM = {*_OWN, "law", "term", "kind"}
"""Keys, and last parts of keys, that name a custom part."""
_MAX_INSERTIONS = 1_000_000
_KEYS = ", ".join((*_DEFAULTS, WORLD_CASE, WORLD_RIG, WORLD_KIND))
_FURTHER_KEYS = f"; further keys of a study: {_KEYS}, as an axis also {SEED}, {WORLD}"


@dataclass(frozen=True)
class StudyPoint:
    """A point of the grid: the settings shared by its insertions.

    varied: values of the axes except target and world; target_number: index of the target in the study, or number of
    the world; world: that number, None if the scenario is not a world; world_case, world_rig, world_kind: case, rig
    and kind of the world; with_reach: whether the reach of its insertions is computed.
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
    world_kind: str = ""
    with_reach: bool = False


@dataclass(frozen=True)
class StudyInsertion:
    """One insertion of a study: index of its row, grid point, number of the repeat, seed of the phantom."""

    index: int
    point: StudyPoint
    repeat: int
    seed: int


@dataclass(frozen=True)
class ExpandedStudy:
    """An expanded study. definition: all its settings as plain values; seeds: values of an axis of seeds, else ()."""

    definition: Mapping[str, Any]
    grid: "StudyGrid"
    repeats: int
    first_seed: int
    seeds: tuple[int, ...]

    @cached_property
    def points(self) -> tuple[StudyPoint, ...]:
        """All points in their order. Raises InputError for one that is not valid."""
        return tuple(map(self.grid.point, range(len(self.grid))))

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
        return len(self.grid) * self.repeats

    def insertion(self, index: int) -> StudyInsertion:
        """Return the insertion of a row.

        Without an axis of seeds, every target (or world) and repeat has its own phantom, which is the same at all
        other settings of the study: comparisons are paired.
        """
        number, repeat = divmod(index, self.repeats)
        point = self.grid.point(number)
        own = self.first_seed + point.target_number * self.repeats + repeat
        return StudyInsertion(index, point, repeat, self.seeds[repeat] if self.seeds else own)


def load_study(source: str | Path | ExpandedStudy, worlds: tuple[int, int] | None = None) -> ExpandedStudy:
    """Return the study of a shipped name or a TOML file; a Study is returned unchanged.

    worlds: first number and count, in place of the axis of worlds.
    Raises InputError with one line for each problem: file, key, value, rule.
    """
    if isinstance(source, ExpandedStudy):
        return source
    file, home, label = read_study_file(source)
    try:
        return _expand(file if worlds is None else with_worlds(file, *worlds), load_base(file, home))
    except InputError as error:
        raise InputError("\n".join(f"{label}: {line}" for line in str(error).splitlines())) from None


def restore_study(definition: Mapping[str, Any]) -> ExpandedStudy:
    """Return the study of a recorded `definition`; its points are made on first use.

    Raises InputError if this version expands it to another number of insertions, or a custom part is missing; KeyError,
    TypeError, ValueError or AttributeError for an invalid definition.
    """
    study = _make_study(definition, Scenario.from_values(definition["scenario"]))
    if len(study) != definition["insertions"]:
        rule = f"this version of flexneedle expands it to {len(study)}: its rows cannot be assigned"
        raise InputError(to_line(Problem("insertions", definition["insertions"], rule)))
    return study


def _expand(file: StudyFile, base: Scenario) -> ExpandedStudy:
    axes = {axis.key: _list_values(axis) for axis in file.axes}
    seeds = tuple(axes.pop(SEED, ()))
    repeats = len(seeds) or file.repeats
    targets = {case.name: case.targets for case in file.cases if case.targets is not None}
    of_cases = sum(len(targets.get(case.name, [None])) for case in file.cases) or 1
    total = math.prod((of_cases, repeats, *map(len, axes.values())))
    if total > _MAX_INSERTIONS:
        raise InputError(f"insertions = {total}: must be at most {_MAX_INSERTIONS}")
    settings = {
        "name": file.name,
        "title": file.title,
        "scenario": base.values(),
        "without": list(map(spell, file.without)),
        "values": _DEFAULTS | flatten_settings(file.values),
        "cases": {case.name: flatten_settings(case.values) for case in file.cases},
        "targets": targets,
        "reach": [case.name for case in file.cases if case.reach],
        "axes": axes,
        "repeats": repeats,
        "first_seed": file.first_seed,
        "seeds": seeds,
    }
    study = _make_study(settings, base)
    _ = study.points  # checked before anything runs
    return study


def _make_study(settings: Mapping[str, Any], base: Scenario) -> ExpandedStudy:
    """Return the study of a definition, which may lack derived values. base: its scenario."""
    fixed, cases, axes = (settings[key] for key in ("values", "cases", "axes"))
    names = {key: _collect_values(key, settings) for key in _OWN}
    own = find_own_controllers(names["controller"])
    base = check_tables(base, *own)
    _check_without(settings["without"], base)
    left_out, targets, reaching = (settings[key] for key in ("without", "targets", "reach"))
    parts = _Parts(base, dict.fromkeys(left_out), fixed, cases or {"": {}}, targets, reaching, axes, own)
    grid, repeats = StudyGrid(parts), settings["repeats"]
    definition = {
        **settings,
        "scenario": base.values(),
        "insertions": len(grid) * repeats,
        "own": digest_modules(_find_custom_names("", settings)),
        "names": {name: find_controller(name)[1].name for name in names["controller"] if is_own(name)},
    }
    return ExpandedStudy(plain(definition), grid, repeats, settings["first_seed"], tuple(settings["seeds"]))


def _collect_values(key: str, settings: Mapping[str, Any]) -> list[Any]:
    """Return all values of a key in the settings of a study."""
    fixed, cases, axes = (settings[name] for name in ("values", "cases", "axes"))
    return [fixed[key], *(case[key] for case in cases.values() if key in case), *axes.get(key, ())]


def _find_custom_names(key: str, value: Any) -> Iterator[str]:
    """Yield the names of all custom parts in the settings of a study: of runs, layers, cost terms and sensors."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _find_custom_names(name, inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _find_custom_names(key, inner)
    elif is_own(value) and key.rpartition(".")[2] in _CUSTOM:
        yield value


def _list_values(axis: StudyAxis) -> list[Any]:
    if axis.key in _CHOICES and axis.values == ALL:
        return list(_CHOICES[axis.key])
    if isinstance(axis.values, dict):
        first = axis.values["from"]
        return list(range(first, first + axis.values["count"]))
    return list(axis.values)


def _check_without(keys: Sequence[str], base: Scenario) -> None:
    for key in keys:
        if key.replace(YOUNG, SHEAR) not in base.flat():
            raise InputError(f"without = {json.dumps(key)}: not a key of the scenario")


@dataclass(frozen=True)
class _Parts:
    """The parts of a grid: targets: of a case by its name; reaching: cases with a reach."""

    base: Scenario
    left_out: Mapping[str, None]
    fixed: Mapping[str, Any]
    cases: Mapping[str, Mapping[str, Any]]
    targets: Mapping[str, list[Any]]
    reaching: Sequence[str]
    axes: Mapping[str, list[Any]]
    own: tuple[Controller, ...]

    def choices(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield each case and its values: cases vary slowest, then their targets, then the axes in order."""
        for case in self.cases:
            own = {TARGET: self.targets[case]} if case in self.targets else {}
            axes = {**own, **self.axes}
            for values in itertools.product(*axes.values()):
                yield case, dict(zip(axes, values, strict=True))


@dataclass(frozen=True)
class _Choice:
    """Settings of a point before its scenario is made. chosen: values of the axes; kind: case, rig, kind of a world."""

    case: str
    chosen: Mapping[str, Any]
    settings: Mapping[str, Any]
    run: Mapping[str, Any]
    world: int | None
    kind: Mapping[str, str]
    target_number: int


class StudyGrid:
    """The points of a study by number, made on first use."""

    def __init__(self, parts: _Parts) -> None:
        self._parts, self._worlds = parts, cache(world)  # the same worlds for every controller
        self._choices = tuple(_list_choices(parts, self._worlds))
        self._made = dict[int, StudyPoint]()

    def __len__(self) -> int:
        return len(self._choices)

    def point(self, number: int) -> StudyPoint:
        """Return a point. Raises InputError if its settings are not valid."""
        if number not in self._made:
            self._made[number] = _make_point(self._parts, self._choices[number], self._worlds)
        return self._made[number]


def _list_choices(parts: _Parts, worlds: Callable[..., Scenario]) -> Iterator[_Choice]:
    """Yield the settings of the points; later settings override earlier ones."""
    numbers: dict[Any, int] = {}
    start = _DEFAULT_TARGET | {
        key: value
        for key, value in parts.base.flat().items()
        if key in TARGET_KEYS and key not in parts.left_out
    }
    for case, chosen in parts.choices():
        settings = override(override(parts.fixed, parts.cases[case]), flatten_settings(chosen))
        run = {key: settings.pop(key) for key in _DEFAULTS}
        number = settings.pop(WORLD, None)
        kind = {key: settings.pop(key, default) for key, default in _KIND.items()}
        _check_run(run | kind)
        if number is not None and _is_skipped(worlds(number, kind=kind[WORLD_KIND]), run["controller"], kind):
            continue
        own = numbers.setdefault(_target_key(start | settings), len(numbers)) if number is None else number
        yield _Choice(case, chosen, settings, run, number, kind, own)


def _target_key(settings: Mapping[str, Any]) -> tuple[float | str, ...]:
    """Return the target as a key; an invalid one is refused with its scenario."""
    values = (settings[key] for key in TARGET_KEYS)
    return tuple(value if isinstance(value, int | float) else repr(value) for value in values)


def _make_point(parts: _Parts, choice: _Choice, worlds: Callable[..., Scenario]) -> StudyPoint:
    case, chosen, kind = choice.case, choice.chosen, choice.kind
    named = {"case": case, **chosen} if case else chosen
    at = make_printable(", ".join(f"{key} = {value}" for key, value in named.items()))
    start = parts.base if choice.world is None else worlds(choice.world, *kind.values())
    scenario = _vary(start, {**parts.left_out, **choice.settings}, parts.own, at)
    _check_controller(choice.run, scenario, at)
    of_world: dict[str, Any] = {} if choice.world is None else {WORLD: choice.world, **kind}
    return StudyPoint(
        scenario,
        case,
        **choice.run,
        target_number=choice.target_number,
        varied={key: value for key, value in chosen.items() if key != WORLD and not key.startswith("target")},
        **of_world,
        with_reach=bool(of_world) or case in parts.reaching,
    )


def _is_skipped(scenario: Scenario, controller: str, kind: Mapping[str, str]) -> bool:
    """Return whether the rig does not fit the guide of a world, or the case or the controller needs a guide."""
    return not has_rig(scenario, kind[WORLD_RIG]) or (
        not scenario.setup.has_guide
        and (kind[WORLD_CASE] == STRUCTURE or find_controller(controller)[1].needs_guide)
    )


def _check_controller(run: Mapping[str, Any], scenario: Scenario, at: str) -> None:
    try:
        controller = find_controller(run["controller"])[1]
        check_guide(controller, scenario.setup, run["strategy"])
        check_tracker(controller, scenario)
    except InputError as error:
        raise InputError(f"{error}{_format_place(at)}") from None


def _format_place(at: str) -> str:
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


def _vary(base: Scenario, settings: Mapping[str, Any], own: tuple[Controller, ...], at: str) -> Scenario:
    try:
        return check_tables(base.with_values(settings), *own)
    except ScenarioError as error:
        further = (_FURTHER_KEYS if "unknown key" in problem else "" for problem in error.problems)
        lines = map("".join, zip(error.problems, further, strict=True))
        raise InputError("\n".join(line + _format_place(at) for line in lines)) from None
