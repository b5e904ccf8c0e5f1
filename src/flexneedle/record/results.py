"""Results of plans and insertions, each defined once: rows of studies, the objects of `--json` and of `run.json`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import isnan
from typing import Any

import numpy as np

from flexneedle.record.plain import plain
from flexneedle.record.sensor_results import sensor_values
from flexneedle.results import Insertion, Outcome, Period, Plan
from flexneedle.types import X

LOAD = ("peak_energy_uj", "mean_energy_uj", "end_energy_uj", "least_stretch", "guide_travel_mm")
"""Values of `Invasiveness` that are columns, of insertions and, after "planned_", of plans."""
PLANNED_LOAD = tuple(f"planned_{name}" for name in LOAD)
RESULT_KEYS = (
    *(
        "controller",
        "phantom",
        "rig",
        "dry_run",
        "disturbed",
        "target_mm",
        "tip_true_mm",
        "tip_measured_mm",
        "true_error_mm",
        "residual_mm",
    ),
    *("planned_error_mm", "reached", "outcome", "reason", "warning", "flips", "planned_flips"),
    *(
        "strain_energy_mj",
        "planned_strain_energy_mj",
        *LOAD,
        *PLANNED_LOAD,
        "energy_scale_uj",
        "energy_estimated",
    ),
    *("clearance_mm", "true_clearance_mm", "planned_clearance_mm"),
    *("steps", "held_s", "converged", "seed"),
)
"""Keys of the result of an insertion, in order."""
DEPTH_FRACTIONS = {"quarter": 0.25, "half": 0.5, "three_quarters": 0.75}
"""Fractions of the target depth at which the predictions are recorded, by name."""
PREDICTED_PARTS = ("tip", "middle")
LATERAL_AXES = ("y", "z")
_ENTRY_KEYS = ("lateral_mm", "lateral_z_mm", "slope_mrad", "slope_z_mrad")
_OF_PERIODS = ("p50", "p99", "max")
NO_TIMING = {"plan_seconds": None, "period_ms": dict.fromkeys(_OF_PERIODS)}
"""Times of an insertion that was refused before planning."""


@dataclass(frozen=True)
class ResultColumn:
    """A column of results: the type of its values and how they follow from a plan or an insertion.

    A column without a definition is filled in by studies. Unknown values are NaN or None.
    """

    kind: type
    of_plan: Callable[[Plan], Any] | None = None
    of_insertion: Callable[[Insertion], Any] | None = None


def _last(insertion: Insertion) -> Period | None:
    return insertion.periods[-1] if insertion.periods else None


def _true_tip(insertion: Insertion, axis: int) -> float | None:
    last = _last(insertion)
    return last.true_tip[axis] if last and last.true_tip else None


def _true_state(insertion: Insertion, name: str) -> Any:
    """Return a `true_…` value of the last period."""
    return getattr(_last(insertion), name, None)


def _load(record: Plan | Insertion, name: str) -> float:
    value: float = getattr(record.invasiveness, name)
    return value


def sds_column(fraction: str, part: str, axis: str) -> str:
    """Return the column of a deviation from the prediction: a fraction of the depth, tip or middle, y or z."""
    return f"predicted_{fraction}_{part}_{axis}_sds"


def _prediction(insertion: Insertion, depth_fraction: float) -> Period | None:
    """Return the first period with a prediction and the estimated tip at this fraction of the target depth."""
    depth = depth_fraction * insertion.target[0]
    predicting = (p for p in insertion.periods if p.predicted is not None or not isnan(p.miss[0]))
    return next((period for period in predicting if period.estimate.x >= depth), None)


def _predicted_miss(insertion: Insertion, axis: int, fraction: float) -> float | None:
    found = _prediction(insertion, fraction)
    return None if found is None else found.miss[axis]


def _predicted_sd(insertion: Insertion, fraction: float) -> float | None:
    found = _prediction(insertion, fraction)
    return None if found is None else found.miss_sd


def _tip_sds(insertion: Insertion, axis: int, fraction: float) -> float | None:
    """Return the deviation of the true tip from the predicted miss, or predicted shape, in standard deviations."""
    found, last = _prediction(insertion, fraction), _at_target(insertion)
    if found is None or last is None or last.true_tip is None:
        return None
    true = last.true_tip[1 + axis]
    if not isnan(found.miss[0]):
        return _in_sds(insertion, axis, true - insertion.target[1 + axis] - found.miss[axis], found.miss_sd)
    if found.predicted is None:
        return None
    nodes, sd = found.predicted
    return _in_sds(insertion, axis, true - float(nodes[-1, 1 + axis]), float(sd[-1, axis]))


def _middle_sds(insertion: Insertion, axis: int, fraction: float) -> float | None:
    """Return the deviation of the needle at half of the target's depth, otherwise as `_tip_sds`."""
    found, last = _prediction(insertion, fraction), _at_target(insertion)
    if found is None or found.predicted is None or last is None or last.true_shape is None:
        return None
    middle, (nodes, sd) = 0.5 * insertion.target[0], found.predicted
    true = np.interp(middle, last.true_shape[:, X], last.true_shape[:, 1 + axis])
    predicted, deviation = (
        np.interp(middle, nodes[:, X], of[:, at]) for of, at in ((nodes, 1 + axis), (sd, axis))
    )
    return _in_sds(insertion, axis, float(true - predicted), float(deviation))


def _at_target(insertion: Insertion) -> Period | None:
    """Return the last period of an insertion that is done."""
    return _last(insertion) if insertion.outcome is Outcome.DONE else None


def _in_sds(insertion: Insertion, axis: int, deviation: float, sd: float) -> float | None:
    """Return a deviation in standard deviations; None out of the plane of a needle in the plane."""
    scenario = insertion.scenario or insertion.plan.scenario
    axes = 1 if scenario is None else scenario.setup.axes
    return deviation / sd if axis < axes and sd > 0.0 else None


def _prediction_columns() -> dict[str, ResultColumn]:
    """Return the columns of the predicted miss and its standard deviation, then of the deviations from it."""
    columns: dict[str, Callable[[Insertion], Any]] = {}
    for name, fraction in DEPTH_FRACTIONS.items():
        for k, axis in enumerate(LATERAL_AXES):
            columns[f"predicted_{name}_{axis}_mm"] = partial(_predicted_miss, axis=k, fraction=fraction)
        columns[f"predicted_{name}_sd_mm"] = partial(_predicted_sd, fraction=fraction)
    for name, fraction in DEPTH_FRACTIONS.items():
        for part, sds in zip(PREDICTED_PARTS, (_tip_sds, _middle_sds), strict=True):
            for k, axis in enumerate(LATERAL_AXES):
                columns[sds_column(name, part, axis)] = partial(sds, axis=k, fraction=fraction)
    return {name: ResultColumn(float, of_insertion=value) for name, value in columns.items()}


RESULT_COLUMNS: dict[str, ResultColumn] = {
    "true_error_mm": ResultColumn(float, of_insertion=lambda i: i.true_error_mm),
    "residual_mm": ResultColumn(float, of_insertion=lambda i: i.residual_mm),
    "tip_x_mm": ResultColumn(float, of_insertion=partial(_true_tip, axis=0)),
    "tip_y_mm": ResultColumn(float, of_insertion=partial(_true_tip, axis=1)),
    "tip_z_mm": ResultColumn(float, of_insertion=partial(_true_tip, axis=2)),
    "flips": ResultColumn(int, of_insertion=lambda i: i.flips),
    "planned_flips": ResultColumn(int, of_plan=lambda plan: plan.flips),
    "strain_energy_mj": ResultColumn(float, of_insertion=partial(_true_state, name="true_strain_energy")),
    "planned_strain_energy_mj": ResultColumn(float, of_plan=lambda plan: plan.strain_energy_mj),
    **{
        name: ResultColumn(float, of_insertion=partial(_load, name=name))
        for name in (*LOAD, "energy_scale_uj")
    },
    **{f"planned_{name}": ResultColumn(float, of_plan=partial(_load, name=name)) for name in LOAD},
    "planned_error_mm": ResultColumn(float, of_plan=lambda plan: plan.error_mm),
    "clearance_mm": ResultColumn(float, of_insertion=lambda i: i.least_clearance_mm),
    "true_clearance_mm": ResultColumn(float, of_insertion=lambda i: i.true_clearance_mm),
    "planned_clearance_mm": ResultColumn(float, of_plan=lambda plan: plan.least_clearance_mm),
    "periods": ResultColumn(int, of_insertion=lambda i: len(i.periods)),
    "planned_periods": ResultColumn(int, of_plan=lambda plan: len(plan.controls)),
    "held_s": ResultColumn(float, of_insertion=lambda i: i.held_s),
    "unconverged_periods": ResultColumn(
        int, of_insertion=lambda i: sum(not period.converged for period in i.periods)
    ),
    "reach_mm": ResultColumn(float),
    **_prediction_columns(),
    "warning": ResultColumn(str, of_insertion=lambda i: i.warning),
    "outcome": ResultColumn(str, of_insertion=lambda i: i.outcome),
    "reason": ResultColumn(str, of_insertion=lambda i: i.reason),
}
"""Columns of the results of an insertion in the table of a study, in order.

clearance_mm: least clearance of the estimated needle from the zones to avoid, infinite without zones.

predicted_…: lateral miss predicted by the controller with the tip at that fraction of the target depth, and its
standard deviation; predicted_…_sds: deviation from this prediction, in standard deviations, of the final true tip and
of the final true needle at half of the target's depth.
"""


def plan_row(plan: Plan) -> dict[str, Any]:
    """Return the `planned_…` values of RESULT_COLUMNS."""
    return {name: column.of_plan(plan) for name, column in RESULT_COLUMNS.items() if column.of_plan}


def insertion_row(insertion: Insertion) -> dict[str, Any]:
    """Return the values of RESULT_COLUMNS that follow from an insertion and its plan."""
    columns = RESULT_COLUMNS.items()
    values = {name: column.of_insertion(insertion) for name, column in columns if column.of_insertion}
    return plan_row(insertion.plan) | values


def plan_result(plan: Plan) -> dict[str, Any]:
    """Return the result of a plan; tip in mm; entry: where the needle enters, by keys of the scenario."""
    made = plan.scenario
    entry = None if made is None else {key: getattr(made.entry, key) for key in _ENTRY_KEYS}
    result: dict[str, Any] = plain(
        {
            "tip_mm": plan.tip_mm,
            "error_mm": plan.error_mm,
            "reached": bool(plan.reached),
            "limit": plan.limit,
            "refusal": plan.refusal,
            "entry": entry,
            "cost": plan.cost,
            "terms": plan.terms,
            "flips": plan.flips,
            "strain_energy_mj": plan.strain_energy_mj,
            **{name: _load(plan, name) for name in (*LOAD, "energy_scale_uj")},
            "clearance_mm": plan.least_clearance_mm,
            "iterations": plan.iterations,
            "converged": bool(plan.converged),
            "seed": plan.seed,
        }
    )
    return result


def plan_timing(plan: Plan) -> dict[str, Any]:
    """Return the wall-clock time of a plan."""
    return {"plan_seconds": plan.seconds}


def insertion_result(insertion: Insertion) -> dict[str, Any]:
    """Return the result of an insertion; unknown values are None."""
    row = insertion_row(insertion)
    tip = row["tip_x_mm"], row["tip_y_mm"], row["tip_z_mm"]
    values = row | {
        "controller": insertion.controller,
        "phantom": insertion.phantom or None,
        "rig": insertion.rig or None,
        "dry_run": insertion.dry_run,
        "disturbed": insertion.disturbed or None,
        "target_mm": insertion.target,
        "tip_true_mm": None if tip[0] is None else tip,
        "tip_measured_mm": _measured_tip(insertion),
        "reached": bool(insertion.reached),
        "warning": row["warning"] or None,
        "energy_estimated": insertion.invasiveness.estimated,
        "steps": row["periods"],
        "converged": row["unconverged_periods"] == 0,
        "seed": insertion.seed,
    }
    result: dict[str, Any] = plain({key: values[key] for key in RESULT_KEYS} | sensor_values(insertion))
    return result


def refused_result(
    *, target: Sequence[float] | None, reason: str, seed: int, dry_run: bool = False, **parts: str
) -> dict[str, Any]:
    """Return the result of an insertion that was refused before planning: the keys of `insertion_result`.

    parts: names of controller and phantom; target x, y, z in mm, None if it is not known.
    """
    known: dict[str, Any] = {
        **parts,
        "dry_run": dry_run,
        "target_mm": None if target is None else list(target),
        "reached": False,
        "outcome": str(Outcome.REFUSED),
        "reason": reason,
        "flips": 0,
        "steps": 0,
        "held_s": 0.0,
        "seed": seed,
    }
    return {key: known.get(key) for key in RESULT_KEYS}


def insertion_timing(insertion: Insertion) -> dict[str, Any]:
    """Return the wall-clock times of plan (s) and periods (ms)."""
    totals = [period.durations["total"] for period in insertion.periods if "total" in period.durations]
    milliseconds = (
        [1e3 * float(value) for value in np.percentile(totals, (50, 99, 100))] if totals else [None] * 3
    )
    return {
        **plan_timing(insertion.plan),
        "period_ms": dict(zip(_OF_PERIODS, milliseconds, strict=True)),
        **({"ticks": dict(insertion.ticks)} if insertion.ticks else {}),
    }


def _measured_tip(insertion: Insertion) -> tuple[float | None, float | None, float | None] | None:
    good = [period.measurement for period in insertion.periods if period.verdict.ok]
    return (good[-1].x, good[-1].y, good[-1].z) if good else None
