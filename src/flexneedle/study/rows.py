"""What a worker does: plan, or carry out insertions and return a row for each. A failure is a row, too."""

import fcntl
import os
import tempfile
import time
import warnings
from dataclasses import dataclass, field
from functools import cache
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
from flexneedle.trace.results import RESULT_COLUMNS, insertion_row, plan_row
from flexneedle.types import Insertion, Plan

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
    results: dict[str, Any] = dict.fromkeys(RESULT_COLUMNS)
    results |= {"warning": "", "outcome": "error", "reason": job.refusal}
    times: dict[str, float] = {}
    if job.plan is not None:
        results |= plan_row(job.plan)
        try:
            insertion = _insertion(job, job.plan, seed)
        except RunError as error:
            results |= {"outcome": "refused", "reason": str(error)}
        except Exception as error:  # noqa: BLE001  one insertion must not end a study; its row says what it was
            results["reason"] = _told(error)
        else:
            results |= insertion_row(insertion)
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
