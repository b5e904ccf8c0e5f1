"""What a study varied, found in its rows: controllers, cases, axes. Names of studies play no part."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from flexneedle.scenario.sections.needle import GAUGES
from flexneedle.study.report.rows import Codes, Floats, Rows

_GAUGE = "needle.gauge"
_GUIDE = "setup.guide_to_skin_mm"
_ENVIRONMENT = "tracker.environment."
_WHICH = _ENVIRONMENT + "name"
_WORLD = "world"
_MOST_LEVELS, _BINS = 20, 10
_UNITS = {
    "per_mm": "1/mm", "per_m": "1/m", "per_mj": "1/mJ", "mn_per_mm": "mN/mm", "mm_s": "mm/s",
    "mm": "mm", "mrad": "mrad", "kpa": "kPa", "gpa": "GPa", "hz": "Hz", "mj": "mJ", "s": "s",
}  # fmt: skip
_NUMBERED = re.compile(r"([^\d.+-]*)([-+]?(?:\d+\.?\d*|\.\d+))([^\d.]*)")


@dataclass(frozen=True, eq=False)
class Factor:
    """Something that has a level in each row.

    key: column; label: for an axis, with its unit; names: of the levels, in order; places (k,): where they lie on an
    axis, in its unit, NaN unless `numeric`; codes (n,): the level of each row; exact (n,): the same, finer where
    many values were put together in bins; along: other columns that change with it.
    """

    key: str
    label: str
    names: tuple[str, ...]
    places: Floats
    codes: Codes
    exact: Codes
    numeric: bool = False
    along: tuple[str, ...] = ()

    def level(self, number: int) -> str:
        """Return the name of a level as it stands alone, such as "G = 20 mm"."""
        if not self.numeric:
            return self.names[number]
        words, _, unit = self.label.rstrip(")").partition(" (")
        return f"{words.split(',')[0]} = {self.names[number]} {unit}".rstrip()

    @property
    def varies(self) -> bool:
        """Whether there is more than one level."""
        return len(self.names) > 1


@dataclass(frozen=True, eq=False)
class Design:
    """The factors of a study. `cases` has more than one level only where cases are no points of an axis."""

    controller: Factor
    cases: Factor
    axes: tuple[Factor, ...]
    others: tuple[Factor, ...]

    @property
    def factors(self) -> tuple[Factor, ...]:
        """Controller first, then all else that varies."""
        rest = (self.cases, *self.axes, *self.others)
        return (self.controller, *(factor for factor in rest if factor.varies))


def design_of(
    rows: Rows, controllers: Sequence[str], declared: Iterable[str] = (), base: str | None = None
) -> Design:
    """Return what varies in rows.

    controllers: names in the order wanted, the default first; declared: columns that the study names as its axes,
    preferred where several columns change together; base: the case that the others are held against, by default
    the first.
    """
    cases = _by_name(rows, "case", "case", () if base is None else (base,))
    varying = [key for key in rows.columns if _is_setting(key) and len(rows.codes(key)[1]) > 1]
    by_case = [key for key in varying if cases.varies and _follows(rows.codes(key)[0], cases.codes)]
    free = [key for key in varying if key not in by_case and not _said_by_name(rows, key, varying)]
    free = [key for key in free if not _said_by_world(rows, key, cases)]
    axes = [_axis(rows, keys, set(declared)) for keys in _changing_together(rows, free)]
    as_axis = _case_axis(rows, cases, by_case, set(declared))
    return Design(
        _by_name(rows, "controller", "controller", controllers),
        cases if as_axis is None else _single(cases),
        tuple(axes) if as_axis is None else (as_axis, *axes),
        (*(_by_name(rows, key, key) for key in _unsaid(rows, cases)), *_guides(rows)),
    )


def column_label(key: str) -> str:
    """Return a column's name as a reader would write it, unit in brackets."""
    if key == _GAUGE:
        return "needle gauge"
    if key == _GUIDE:
        return "G, distance from guide to skin (mm)"
    if key == _WHICH:
        return "environment of the tracker"
    *way, last = key.split(".")
    unit = next((end for end in sorted(_UNITS, key=len, reverse=True) if last.endswith("_" + end)), "")
    words = last.removesuffix("_" + unit).replace("_", " ") if unit else last.replace("_", " ")
    where = f"{' '.join(way)}: " if way else ""
    return f"{where}{words} ({_UNITS[unit]})" if unit else f"{where}{words}"


def _is_setting(key: str) -> bool:
    return "." in key and not key.startswith("target.")


def _said_by_name(rows: Rows, key: str, varying: Sequence[str]) -> bool:
    """Whether a setting of the tracker's environment is no more than what the environment's name has said."""
    return (
        key.startswith(_ENVIRONMENT)
        and key != _WHICH
        and _WHICH in varying
        and _follows(rows.codes(key)[0], rows.codes(_WHICH)[0])
    )


def _said_by_world(rows: Rows, key: str, cases: Factor) -> bool:
    """Whether a setting is no more than what the number of the world, and the case, have said."""
    worlds = rows.codes(_WORLD)[0]
    return _follows(rows.codes(key)[0], worlds * len(cases.names) + cases.codes)


def _unsaid(rows: Rows, cases: Factor) -> list[str]:
    """Return plant, tracker and strategy, but for what the case of a world says."""
    keys = ["plant", "tracker", "strategy"]
    return [k for k in keys if _guides(rows) == () or not _follows(rows.codes(k)[0], cases.codes)]


def _guides(rows: Rows) -> tuple[Factor, ...]:
    """Return the factor of worlds with a guide and without; none in other studies."""
    if rows.codes(_WORLD)[1] == [None]:
        return ()
    without = np.isnan(rows.number(_GUIDE))
    codes = without.astype(np.int64)
    names = ("with a guide", "no guide")
    used = [names[k] for k in np.unique(codes).tolist()]
    dense = np.unique(codes, return_inverse=True)[1].astype(np.int64)
    return (Factor("guide", "guide", tuple(used), np.full(len(used), nan), dense, dense),)


def _follows(codes: Codes, leader: Codes) -> bool:
    """Whether a level of `leader` fixes the level."""
    return len(np.unique(np.stack([leader, codes]), axis=1).T) == len(np.unique(leader))


def _changing_together(rows: Rows, keys: Sequence[str]) -> list[list[str]]:
    """Return the keys in groups that split the rows the same way."""
    groups: dict[bytes, list[str]] = {}
    for key in keys:
        groups.setdefault(rows.codes(key)[0].tobytes(), []).append(key)
    return list(groups.values())


def _axis(rows: Rows, keys: Sequence[str], declared: set[str]) -> Factor:
    """Return the axis of keys that change together, along the one that says most."""
    key = min(keys, key=lambda key: (key not in declared, key != _GAUGE, not _is_numeric(rows, key)))
    return _along(rows, key, tuple(other for other in keys if other != key))


def _along(rows: Rows, key: str, along: tuple[str, ...]) -> Factor:
    codes, levels = rows.codes(key)
    if _is_numeric(rows, key):
        return _on_a_scale(key, column_label(key), codes, np.array(levels, dtype=float), along)
    gauges = list(GAUGES)
    ordered = sorted(levels, key=gauges.index) if set(levels) <= set(gauges) else levels
    return _named(key, column_label(key), codes, [levels.index(level) for level in ordered], levels, along)


def _case_axis(rows: Rows, cases: Factor, keys: Sequence[str], declared: set[str]) -> Factor | None:
    """Return the axis that the cases are points of, if they are."""
    own = [key for key in keys if _follows(cases.codes, rows.codes(key)[0])]
    if _GAUGE in own or (1 <= len(own) <= 2 and _is_numeric(rows, own[0])):
        return _axis(rows, own, declared)
    numbers = _numbers_in(cases.names)
    if len(own) > 0 and numbers is not None:
        words, values = numbers
        of_phantom = all(key.startswith("phantom.") for key in own)
        label = f"{words}, scale of the phantom's mismatch" if of_phantom and len(words) <= 2 else words
        return _on_a_scale("case", label, cases.codes, values, tuple(own))
    return None


def _numbers_in(names: Sequence[str]) -> tuple[str, Floats] | None:
    """Return what names say around their number, and the numbers, if they differ in nothing else."""
    found = [_NUMBERED.fullmatch(name) for name in names]
    matches = [match for match in found if match is not None]
    around = {(match[1], match[3]) for match in matches}
    if len(matches) < len(names) or len(around) != 1:
        return None
    words = " ".join(part.strip(" =_-:×") for part in around.pop()).strip()
    return words or "case", np.array([float(match[2]) for match in matches])


def _on_a_scale(key: str, label: str, codes: Codes, values: Floats, along: tuple[str, ...]) -> Factor:
    """Return the factor of a number; many values are put into bins of about as many rows each."""
    order = np.argsort(values, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    exact, ordered = rank[codes], values[order]
    if len(values) <= _MOST_LEVELS:
        names = tuple(f"{value:.6g}" for value in ordered.tolist())
        return Factor(key, label, names, ordered, exact, exact, True, along)
    inner = np.quantile(ordered[exact], np.linspace(0, 1, _BINS + 1)[1:-1])
    bins = np.unique(np.searchsorted(np.unique(inner), ordered[exact], side="right"), return_inverse=True)[1]
    held = [ordered[exact][bins == k] for k in range(int(bins.max()) + 1)]
    names = tuple(f"{values.min():.3g} to {values.max():.3g}" for values in held)
    return Factor(key, label, names, np.array([np.median(v) for v in held]), bins, exact, True, along)


def _named(
    key: str,
    label: str,
    codes: Codes,
    order: Sequence[int],
    levels: Sequence[Any],
    along: tuple[str, ...] = (),
) -> Factor:
    rank = np.empty(len(order), dtype=np.int64)
    rank[list(order)] = np.arange(len(order))
    without = "none" if key == _WHICH else _name(None)
    names = tuple(without if levels[k] is None else _name(levels[k]) for k in order)
    return Factor(key, label, names, np.full(len(names), nan), rank[codes], rank[codes], False, along)


def _by_name(rows: Rows, key: str, label: str, first: Sequence[str] = ()) -> Factor:
    """Return a factor of names, those in `first` before the others."""
    codes, levels = rows.codes(key)
    places = {name: k for k, name in enumerate(first)}
    order = sorted(range(len(levels)), key=lambda k: places.get(levels[k], len(places)))
    return _named(key, label, codes, order, levels)


def _single(factor: Factor) -> Factor:
    none = np.zeros(len(factor.codes), dtype=np.int64)
    return Factor(factor.key, factor.label, ("",), np.full(1, nan), none, none)


def _is_numeric(rows: Rows, key: str) -> bool:
    levels = rows.codes(key)[1]
    return all(isinstance(level, int | float) and not isinstance(level, bool) for level in levels)


def _name(level: Any) -> str:
    if level is None:
        return "not set"
    if isinstance(level, tuple):
        return " to ".join(_name(item) for item in level)
    return f"{level:g}" if isinstance(level, float) else str(level)
