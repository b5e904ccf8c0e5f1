"""The tables of a study in Parquet: one row per insertion, in grid order; times in a separate table."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flexneedle.files import replace_file
from flexneedle.lab.study.grid import ExpandedStudy, StudyInsertion, StudyPoint
from flexneedle.lab.study.jobs import TIMES
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs, digest_reach_inputs
from flexneedle.record.folder import versions
from flexneedle.record.results import RESULT_COLUMNS
from flexneedle.record.sensor_results import sensor_columns
from flexneedle.scenario.alternatives import YOUNG

RUNS_FILE, TIMING_FILE = "runs.parquet", "timing.parquet"
_TYPES = {float: pa.float64(), int: pa.int64(), str: pa.string(), bool: pa.bool_()}

# Columns of the conditions of an insertion, with the key of its plan: type and value.
_CONDITIONS: dict[str, tuple[type, Callable[[StudyInsertion, str], Any]]] = {
    "controller": (str, lambda insertion, _: insertion.point.controller),
    "plant": (str, lambda insertion, _: insertion.point.plant),
    "tracker": (str, lambda insertion, _: insertion.point.tracker),
    "strategy": (str, lambda insertion, _: insertion.point.strategy),
    "target_depth_mm": (float, lambda insertion, _: insertion.point.scenario.target.depth_mm),
    "target_lateral_mm": (float, lambda insertion, _: insertion.point.scenario.target.lateral_mm),
    "target_lateral_z_mm": (float, lambda insertion, _: insertion.point.scenario.target.lateral_z_mm),
    "seed": (int, lambda insertion, _: insertion.seed),
    "plan_seed": (int, lambda insertion, _: insertion.point.plan_seed),
    "repeat": (int, lambda insertion, _: insertion.repeat),
    "plan": (str, lambda _, plan: plan),
    "world": (int, lambda insertion, _: insertion.point.world),
    "world_case": (str, lambda insertion, _: insertion.point.world_case),
    "world_rig": (str, lambda insertion, _: insertion.point.world_rig),
    "world_kind": (str, lambda insertion, _: insertion.point.world_kind),
}
_TIMING = {"index": int, "plan": str, "plan_s": float, **TIMES}


def write_tables(
    folder: Path, study: ExpandedStudy, rows: Mapping[int, Mapping[str, Any]], plans: StudyPlans
) -> None:
    """Write `runs.parquet` and `timing.parquet` for the finished rows (by index).

    The bytes of `runs.parquet` depend only on study and versions, not on the assignment of rows to workers.
    """
    insertions = [study.insertion(index) for index in sorted(rows)]
    keys = {id(point): digest_plan_inputs(point) for point in study.points}
    plan_keys = [keys[id(insertion.point)] for insertion in insertions]
    results = _add_reach(insertions, [rows[insertion.index] for insertion in insertions])
    _write(folder / RUNS_FILE, _make_runs(study, insertions, plan_keys, results))
    seconds = {key: plans.seconds(key) for key in set(plan_keys)}
    timing = [
        {**row, "plan": key, "plan_s": seconds[key]} for row, key in zip(results, plan_keys, strict=True)
    ]
    _write(folder / TIMING_FILE, pa.table(_make_columns(timing, _TIMING)))


def sum_times(folder: Path) -> dict[str, float]:
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


def _add_reach(
    insertions: Sequence[StudyInsertion], results: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """Return the results, each with the reach that was computed for the same truth."""
    digests = {id(i.point): digest_reach_inputs(i.point) if i.point.with_reach else "" for i in insertions}
    keys = [(digests[id(insertion.point)], insertion.seed) for insertion in insertions]
    known = {
        key: row["reach_mm"] for key, row in zip(keys, results, strict=True) if row["reach_mm"] is not None
    }
    return [{**row, "reach_mm": known.get(key)} for key, row in zip(keys, results, strict=True)]


def _make_runs(
    study: ExpandedStudy,
    insertions: Sequence[StudyInsertion],
    plan_keys: Sequence[str],
    results: Sequence[Mapping[str, Any]],
) -> pa.Table:
    flats = {id(point): point.scenario.flat() | _list_youngs(point) for point in study.points}
    settings = [flats[id(insertion.point)] for insertion in insertions]
    conditions = [
        _list_conditions(insertion, key) for insertion, key in zip(insertions, plan_keys, strict=True)
    ]
    version_columns = {f"version_{name}": [value] * len(insertions) for name, value in versions().items()}
    sensors = dict.fromkeys(one.title for point in study.points for one in point.scenario.sensor)
    cases = [{"index": insertion.index, "case": insertion.point.case} for insertion in insertions]
    return pa.table(
        _make_columns(cases, {"index": int, "case": str})
        | _make_columns(settings, _find_kinds(list(flats.values())))
        | _make_columns(conditions, {name: kind for name, (kind, _) in _CONDITIONS.items()})
        | _make_columns(results, {name: column.kind for name, column in RESULT_COLUMNS.items()})
        | _make_columns(results, sensor_columns(sensors))
        | {name: pa.array(values, pa.string()) for name, values in version_columns.items()}
    )


def _list_youngs(point: StudyPoint) -> dict[str, float]:
    """Return the values of axes of Young's moduli, which a scenario converts, by key."""
    return {key: float(value) for key, value in point.varied.items() if key.endswith(f".{YOUNG}")}


def _list_conditions(insertion: StudyInsertion, key: str) -> dict[str, Any]:
    return {name: value(insertion, key) for name, (_, value) in _CONDITIONS.items()}


def _make_columns(rows: Sequence[Mapping[str, Any]], kinds: Mapping[str, Any]) -> dict[str, pa.Array]:
    return {
        name: pa.array([row.get(name) for row in rows], _choose_type(kind)) for name, kind in kinds.items()
    }


def _choose_type(kind: Any) -> pa.DataType:
    return pa.list_(pa.float64()) if kind is list else _TYPES[kind]


def _find_kinds(flats: Sequence[Mapping[str, Any]]) -> dict[str, type]:
    """Return the type of each scenario value, in the order of the schema; values that no scenario has are omitted."""
    return {name: type(value) for flat in flats for name, value in flat.items()}


def _write(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    replace_file(path, sink.getvalue().to_pybytes())
