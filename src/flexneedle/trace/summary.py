"""What a plan or an insertion came to, in a number or in one line."""

import numpy as np

from flexneedle.trace.records import Insertion, PlanRecord

__all__ = ["entry_angle", "plan_verdict", "verdict"]


def entry_angle(plan: PlanRecord) -> float:
    """Return the slope angle (rad) of the planned tip as it meets the skin; NaN if it never does."""
    depth, angle = plan.tips[:, 0], plan.tips[:, 2]
    inside = np.flatnonzero(depth >= 0.0)
    if len(inside) == 0:
        return float("nan")
    after = max(int(inside[0]), 1)
    ends = slice(after - 1, after + 1)
    return float(np.interp(0.0, depth[ends], angle[ends]))


def plan_verdict(plan: PlanRecord) -> str:
    """Say in one line how near a plan comes, and which limit binds if that is not near enough."""
    binding = f", limited by {plan.limit}" if plan.limit else ""
    if plan.reached:
        return f"reaches the target to {plan.error_mm:.3f} mm{binding}"
    return f"MISSES the target: best distance {plan.error_mm:.3f} mm, more than 1 mm{binding}"


def verdict(insertion: Insertion) -> str:
    """Say in one line how an insertion ended."""
    error = insertion.true_error_mm
    if insertion.outcome != "done":
        after = f"{insertion.outcome} after {len(insertion.periods)} periods"
        return f"{after}: {insertion.reason}" if insertion.reason else after
    if np.isnan(error):
        return "done: the true tip is not known"
    if insertion.reached:
        return f"reached: the tip ended {error:.3f} mm from the target"
    return f"MISSED: the tip ended {error:.3f} mm from the target, more than 1 mm"
