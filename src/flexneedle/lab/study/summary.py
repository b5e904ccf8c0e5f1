"""Summary of a study: statistics of its tables, overall and for each group of settings."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flexneedle.lab.study.findings.predictions import compute_coverage, list_deviation_columns
from flexneedle.lab.study.findings.worlds import MISS_LIMIT, is_failure
from flexneedle.lab.study.grid import ExpandedStudy
from flexneedle.lab.study.tables import RUNS_FILE, TIMING_FILE
from flexneedle.record.plain import plain
from flexneedle.record.results import DEPTH_FRACTIONS, PREDICTED_PARTS

_ENERGY, _PLANNED_ENERGY = "strain_energy_mj", "planned_strain_energy_mj"
_Row = Mapping[str, Any]


def summarize_study(folder: Path, study: ExpandedStudy) -> dict[str, Any]:
    """Return outcomes, errors (mm), bevel flips, energy (mJ), periods and times (s) of a study folder as plain values.

    Statistics are over finished insertions with a known value, as in the report; unconverged periods are counted
    over all insertions; coverage is the share of final tips, and of needles at half of the target's depth, within 1.96
    standard deviations of the prediction at each fraction of the depth; failures are insertions that did not finish
    although the reach was at most 1 mm (all that did not finish if the reach is unknown). `first_failure`: outcome and
    reason of the first insertion that did not finish, or None. Groups are the combinations of cases and axis values,
    except targets, worlds and seeds; a study without any has no groups.
    """
    columns = ["index", "outcome", "true_error_mm", "residual_mm", "flips", "planned_flips", _ENERGY]
    columns += [
        _PLANNED_ENERGY,
        "periods",
        "planned_periods",
        "unconverged_periods",
        "reach_mm",
        "reason",
        MISS_LIMIT,
        *(name for part in PREDICTED_PARTS for axes in list_deviation_columns(part) for name in axes),
    ]
    rows = pq.read_table(folder / RUNS_FILE, columns=columns).to_pylist()
    result: dict[str, Any] = plain(
        {
            "study": study.name,
            "title": study.title,
            "folder": str(folder),
            "complete": len(rows) == len(study),
            "first_failure": next((_format_failure(row) for row in rows if row["outcome"] != "done"), None),
            **_summarize_rows(rows),
            "groups": [
                {"settings": dict(settings), **_summarize_rows(members)}
                for settings, members in _group_rows(rows, study).items()
            ],
            "time": _sum_times(folder),
        }
    )
    return result


def _format_failure(row: _Row) -> str:
    return f"{row['outcome']}: {row['reason']}" if row["reason"] else str(row["outcome"])


def _group_rows(rows: Sequence[_Row], study: ExpandedStudy) -> dict[tuple[tuple[str, Any], ...], list[_Row]]:
    groups: dict[tuple[tuple[str, Any], ...], list[_Row]] = {}
    for row in rows:
        point = study.insertion(row["index"]).point
        settings = ({"case": point.case} if point.case else {}) | dict(point.varied)
        if settings:
            groups.setdefault(
                tuple((key, _make_hashable(value)) for key, value in settings.items()), []
            ).append(row)
    return groups


def _make_hashable(value: Any) -> Any:
    return tuple(map(_make_hashable, value)) if isinstance(value, list) else value


def _summarize_rows(members: Sequence[_Row]) -> dict[str, Any]:
    rows = [row for row in members if row["outcome"] == "done"]
    return {
        "insertions": len(members),
        "failures": sum(map(is_failure, members)),
        "outcomes": dict(Counter(row["outcome"] for row in members).most_common()),
        "true_error_mm": _summarize_values([row["true_error_mm"] for row in rows]),
        "residual_mm": _summarize_values([row["residual_mm"] for row in rows]),
        "flips": _average(rows, "flips"),
        "planned_flips": _average(rows, "planned_flips"),
        "strain_energy_mj": _average(rows, _ENERGY),
        "planned_strain_energy_mj": _average(rows, _PLANNED_ENERGY),
        "energy_ratio": _average(rows, _ENERGY) / _average(rows, _PLANNED_ENERGY),
        "period_ratio": _summarize_values([_divide(row["periods"], row["planned_periods"]) for row in rows]),
        "unconverged_periods": sum(row["unconverged_periods"] or 0 for row in members),
        "coverage": {
            part: dict(zip(DEPTH_FRACTIONS, compute_coverage(_read_deviations(rows, part)), strict=True))
            for part in PREDICTED_PARTS
        },
    }


def _read_deviations(rows: Sequence[_Row], part: str) -> NDArray[np.float64]:
    """Return the deviations (3, 2, n) of tip or middle from the predictions, NaN where unknown."""
    values = [[[row[name] for row in rows] for name in axes] for axes in list_deviation_columns(part)]
    return np.array(values, dtype=float).reshape(len(values), len(values[0]), len(rows))


def _average(rows: Sequence[_Row], name: str) -> float:
    values = [row[name] for row in rows if row[name] is not None]
    return float(np.mean(values)) if values else float("nan")


def _divide(value: float | None, planned: float | None) -> float | None:
    return value / planned if value is not None and planned else None


def _summarize_values(values: Sequence[float | None]) -> dict[str, Any]:
    known = np.array([value for value in values if value is not None])
    if not known.size:
        return dict.fromkeys(("mean", "sd", "median", "p95", "max"))
    return {
        "mean": known.mean(),
        "sd": known.std(ddof=1) if known.size > 1 else None,
        "median": np.median(known),
        "p95": np.percentile(known, 95),
        "max": known.max(),
    }


def _sum_times(folder: Path) -> dict[str, float]:
    """Return the times (s) of planning, control, plant and the rest, summed over all workers; a plan counts once."""
    rows = pq.read_table(folder / TIMING_FILE).to_pylist()
    plans = {row["plan"]: row["plan_s"] or 0.0 for row in rows}
    parts = {name: sum(row[f"{name}_s"] or 0.0 for row in rows) for name in ("control", "plant", "total")}
    return {
        "plan_s": sum(plans.values()),
        "control_s": parts["control"],
        "plant_s": parts["plant"],
        "rest_s": parts["total"] - parts["control"] - parts["plant"],
    }
