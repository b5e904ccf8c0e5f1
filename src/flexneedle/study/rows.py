"""What a worker does: plan, or carry out insertions and return a row for each. A failure is a row, too."""

import fcntl
import os
import tempfile
import time
import warnings
from dataclasses import dataclass, field
from functools import cache
from math import isnan
from pathlib import Path
from typing import Any

from flexneedle.errors import RunError, ScenarioWarning
from flexneedle.planning.planner import plan
from flexneedle.rig.kernels import compile_kernels
from flexneedle.rig.loop import insert
from flexneedle.study.grid import GridPoint
from flexneedle.study.reach import reach
from flexneedle.trace.folder import versions
from flexneedle.trace.plain import plain, plan_values
from flexneedle.types import Insertion, Plan

RESULTS = {
    "true_error_mm": float,
    "residual_mm": float,
    "tip_x_mm": float,
    "tip_y_mm": float,
    "flips": int,
    "planned_flips": int,
    "strain_energy_mj": float,
    "planned_strain_energy_mj": float,
    "planned_error_mm": float,
    "guide_travel_mm": float,
    "peak_stretch": float,
    "periods": int,
    "planned_periods": int,
    "held_s": float,
    "unconverged_periods": int,
    "reach_mm": float,
    "predicted_quarter_mm": float,
    "predicted_quarter_sd_mm": float,
    "predicted_half_mm": float,
    "predicted_half_sd_mm": float,
    "predicted_three_quarters_mm": float,
    "predicted_three_quarters_sd_mm": float,
    "warning": str,
    "outcome": str,
    "reason": str,
}
"""What an insertion came to: the columns and their types; null where it is not known.

predicted_…: lateral miss that the controller predicted when the tip was at that part of the target's depth, and its
standard deviation.
"""
_PARTS = {"quarter": 0.25, "half": 0.5, "three_quarters": 0.75}
TIMES = {"control_s": float, "plant_s": float, "total_s": float}
"""Wall-clock times of an insertion."""


@dataclass(frozen=True, eq=False)
class Job:
    """Insertions of one point: (index, seed) of each. Without a plan, `refusal` says why there is none.

    bounded: whether their reach is wanted; one of all points with the same truth is enough.
    """

    point: GridPoint
    plan: Plan | None
    refusal: str
    insertions: tuple[tuple[int, int], ...]
    bounded: bool = False


@dataclass(frozen=True)
class Planned:
    """A plan as plain values and the seconds that it took, or why there is none."""

    values: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    refusal: str = ""


@dataclass(frozen=True)
class Done:
    """Rows of a job, each with its index, results and times, and the versions of the worker."""

    rows: list[dict[str, Any]]
    versions: dict[str, str]


def make_plan(point: GridPoint) -> Planned:
    """Plan for a point, on one thread."""
    _ready()
    try:
        made = plan(point.scenario, strategy=point.strategy, seed=point.plan_seed, threads=1)
    except Exception as error:  # noqa: BLE001  whatever a plan fails with is said in each of its rows
        return Planned(refusal=f"no plan: {_told(error)}")
    return Planned(plan_values(made), made.seconds)


def carry_out(job: Job) -> Done:
    """Carry out the insertions of a job, on one thread."""
    _ready()
    return Done([{"index": index, **_row(job, seed)} for index, seed in job.insertions], versions())


def _row(job: Job, seed: int) -> dict[str, Any]:
    begun = time.perf_counter()
    results = dict.fromkeys(RESULTS) | _planned(job.plan)
    results |= {"warning": "", "outcome": "error", "reason": job.refusal}
    times: dict[str, float] = {}
    if job.plan is not None:
        try:
            insertion = _insertion(job, job.plan, seed)
        except RunError as error:
            results |= {"outcome": "refused", "reason": str(error)}
        except Exception as error:  # noqa: BLE001  one insertion must not end a study; its row says what it was
            results["reason"] = _told(error)
        else:
            results |= _results(insertion)
            times = _times(insertion)
    times["total_s"] = time.perf_counter() - begun
    if job.bounded:
        results["reach_mm"], failed = _reach(job.point, seed)
        results["reason"] = "; ".join(filter(None, (results["reason"], failed)))
    values: dict[str, Any] = plain(results | times)
    return values


def _reach(point: GridPoint, seed: int) -> tuple[float | None, str]:
    """The reach (mm), or why there is none: the insertion's own outcome stands."""
    try:
        return reach(point.scenario, seed, point.plant, point.strategy), ""
    except Exception as error:  # noqa: BLE001  as in an insertion
        return None, f"no reach: {_told(error)}"


def _insertion(job: Job, made: Plan, seed: int) -> Insertion:
    point = job.point
    with warnings.catch_warnings():
        # The study has checked its tables: that of another of its controllers is nothing to warn of.
        warnings.simplefilter("ignore", ScenarioWarning)
        return insert(
            point.scenario,
            made,
            seed,
            controller=point.controller,
            phantom=point.plant,
            tracker=point.tracker,
            threads=1,
        )


def _planned(made: Plan | None) -> dict[str, Any]:
    if made is None:
        return {}
    return {
        "planned_flips": made.flips,
        "planned_strain_energy_mj": made.strain_energy_mj,
        "planned_error_mm": made.error_mm,
        "planned_periods": len(made.controls),
    }


def _results(insertion: Insertion) -> dict[str, Any]:
    periods = insertion.periods
    last = periods[-1]
    tip = last.true_tip or (None, None, None)
    return {
        "true_error_mm": insertion.true_error_mm,
        "residual_mm": insertion.residual_mm,
        "tip_x_mm": tip[0],
        "tip_y_mm": tip[1],
        "flips": insertion.flips,
        "strain_energy_mj": last.true_strain_energy,
        "guide_travel_mm": sum(abs(period.applied[3]) for period in periods),
        "peak_stretch": last.true_stretch,
        "periods": len(periods),
        "held_s": insertion.held_s,
        "unconverged_periods": sum(not period.converged for period in periods),
        **_predictions(insertion),
        "warning": insertion.warning,
        "outcome": insertion.outcome,
        "reason": insertion.reason,
    }


def _predictions(insertion: Insertion) -> dict[str, float | None]:
    """Miss and standard deviation (mm) of the first decision with the tip at each part of the target's depth."""
    found: dict[str, float | None] = {}
    for name, part in _PARTS.items():
        depth = part * insertion.target[0]
        first = next((p for p in insertion.periods if p.estimate[0] >= depth and not isnan(p.miss)), None)
        found[f"predicted_{name}_mm"] = None if first is None else first.miss
        found[f"predicted_{name}_sd_mm"] = None if first is None else first.miss_sd
    return found


def _times(insertion: Insertion) -> dict[str, float]:
    periods = insertion.periods
    return {
        "control_s": sum(period.durations["decide"] + period.durations["observe"] for period in periods),
        "plant_s": sum(period.durations["apply"] for period in periods),
    }


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@cache
def _ready() -> None:
    """Compile before the first work of a process; one process of a machine at a time, or the cache suffers."""
    versions()  # while the source on the disk is what was loaded: it is looked at once
    with (Path(tempfile.gettempdir()) / f"flexneedle-{os.getuid()}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        compile_kernels()
