"""Groups of a study of random worlds: errors relative to open loop and to the reach (docs/worlds.md)."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.lab.study.findings.design import Design
from flexneedle.lab.study.findings.rows import Codes, Flags, Floats, Rows
from flexneedle.lab.study.findings.summary import HIT_MM, finished, members_of, pair_keys, quotient
from flexneedle.lab.study.summary import is_failure

_OPEN_LOOP = "open-loop"
LEAST_MM, TWICE = 0.1, 2.0  # limit of a small error: max(LEAST_MM, TWICE * error of open loop)
WORSE_MM = 0.2  # than open loop
BEYOND_REACH_MM = 0.5


@dataclass(frozen=True)
class WorldGroup:
    """Insertions with the same level of every factor; errors (mm) and shares are over the finished ones.

    count, finished, failures: insertions; a failure did not finish although its reach is at most
    1 mm, or was held although its reach is at most `control.miss_limit_mm`.
    Shares (0 to 1): above 1 mm; within max(0.1 mm, 2 × error of open loop in the same world), and within that error
    + 0.2 mm, if open loop finished; within the reach + 0.5 mm, if the reach is known.
    energy_ratio: geometric mean of the energy of the true tissue relative to the plan. NaN: unknown.
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
    """Whether the study is a study of worlds."""
    return not np.isnan(rows.number("world")).all()


def world_groups(rows: Rows, design: Design) -> list[WorldGroup]:
    """Return the groups of a study of worlds in the order of its factors; none for another study."""
    if not has_worlds(rows):
        return []
    error = np.where(finished(rows), rows.number("true_error_mm"), nan)
    columns = np.stack([error, _open_loop(rows, design, error), rows.number("reach_mm"), _energy_ratio(rows)])
    failed = failures(rows)
    return [_group(levels, columns[:, own], failed[own]) for levels, own in members_of(design.factors)]


def _group(levels: dict[str, str], columns: Floats, failed: Flags) -> WorldGroup:
    """Return the group of columns (4, n): error, error of open loop, reach, energy ratio."""
    error, open_loop, reach, energy = columns[:, ~np.isnan(columns[0])]
    share = (0.5, 0.95, 0.99, 1.0)
    median, p95, p99, largest = np.quantile(error, share).tolist() if len(error) else [nan] * 4
    return WorldGroup(
        levels,
        len(failed),
        len(error),
        int(failed.sum()),
        median,
        mean_of(error),
        p95,
        p99,
        largest,
        mean_of(error > HIT_MM),
        _within(error, np.maximum(LEAST_MM, TWICE * open_loop)),
        _within(error, open_loop + WORSE_MM),
        _within(error, reach + BEYOND_REACH_MM),
        float(np.exp(mean_of(np.log(energy[energy > 0.0])))),
    )


def mean_of(values: Floats | Flags) -> float:
    """Return the mean, NaN if there are no values."""
    return float(np.mean(values)) if len(values) else nan


def _within(error: Floats, limit: Floats) -> float:
    """Share of errors within their limit, among those with a known limit."""
    known = ~np.isnan(limit)
    return mean_of(error[known] <= limit[known])


def _open_loop(rows: Rows, design: Design, error: Floats) -> Floats:
    """Error (n,) of the open loop in the same world, case and phantom."""
    keys: Codes = pair_keys(rows, design.besides(design.controller))
    is_open = np.array([name == _OPEN_LOOP for name in rows.text("controller")], dtype=bool)
    of_key = np.full(int(keys.max(initial=0)) + 1, nan)
    of_key[keys[is_open]] = error[is_open]
    return np.asarray(of_key[keys])


def failures(rows: Rows) -> Flags:
    """Return which rows (n,) are failures, see `is_failure`."""
    names = ("outcome", "reach_mm", "control.miss_limit_mm")
    found = zip(*map(rows.values, names), strict=True)
    return np.array([is_failure(dict(zip(names, row, strict=True))) for row in found], dtype=bool)


def _energy_ratio(rows: Rows) -> Floats:
    return quotient(rows.number("strain_energy_mj"), rows.number("planned_strain_energy_mj"))
