"""Statistics of the rows of a study: groups, paired differences, endings, worst insertions."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, takewhile
from math import isnan, nan

import numpy as np

from flexneedle.lab.study.findings.design import Factor, StudyDesign
from flexneedle.lab.study.findings.rows import TARGET_COLUMNS, Codes, Flags, Floats, InsertionRows
from flexneedle.lab.study.findings.statistics import (
    IntervalEstimate,
    Statistic,
    bound_share_beyond,
    estimate_all,
    geometric_mean,
    mean,
    quantile,
    ratio,
    sd,
)

DONE = "done"
ENERGIES = ("peak", "mean", "end")
HIT_MM = 1.0  # radius of the paper's target circles
ENTERED_MM = 0.1  # by which a margin is entered, as in the warning of an insertion
_MOST_DEPTHS, _DEPTH_BANDS = 8, 5
_NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class SettingGroup:
    """Insertions with the same levels of the factors.

    name: levels in one line; levels: name of the level by factor; count, finished: insertions; known: finished
    insertions with a known true error; missed: those that ended more than 1 mm from the target; unconverged: insertions
    with a period that did not converge, finished or not; unconverged_periods: number of such periods; seeds: number of
    distinct seeds; largest_mm: largest true error; largest_period_ratio: largest number of periods relative to the
    plan; least_clearance_mm: of the true needle from the zones, finished or not, NaN without zones; entered:
    insertions, finished or not, with a clearance below the least margin by more than ENTERED_MM; beyond_largest: upper
    bound (95 % confidence) on the share of all insertions beyond largest_mm; estimates: by name, over finished
    insertions; energies of random worlds are geometric means.
    """

    name: str
    levels: dict[str, str]
    count: int
    finished: int
    known: int
    missed: int
    unconverged: int
    unconverged_periods: int
    seeds: int
    largest_mm: float
    largest_period_ratio: float
    least_clearance_mm: float
    entered: int
    beyond_largest: float
    estimates: dict[str, IntervalEstimate]

    @property
    def has_clearances(self) -> bool:
        """True if a clearance from a zone to avoid is known."""
        return not isnan(self.least_clearance_mm)


@dataclass(frozen=True)
class Difference:
    """Mean paired difference (mm) of true errors, `name` minus `against`, between insertions otherwise identical.

    pairs: both finished; left_out: pairs with an unfinished insertion; …_energy_ratio: geometric means of `name` over
    `against` where both energies are positive; guide_travel_mm: mean difference of the travel in the tissue; verdict:
    "better" if the interval of the error's difference is below 0, "worse" if above, otherwise "not separable"; None
    without an interval.
    """

    name: str
    against: str
    controller: str
    pairs: int
    left_out: int
    mean_mm: IntervalEstimate
    peak_energy_ratio: IntervalEstimate
    mean_energy_ratio: IntervalEstimate
    end_energy_ratio: IntervalEstimate
    guide_travel_mm: IntervalEstimate
    verdict: str | None


@dataclass(frozen=True)
class Ending:
    """Endings with the same outcome and kind of reason: count, first row, and its reason."""

    outcome: str
    count: int
    first: int
    reason: str


def find_finished(rows: InsertionRows) -> Flags:
    """Return which rows (n,) finished."""
    return np.array([outcome == DONE for outcome in rows.text("outcome")], dtype=bool)


def group_rows(rows: InsertionRows, factors: Sequence[Factor]) -> list[SettingGroup]:
    """Return a group for each combination of levels that occurs, in the order of the factors."""
    done, title = find_finished(rows), {f.key: dict(zip(f.names, f.titles, strict=True)) for f in factors}
    return [
        _make_group(rows, members, done, ", ".join(title[key][name] for key, name in levels.items()), levels)
        for levels, members in split_rows(factors)
    ]


def split_rows(factors: Sequence[Factor]) -> Iterator[tuple[dict[str, str], Codes]]:
    """Yield each combination of levels, by key of the factor, with its rows, in the order of the factors."""
    combined = np.stack([factor.codes for factor in factors], axis=1)
    levels, codes = np.unique(combined, axis=0, return_inverse=True)
    for number, chosen in enumerate(levels.tolist()):
        names = {factor.key: factor.names[k] for factor, k in zip(factors, chosen, strict=True)}
        yield names, np.flatnonzero(codes.ravel() == number)


def _make_group(
    rows: InsertionRows, members: Codes, done: Flags, name: str, levels: dict[str, str]
) -> SettingGroup:
    ended = members[done[members]]
    error = rows.number("true_error_mm")[ended]
    known = error[~np.isnan(error)]
    seeds = rows.codes("seed")[ended]
    unconverged = np.nan_to_num(rows.number("unconverged_periods")[members])
    clearance = rows.number("true_clearance_mm")[members]
    known_clearances = clearance[np.isfinite(clearance)]
    ratios = divide_positive(rows.number("periods")[ended], rows.number("planned_periods")[ended])
    return SettingGroup(
        name=name,
        levels=levels,
        count=len(members),
        finished=len(ended),
        known=len(known),
        missed=int((known > HIT_MM).sum()),
        unconverged=int((unconverged > 0).sum()),
        unconverged_periods=int(unconverged.sum()),
        seeds=len(np.unique(seeds)),
        largest_mm=_find_largest(known),
        largest_period_ratio=_find_largest(ratios[~np.isnan(ratios)]),
        least_clearance_mm=float(known_clearances.min()) if len(known_clearances) else nan,
        entered=int((clearance < _find_margins(rows)[members] - ENTERED_MM).sum()),
        beyond_largest=bound_share_beyond(len(known)),
        estimates=_estimate_group(rows, ended, seeds),
    )


def _find_margins(rows: InsertionRows) -> Floats:
    """Return the least margin (n,), mm, of the zones of each row, NaN without zones."""
    margins, common = np.full(len(rows), nan), rows.number("zones.margin_mm")
    for start in takewhile(lambda start: f"{start}.shape" in rows.names, map("zone.{}".format, count())):
        own = rows.number(f"{start}.margin_mm")
        is_used = np.array(rows.text(f"{start}.shape")) != ""
        margins = np.fmin(margins, np.where(is_used, np.where(np.isnan(own), common, own), nan))
    return margins


def _estimate_group(rows: InsertionRows, ended: Codes, seeds: Codes) -> dict[str, IntervalEstimate]:
    def column(name: str) -> Floats:
        return rows.number(name)[ended]

    error = column("true_error_mm")
    loads = {name: values[ended] for name, values in find_loads(rows).items()}
    average, relate = (geometric_mean, _relate_each) if rows.has_worlds else (mean, ratio)
    statistics = {
        "mean_mm": mean(error),
        "sd_mm": sd(error),
        "median_mm": quantile(error, 0.5),
        "p95_mm": quantile(error, 0.95),
        "residual_mm": mean(column("residual_mm")),
        "flips": mean(column("flips")),
        "planned_flips": mean(column("planned_flips")),
        **{name: average(values) for name, values in loads.items()},
        **{
            f"{of}_energy_ratio": relate(loads[f"{of}_energy_uj"], loads[f"planned_{of}_energy_uj"])
            for of in ENERGIES
        },
        **{
            name: mean(column(name))
            for name in ("least_stretch", "guide_travel_mm", "planned_guide_travel_mm")
        },
        "period_ratio": ratio(column("periods"), column("planned_periods")),
    }
    return estimate_all(statistics, _renumber(seeds))


def find_loads(rows: InsertionRows) -> dict[str, Floats]:
    """Return energies of the true tissue (n,) by name: peak, mean and end, the plan's, and relative to E₁.

    NaN in tables of versions without them, which have the energy at the end alone.
    """
    scale, found = rows.number("energy_scale_uj"), dict[str, Floats]()
    for of in ENERGIES:
        energy, planned = (
            1e3 * rows.number(f"{by}strain_energy_mj") if of == "end" else rows.number(f"{by}{of}_energy_uj")
            for by in ("", "planned_")
        )
        found |= {f"{of}_energy_uj": energy, f"planned_{of}_energy_uj": planned}
        found[f"{of}_energy_relative"] = divide_positive(energy, scale)
    return found


def compare_controllers(rows: InsertionRows, design: StudyDesign) -> list[Difference]:
    """Return the first controller minus each other one, in insertions with the same seed, target and settings."""
    keys, controller = number_pairs(rows, design.besides(design.controller)), design.controller
    ours, *others = (controller.codes == k for k in range(len(controller.names)))
    return [
        _compare_sides(rows, keys, (ours, theirs), (controller.names[0], name, ""))
        for theirs, name in zip(others, controller.names[1:], strict=True)
    ]


def compare_cases(rows: InsertionRows, design: StudyDesign) -> list[Difference]:
    """Return each case minus the base case, the first, for each controller."""
    keys, cases = number_pairs(rows, design.besides(design.cases)), design.cases
    return [
        _compare_sides(rows, keys, ((cases.codes == case) & own, (cases.codes == 0) & own), names)
        for number, name in enumerate(design.controller.names)
        for own in (design.controller.codes == number,)
        for case in range(1, len(cases.names))
        for names in ((cases.names[case], cases.names[0], name),)
    ]


def group_depths(rows: InsertionRows) -> Factor:
    """Return the target depth as a factor; many depths are grouped into bands."""
    depth = rows.number("target_depth_mm")
    levels, codes = np.unique(depth, return_inverse=True)
    names = [f"{level:g}" for level in levels.tolist()]
    if len(levels) > _MOST_DEPTHS:
        edges = np.linspace(levels[0], levels[-1], _DEPTH_BANDS + 1)
        used, codes = np.unique(np.searchsorted(edges[1:-1], depth, side="right"), return_inverse=True)
        names = [f"{edges[k]:.3g} to {edges[k + 1]:.3g}" for k in used.tolist()]
    positions = np.arange(len(names), dtype=float)
    return Factor("depth", "target depth (mm)", tuple(names), tuple(names), positions, codes)


def count_endings(rows: InsertionRows) -> list[Ending]:
    """Return the endings of insertions that did not finish, or finished with a remark, the most frequent first.

    Reasons that differ only in numbers are grouped.
    """
    found: dict[tuple[str, str], list[int]] = {}
    reasons = rows.text("reason")
    for row, outcome in enumerate(rows.text("outcome")):
        if outcome != DONE or reasons[row]:
            found.setdefault((outcome, _NUMBER.sub("#", reasons[row])), []).append(row)
    kinds = [Ending(outcome, len(at), at[0], reasons[at[0]]) for (outcome, _), at in found.items()]
    return sorted(kinds, key=lambda kind: (kind.outcome == DONE, -kind.count))


def find_worst(rows: InsertionRows, number: int = 10, among: Flags | None = None) -> list[int]:
    """Return the rows with the largest true error minus reach, finished or not, the largest first.

    An unknown reach counts as 0; among (n,): rows to consider (default: all).
    """
    excess = rows.number("true_error_mm") - np.nan_to_num(rows.number("reach_mm"))
    excess = excess if among is None else np.where(among, excess, nan)
    order = np.argsort(-excess, kind="stable")  # NaN last
    return [int(row) for row in order[:number] if not isnan(excess[row])]


def _compare_sides(
    rows: InsertionRows, keys: Codes, sides: tuple[Flags, Flags], names: tuple[str, str, str]
) -> Difference:
    error, done = rows.number("true_error_mm"), find_finished(rows)
    one, other = (_index_by_key(keys, np.flatnonzero(side)) for side in sides)
    both = np.array([(one[key], other[key]) for key in one if key in other], dtype=np.int64).reshape(-1, 2)
    known = (done & ~np.isnan(error))[both].all(axis=1)
    pairs = both[known]
    (first, second), travel, loads = pairs.T, rows.number("guide_travel_mm"), find_loads(rows)
    stored = {of: loads[f"{of}_energy_uj"] for of in ENERGIES}
    statistics = {
        "mean_mm": mean(error[first] - error[second]),
        **{
            f"{of}_energy_ratio": _relate_each(of_all[first], of_all[second]) for of, of_all in stored.items()
        },
        "guide_travel_mm": mean(travel[first] - travel[second]),
    }
    found = estimate_all(statistics, _renumber(rows.codes("seed")[first]))
    left_out, verdict = int((~known).sum()), _judge(found["mean_mm"])
    name, against, controller = names
    return Difference(name, against, controller, len(pairs), left_out, verdict=verdict, **found)


def _relate_each(over: Floats, under: Floats) -> Statistic:
    """Return the geometric mean of the ratios of two columns (n,)."""
    return geometric_mean(divide_positive(over, under))


def _judge(difference: IntervalEstimate) -> str | None:
    if isnan(difference.low):
        return None
    if difference.high < 0.0:
        return "better"
    return "worse" if difference.low > 0.0 else "not separable"


def number_pairs(rows: InsertionRows, factors: Sequence[Factor]) -> Codes:
    """Return an integer key (n,) for each row, equal for rows with the same seed, target, repeat and factors."""
    names = ("seed", "plan_seed", *TARGET_COLUMNS, "repeat")
    columns = np.stack([*map(rows.codes, names), *(factor.codes for factor in factors)], axis=1)
    return np.unique(columns, axis=0, return_inverse=True)[1].ravel()


def _index_by_key(keys: Codes, members: Codes) -> dict[tuple[int, int], int]:
    """Return rows by key and occurrence of the key, so that no row is paired twice."""
    occurrences: dict[int, count[int]] = {}
    return {
        (key, next(occurrences.setdefault(key, count()))): row
        for key, row in zip(keys[members].tolist(), members.tolist(), strict=True)
    }


def _renumber(codes: Codes) -> Codes:
    return np.unique(codes, return_inverse=True)[1].astype(np.int64)


def divide_positive(over: Floats, under: Floats) -> Floats:
    """Return `over / under` (n,), NaN where `under` is not positive or unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(under > 0, over / under, nan)


def _find_largest(values: Floats) -> float:
    return float(values.max()) if len(values) else nan
