"""Factors of a study: controllers, cases and axes of `study.json`, with the level of each row."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexneedle.control.controllers import CONTROLLERS, DEFAULT
from flexneedle.lab.study.findings.reading import StudyTables
from flexneedle.lab.study.findings.rows import Codes, Floats, InsertionRows
from flexneedle.scenario.sections.needle import GAUGES

_SAMPLED = frozenset({"controller", "seed", "plan_seed", "world"})
"""Axes that are not factors: the controller is a factor of every study, the others only sample insertions."""
_UNITS = {
    "per_mm": "1/mm", "per_m": "1/m", "per_mj": "1/mJ", "mn_per_mm": "mN/mm", "mm_s": "mm/s",
    "mm": "mm", "mrad": "mrad", "kpa": "kPa", "gpa": "GPa", "hz": "Hz", "mj": "mJ", "s": "s",
}  # fmt: skip
_LABELS = {
    "world_rig": "rig", "world_kind": "kind of world", "needle.gauge": "needle gauge",
    "tracker.environment": "tracker environment",
}  # fmt: skip
_NUMBERED = re.compile(r"([^\d.+-]*)([-+]?(?:\d+\.?\d*|\.\d+))([^\d.]*)")


@dataclass(frozen=True, eq=False)
class Factor:
    """A factor with a level in each of n rows.

    key: column, or axis of the study; label: with unit; names: of the k levels, in order; titles: names with the
    factor, such as "G = 20 mm"; positions (k,): of the levels on an axis; codes (n,): level of each row; covaried:
    other settings that change with the factor.
    """

    key: str
    label: str
    names: tuple[str, ...]
    titles: tuple[str, ...]
    positions: Floats
    codes: Codes
    covaried: tuple[str, ...] = ()

    @property
    def varies(self) -> bool:
        """Whether there is more than one level."""
        return len(self.names) > 1


@dataclass(frozen=True, eq=False)
class StudyDesign:
    """The factors of a study. `cases` varies only if the cases are not points of an axis."""

    controller: Factor
    cases: Factor
    axes: tuple[Factor, ...]
    guide: Factor

    @property
    def factors(self) -> tuple[Factor, ...]:
        """The controller, then all other factors that vary."""
        rest = (self.cases, *self.axes, self.guide)
        return (self.controller, *(factor for factor in rest if factor.varies))

    def besides(self, *compared: Factor) -> tuple[Factor, ...]:
        """Return all factors except those that are compared."""
        return tuple(factor for factor in self.factors if factor not in compared)


def find_design(study: StudyTables) -> StudyDesign:
    """Return the factors of a study with the levels in its rows.

    The first levels are the default controller and the base case, which is the first case without settings.
    """
    rows = study.rows
    base = [name for name, settings in study.cases.items() if not settings][:1]
    cases = _make_factor("case", rows.text("case"), first=base)
    keys = [key for key in study.axes if key not in _SAMPLED and not key.startswith("target")]
    axes = [_make_factor(key, _read_column(rows, key)) for key in keys]
    case_axis = _find_case_axis(cases, study.cases)
    if case_axis is not None:
        axes, cases = [case_axis, *axes], _make_factor("case", [""] * len(rows))
    return StudyDesign(
        _make_factor("controller", _name_controllers(study), first=list_controllers()),
        cases,
        tuple(axis for axis in axes if axis.varies),
        _make_factor(
            "guide", [""] * len(rows) if "world_rig" in keys else _read_guides(rows), first=["with a guide"]
        ),
    )


def _name_controllers(study: StudyTables) -> list[str]:
    """Return the name of each row's controller (n,): as module:NAME where another controller has its name."""
    given = study.rows.text("controller")
    names = {one: study.names.get(one, one) for one in dict.fromkeys(given)}
    taken = Counter([*names.values(), *set(CONTROLLERS).difference(names)])
    return [names[one] if taken[names[one]] == 1 else one for one in given]


def list_controllers() -> list[str]:
    """Return the controllers, the default first."""
    return sorted(CONTROLLERS, key=lambda name: name != DEFAULT)


def label_column(key: str) -> str:
    """Return a key as words, unit in brackets."""
    *sections, last = key.split(".")
    unit = next((end for end in sorted(_UNITS, key=len, reverse=True) if last.endswith("_" + end)), "")
    words = last.removesuffix("_" + unit).replace("_", " ") if unit else last.replace("_", " ")
    label = f"{' '.join(sections)}: {words}" if sections else words
    return _LABELS.get(key) or (f"{label} ({_UNITS[unit]})" if unit else label)


def _read_column(rows: InsertionRows, key: str) -> list[Any]:
    """Return the values (n,) of an axis: its column; for a table its name, or else all its values."""
    below = [name for name in rows.names if name.startswith(f"{key}.")]
    if f"{key}.name" in below:
        return rows.values(f"{key}.name")
    return list(zip(*map(rows.values, below), strict=True)) if below else rows.values(key)


def _read_guides(rows: InsertionRows) -> list[str]:
    """Return "with a guide" or "no guide" for each world (n,); "" in other studies."""
    guides = np.isnan(rows.number("setup.guide_to_skin_mm"))
    if not rows.has_worlds:
        return [""] * len(rows)
    return ["no guide" if without else "with a guide" for without in guides]


def _make_factor(key: str, values: Sequence[Any], first: Sequence[Any] = ()) -> Factor:
    """Return the factor of values (n,): numbers ascending, gauges by size, otherwise `first`, then as they appear."""
    levels, label = list(dict.fromkeys(values)), label_column(key)
    numeric = all(isinstance(level, int | float) and not isinstance(level, bool) for level in levels)
    first = [*first, *GAUGES]
    ordered = sorted(levels) if numeric else sorted(levels, key=lambda k: _rank(k, first))
    number = {level: k for k, level in enumerate(ordered)}
    names = tuple(map(_name_level, ordered))
    words, _, unit = label.rstrip(")").partition(" (")
    titles = tuple(f"{words} = {name} {unit}".rstrip() for name in names) if numeric else names
    positions = np.array(ordered if numeric else range(len(ordered)), dtype=float)
    return Factor(
        key, label, names, titles, positions, np.array([number[value] for value in values], dtype=np.int64)
    )


def _rank(level: Any, first: Sequence[Any]) -> int:
    return first.index(level) if level in first else len(first)


def _name_level(level: Any) -> str:
    if isinstance(level, tuple):
        return " to ".join(map(_name_level, level))
    if isinstance(level, float):
        return f"{level:.6g}"
    return "none" if level is None else str(level)


def _find_case_axis(cases: Factor, settings: Mapping[str, Mapping[str, Any]]) -> Factor | None:
    """Return the cases as an axis if their names differ only in a number, else None."""
    found = [match for match in map(_NUMBERED.fullmatch, cases.names) if match]
    around = {(match[1], match[3]) for match in found}
    if not cases.varies or len(found) < len(cases.names) or len(around) > 1:
        return None
    numbers = [float(match[2]) for match in found]
    own = [settings.get(name, {}) for name in cases.names]
    key = next((key for key in own[0] if [case.get(key) for case in own] == numbers), "case")
    words, unit = (part.strip(" =_-:×") for part in around.pop())
    label = label_column(key) if key != "case" else f"{words} ({unit})" if unit else words or key
    axis = _make_factor(key, [numbers[code] for code in cases.codes])
    order = np.argsort(numbers, kind="stable").tolist()
    titles = tuple(cases.names[k] for k in order)
    return replace(axis, label=label, titles=titles, covaried=tuple(name for name in own[0] if name != key))
