"""Jobs of a worker: plan, or run insertions and return a row for each. A failure is also a row."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from flexneedle.errors import RunError, ScenarioWarning, describe_error
from flexneedle.lab.study.grid import StudyPoint
from flexneedle.lab.study.reach import compute_reach
from flexneedle.loop.insertions import insert
from flexneedle.loop.virtual import VirtualRig
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.planning.events import Listener
from flexneedle.planning.planner import plan
from flexneedle.record.plain import plain, plan_values
from flexneedle.record.results import RESULT_COLUMNS, insertion_row, plan_row
from flexneedle.record.sensor_results import sensor_row
from flexneedle.results import Insertion, Plan

TIMES = {"control_s": float, "plant_s": float, "total_s": float}
"""Wall-clock times of an insertion."""


@dataclass(frozen=True, eq=False)
class InsertionJob:
    """Insertions of one point: (index, seed) of each; refusal: reason for a missing plan.

    with_reach: whether to compute their reach; needed for one of all points with the same truth.
    """

    point: StudyPoint
    plan: Plan | None
    refusal: str
    insertions: tuple[tuple[int, int], ...]
    with_reach: bool = False


@dataclass(frozen=True)
class PlanResult:
    """A plan by field and its planning time (s), or the reason why planning failed; the chosen entry by field."""

    values: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    refusal: str = ""
    entry: dict[str, float] = field(default_factory=dict)


def make_plan(point: StudyPoint) -> PlanResult:
    """Plan for a point, on one thread."""
    _compile_once(point.scenario.setup.axes)
    try:
        made = plan(point.scenario, strategy=point.strategy, seed=point.plan_seed, threads=1)
    except Exception as error:  # noqa: BLE001  any failure of a plan is recorded in its rows
        return PlanResult(refusal=f"no plan: {describe_error(error)}")
    chosen = made.scenario.entry.model_dump() if made.scenario and point.scenario.entry.free else {}
    return PlanResult(plan_values(made), made.seconds, entry=chosen)


def run_job(job: InsertionJob) -> list[dict[str, Any]]:
    """Run the insertions of a job, on one thread, and return their rows: index, results and times."""
    _compile_once(job.point.scenario.setup.axes)
    return [{"index": index, **_make_row(job, seed)} for index, seed in job.insertions]


def _make_row(job: InsertionJob, seed: int) -> dict[str, Any]:
    begun = time.perf_counter()
    results: dict[str, Any] = dict.fromkeys(RESULT_COLUMNS)
    results |= {"warning": "", "outcome": "error", "reason": job.refusal}
    times: dict[str, float] = {}
    if job.plan is not None:
        results |= plan_row(job.plan)
        try:
            insertion = insert_at(job.point, job.plan, seed, threads=1)
        except RunError as error:
            results |= {"outcome": "refused", "reason": str(error)}
        except Exception as error:  # noqa: BLE001  recorded in the row: one insertion must not end a study
            results["reason"] = describe_error(error)
        else:
            results |= insertion_row(insertion) | sensor_row(insertion)
            times = _sum_times(insertion)
    times["total_s"] = time.perf_counter() - begun
    if job.with_reach:
        results["reach_mm"], failed = _try_reach(job.point, seed)
        results["reason"] = "; ".join(filter(None, (results["reason"], failed)))
    values: dict[str, Any] = plain(results | times)
    return values


def _try_reach(point: StudyPoint, seed: int) -> tuple[float | None, str]:
    """Return the reach (mm), or the reason why it is unknown; the outcome of the insertion is not affected."""
    try:
        return compute_reach(point.scenario, seed, point.plant, point.strategy), ""
    except Exception as error:  # noqa: BLE001  recorded in the row
        return None, f"no reach: {describe_error(error)}"


def insert_at(
    point: StudyPoint,
    made: Plan,
    seed: int,
    *,
    threads: int | None = None,
    listeners: Sequence[Listener] = (),
) -> Insertion:
    """Return an insertion of a point. threads, listeners: as in `flexneedle.insert`."""
    with warnings.catch_warnings():
        # The study has checked all tables; a table of another of its controllers is not unused.
        warnings.simplefilter("ignore", ScenarioWarning)
        return insert(
            point.scenario,
            made,
            seed,
            controller=point.controller,
            rig=VirtualRig(point.plant, point.tracker),
            threads=threads,
            listeners=listeners,
        )


def _sum_times(insertion: Insertion) -> dict[str, float]:
    periods = insertion.periods
    return {
        "control_s": sum(period.durations["decide"] + period.durations["observe"] for period in periods),
        "plant_s": sum(period.durations["apply"] for period in periods),
    }


@cache
def _compile_once(axes: int) -> None:
    """Compile the kernels once per process."""
    compile_kernels(axes)
