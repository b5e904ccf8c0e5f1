"""Which readings may be believed. A bad one is reported, never repaired."""

import math

from flexneedle.ports import Sample

OK = "ok"


def judge(
    sample: Sample | None,
    predicted: tuple[float, float],
    now: float,
    stale_after: float,
    innovation_limit: float,
) -> str:
    """Return OK, or why `sample` is not to be believed, in a few words with the value and the limit.

    predicted: the model's tip (mm) at the time of the sample; times in s, innovation_limit in mm.
    """
    if sample is None:
        return "missing: no reading"
    if sample.x is None or sample.y is None:
        return "missing: tracker sees no tip"
    if not all(map(math.isfinite, (sample.time, sample.x, sample.y))):
        return "not a number"
    if now - sample.time > stale_after:
        return f"stale: {now - sample.time:.3f} s old, limit {stale_after:g} s"
    if sample.time > now + stale_after:
        return f"stale: dated {sample.time - now:.3f} s ahead"
    innovation = math.hypot(sample.x - predicted[0], sample.y - predicted[1])
    if innovation > innovation_limit:
        return f"innovation {innovation:.2f} mm, limit {innovation_limit:g} mm"
    return OK
