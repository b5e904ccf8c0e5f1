"""Results of a plan and of an insertion as plain values: the objects of `--json` and of `run.json`."""

from typing import Any

import numpy as np

from flexneedle.trace.plain import plain
from flexneedle.types import Insertion, Outcome, Plan

RESULT_KEYS = (
    *("controller", "phantom", "target_mm", "tip_true_mm", "tip_measured_mm", "true_error_mm", "residual_mm"),
    *("planned_error_mm", "reached", "outcome", "reason", "warning", "flips", "planned_flips"),
    *("strain_energy_mj", "planned_strain_energy_mj", "steps", "held_s", "converged", "seed"),
)
"""Keys of the result of an insertion, in order."""
_OF_PERIODS = ("p50", "p99", "max")
NO_TIMING = {"plan_seconds": None, "period_ms": dict.fromkeys(_OF_PERIODS)}
"""Times of an insertion that was rejected before planning."""


def plan_result(plan: Plan) -> dict[str, Any]:
    """Return the result of a plan; tip in mm."""
    result: dict[str, Any] = plain(
        {
            "tip_mm": plan.tip_mm,
            "error_mm": plan.error_mm,
            "reached": bool(plan.reached),
            "cost": plan.cost,
            "terms": plan.terms,
            "flips": plan.flips,
            "strain_energy_mj": plan.strain_energy[-1],
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
    """Return the result of an insertion; missing values are None."""
    plan, last = insertion.plan, insertion.periods[-1] if insertion.periods else None
    result: dict[str, Any] = plain(
        {
            "controller": insertion.controller,
            "phantom": insertion.phantom or None,
            "target_mm": insertion.target,
            "tip_true_mm": last.true_tip[:2] if last and last.true_tip else None,
            "tip_measured_mm": _measured_tip(insertion),
            "true_error_mm": insertion.true_error_mm,
            "residual_mm": insertion.residual_mm,
            "planned_error_mm": plan.error_mm,
            "reached": bool(insertion.reached),
            "outcome": insertion.outcome,
            "reason": insertion.reason,
            "warning": insertion.warning or None,
            "flips": insertion.flips,
            "planned_flips": plan.flips,
            "strain_energy_mj": last.true_strain_energy if last else None,
            "planned_strain_energy_mj": plan.strain_energy[-1],
            "steps": len(insertion.periods),
            "held_s": insertion.held_s,
            "converged": all(period.converged for period in insertion.periods),
            "seed": insertion.seed,
        }
    )
    return result


def refused_result(*, target: tuple[float, float], reason: str, seed: int, **parts: str) -> dict[str, Any]:
    """Return the result of an insertion that was rejected before planning: the keys of `insertion_result`.

    parts: names of controller and phantom; target in mm.
    """
    known: dict[str, Any] = {
        **parts,
        "target_mm": list(target),
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
    }


def _measured_tip(insertion: Insertion) -> tuple[float | None, float | None] | None:
    good = [period.sample for period in insertion.periods if period.verdict.ok]
    return (good[-1].x, good[-1].y) if good else None
