"""Groups of a study of random worlds: errors relative to open loop and to the reach (docs/worlds.md)."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from flexneedle.lab.study.findings.design import StudyDesign
from flexneedle.lab.study.findings.groups import (
    ENERGIES,
    HIT_MM,
    divide_positive,
    find_finished,
    find_loads,
    number_pairs,
    split_rows,
)
from flexneedle.lab.study.findings.rows import Codes, Flags, Floats, InsertionRows

_OPEN_LOOP = "open-loop"
LEAST_MM, TWICE = 0.1, 2.0  # limit of a small error: max(LEAST_MM, TWICE * error of open loop)
WORSE_MM = 0.2  # than open loop
BEYOND_REACH_MM = 0.5
MISS_LIMIT = "control.miss_limit_mm"
_WITHIN_REACH_MM = 1.0


@dataclass(frozen=True)
class WorldGroup:
    """Insertions with the same level of every factor; errors (mm) and shares are over the finished ones.

    count, finished, failures: insertions; a failure did not finish although its reach is at most
    1 mm, or was held although its reach is at most `control.miss_limit_mm`.
    Shares (0 to 1): above 1 mm; within max(0.1 mm, 2 × error of open loop in the same world), and within that error
    + 0.2 mm, if open loop finished; within the reach + 0.5 mm, if the reach is known.
    …_energy_ratio, …_energy_relative: geometric means of peak, mean and end of the energy of the true tissue, relative
    to the plan and to E₁; peak_energy_uj: geometric mean of the peak (µJ); travel of the guide in the tissue (mm) and
    rolls of the bevel: means; least_stretch: minimum. NaN: unknown.
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
    least_stretch: float
    peak_energy_ratio: float
    mean_energy_ratio: float
    end_energy_ratio: float
    peak_energy_relative: float
    mean_energy_relative: float
    end_energy_relative: float
    peak_energy_uj: float
    guide_travel_mm: float
    planned_guide_travel_mm: float
    flips: float


def group_worlds(rows: InsertionRows, design: StudyDesign) -> list[WorldGroup]:
    """Return the groups of a study of worlds in the order of its factors; none for another study."""
    if not rows.has_worlds:
        return []
    error = np.where(find_finished(rows), rows.number("true_error_mm"), nan)
    open_loop, known = _find_open_loop(rows, design, error), map(rows.number, ("reach_mm", "least_stretch"))
    columns = np.stack([error, open_loop, *known, *_find_loads(rows)])
    failed = find_failures(rows)
    return [_make_group(levels, columns[:, own], failed[own]) for levels, own in split_rows(design.factors)]


def _make_group(levels: dict[str, str], columns: Floats, failed: Flags) -> WorldGroup:
    """Return the group of columns (14, n): error, error of open loop, reach, least stretch, `_find_loads`."""
    error, open_loop, reach, stretch, *loads = columns[:, ~np.isnan(columns[0])]
    share = (0.5, 0.95, 0.99, 1.0)
    median, p95, p99, largest = np.quantile(error, share).tolist() if len(error) else [nan] * 4
    return WorldGroup(
        levels,
        len(failed),
        len(error),
        int(failed.sum()),
        median,
        average(error),
        p95,
        p99,
        largest,
        average(error > HIT_MM),
        _share_within(error, np.maximum(LEAST_MM, TWICE * open_loop)),
        _share_within(error, open_loop + WORSE_MM),
        _share_within(error, reach + BEYOND_REACH_MM),
        float(np.min(stretch)) if len(stretch) else nan,
        *(float(np.exp(average(np.log(energy[energy > 0.0])))) for energy in loads[:-3]),
        *(average(effort[~np.isnan(effort)]) for effort in loads[-3:]),
    )


def average(values: Floats | Flags) -> float:
    """Return the mean, NaN if there are no values."""
    return float(np.mean(values)) if len(values) else nan


def _share_within(error: Floats, limit: Floats) -> float:
    """Return the share of errors within their limit, among those with a known limit."""
    known = ~np.isnan(limit)
    return average(error[known] <= limit[known])


def _find_open_loop(rows: InsertionRows, design: StudyDesign, error: Floats) -> Floats:
    """Return the error (n,) of the open loop in the same world, case and phantom."""
    keys: Codes = number_pairs(rows, design.besides(design.controller))
    is_open = np.array([name == _OPEN_LOOP for name in rows.text("controller")], dtype=bool)
    of_key = np.full(int(keys.max(initial=0)) + 1, nan)
    of_key[keys[is_open]] = error[is_open]
    return np.asarray(of_key[keys])


def is_failure(row: Mapping[str, Any]) -> bool:
    """Return whether an insertion did not finish although its reach is unknown or at most 1 mm.

    For a held insertion the limit is at least `control.miss_limit_mm`, the miss at which a controller may hold.
    """
    reach, limit = row["reach_mm"], _WITHIN_REACH_MM
    if row["outcome"] == "held":
        limit = max(limit, row.get(MISS_LIMIT) or 0.0)
    return row["outcome"] != "done" and (reach is None or reach <= limit)


def find_failures(rows: InsertionRows) -> Flags:
    """Return which rows (n,) are failures, see `is_failure`."""
    names = ("outcome", "reach_mm", MISS_LIMIT)
    found = zip(*map(rows.values, names), strict=True)
    return np.array([is_failure(dict(zip(names, row, strict=True))) for row in found], dtype=bool)


def _find_loads(rows: InsertionRows) -> list[Floats]:
    """Return loads (n,): energies relative to the plan, then to E₁; the peak; guide travel, planned travel, rolls."""
    found = find_loads(rows)
    ratios = [divide_positive(found[f"{of}_energy_uj"], found[f"planned_{of}_energy_uj"]) for of in ENERGIES]
    relative = [found[f"{of}_energy_relative"] for of in ENERGIES]
    effort = map(rows.number, ("guide_travel_mm", "planned_guide_travel_mm", "flips"))
    return [*ratios, *relative, found["peak_energy_uj"], *effort]
