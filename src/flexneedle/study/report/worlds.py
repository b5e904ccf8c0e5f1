"""What a study of random worlds comes to: errors against open loop and against the reach (docs/worlds.md)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.study.report.design import Design
from flexneedle.study.report.html import Html, element, table
from flexneedle.study.report.rows import Flags, Floats, Rows
from flexneedle.study.report.summary import HIT_MM, finished, members_of, pair_keys
from flexneedle.study.report.wording import number
from flexneedle.study.summary import is_failure

_OPEN_LOOP = "open-loop"
_LEAST_MM, _TWICE = 0.1, 2.0  # an error is small enough below the greater of it and twice that of open loop
_WORSE_MM = 0.2  # than open loop
_BEYOND_REACH_MM = 0.5


@dataclass(frozen=True)
class WorldGroup:
    """The insertions that share a level of every factor; errors (mm) and shares are over the finished ones.

    count, finished, failures: insertions; a failure did not finish though its reach is at most
    1 mm, or was held though it is at most `control.miss_limit_mm`.
    Shares (0 to 1): above 1 mm; within the greater of 0.1 mm and twice the open loop's error in the same world, and
    within that error + 0.2 mm, where open loop finished; within the reach + 0.5 mm, where it is known.
    energy_ratio: geometric mean of the true tissue's energy over the plan's. NaN is what is not known.
    """

    levels: dict[str, str]
    count: int
    finished: int
    failures: int
    median_mm: float
    mean_mm: float
    p95_mm: float
    p99_mm: float
    max_mm: float
    above: float
    within_twice_open_loop: float
    within_open_loop: float
    within_reach: float
    energy_ratio: float


def has_worlds(rows: Rows) -> bool:
    """Whether the scenarios of a study are worlds."""
    return not np.isnan(rows.number("world")).all()


def world_groups(rows: Rows, design: Design) -> list[WorldGroup]:
    """Return the groups of a study of worlds in the order of its factors; of another study none."""
    if not has_worlds(rows):
        return []
    error = np.where(finished(rows), rows.number("true_error_mm"), nan)
    open_loop = _open_loop(rows, design, error)
    failed = failures(rows)
    energy = _energy_ratio(rows)
    return [
        _group(levels, error[own], open_loop[own], rows.number("reach_mm")[own], failed[own], energy[own])
        for levels, own in members_of(design)
    ]


def _group(
    levels: dict[str, str],
    all_errors: Floats,
    open_loop: Floats,
    reach: Floats,
    failed: Flags,
    energy: Floats,
) -> WorldGroup:
    known = ~np.isnan(all_errors)
    error, open_loop, reach, energy = (column[known] for column in (all_errors, open_loop, reach, energy))
    median, p95, p99, largest = (
        np.quantile(error, (0.5, 0.95, 0.99, 1.0)).tolist() if len(error) else [nan] * 4
    )
    return WorldGroup(
        levels,
        len(all_errors),
        len(error),
        int(failed.sum()),
        median,
        _mean(error),
        p95,
        p99,
        largest,
        _mean(error > HIT_MM),
        _share(error, np.maximum(_LEAST_MM, _TWICE * open_loop)),
        _share(error, open_loop + _WORSE_MM),
        _share(error, reach + _BEYOND_REACH_MM),
        float(np.exp(_mean(np.log(energy[energy > 0.0])))),
    )


def _mean(values: Floats | Flags) -> float:
    return float(np.mean(values)) if len(values) else nan


def _share(error: Floats, limit: Floats) -> float:
    """Share of the errors that are within their limit, of those whose limit is known; of maxima, NaN stays NaN."""
    known = ~np.isnan(limit)
    return _mean(error[known] <= limit[known])


def _open_loop(rows: Rows, design: Design, error: Floats) -> Floats:
    """Error (n,) of the open loop in the same world, case and phantom."""
    keys = pair_keys(rows, [factor.exact for factor in (design.cases, *design.axes, *design.others)])
    is_open = np.array([name == _OPEN_LOOP for name in rows.text("controller")], dtype=bool)
    of_key = np.full(int(keys.max(initial=0)) + 1, nan)
    of_key[keys[is_open]] = error[is_open]
    return np.asarray(of_key[keys])


def failures(rows: Rows) -> Flags:
    """Return which rows (n,) did not finish though the target, as far as is known, was within 1 mm of the reach."""
    columns = ("outcome", "reach_mm", "control.miss_limit_mm")
    found = ({name: rows.value(name, row) for name in columns} for row in range(len(rows)))
    return np.array([is_failure(row) for row in found], dtype=bool)


def _energy_ratio(rows: Rows) -> Floats:
    energy, planned = rows.number("strain_energy_mj"), rows.number("planned_strain_energy_mj")
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(planned > 0.0, energy / planned, nan)


def world_table(groups: Sequence[WorldGroup]) -> Html | None:
    """Return the section with a row for each group, or None without any."""
    if not groups:
        return None
    heads = (
        *groups[0].levels,
        *("insertions", "finished", "failures", "median (mm)", "mean (mm)", "95 % (mm)", "99 % (mm)"),
        *("max (mm)", f"above {HIT_MM:g} mm", f"within max({_LEAST_MM:g} mm, {_TWICE:g} × open loop)"),
        *(
            f"within open loop + {_WORSE_MM:g} mm",
            f"within reach + {_BEYOND_REACH_MM:g} mm",
            "energy / plan's",
        ),
    )
    caption = (
        "Errors, shares and energy are over the finished insertions; energy is a geometric mean. A failure did not "
        "finish though its target was within 1 mm of the reach, or was held within control.miss_limit_mm of it."
    )
    rows = [_row(group) for group in groups]
    return element(
        "section", element("h2", "Worlds"), table(caption, heads, rows, names=len(groups[0].levels))
    )


def _row(group: WorldGroup) -> list[object]:
    errors = (group.median_mm, group.mean_mm, group.p95_mm, group.p99_mm, group.max_mm)
    shares = (group.above, group.within_twice_open_loop, group.within_open_loop, group.within_reach)
    return [
        *group.levels.values(),
        *(group.count, group.finished, group.failures),
        *map(number, errors),
        *(_percent(share) for share in shares),
        number(group.energy_ratio, 2),
    ]


def _percent(share: float) -> str:
    return number(100.0 * share, 1) + ("" if np.isnan(share) else " %")
