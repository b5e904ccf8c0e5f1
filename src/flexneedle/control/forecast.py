"""What follows from the miss that a decision predicts at the target: a warning, or a hold."""

import math

from flexneedle.control.interface import Decision
from flexneedle.scenario import Control

__all__ = ["hopeless", "probability_beyond", "warning"]

_RADIUS_MM = 1.0  # of the paper's target circles: an insertion that ends beyond has missed
_LIKELY = 0.2  # probability of that from which a warning is given


def probability_beyond(limit: float, miss: float, sd: float) -> float:
    """Probability that a normal miss (mean `miss`, standard deviation `sd`, mm) is larger than `limit` in size.

    0 where nothing is predicted (NaN).
    """
    if math.isnan(miss) or math.isnan(sd):
        return 0.0
    if sd == 0.0:
        return float(abs(miss) > limit)
    scale = sd * math.sqrt(2.0)
    return 0.5 * (math.erfc((limit - miss) / scale) + math.erfc((limit + miss) / scale))


def hopeless(decision: Decision, control: Control) -> str:
    """Why the needle is to be held: no path found ends within the limit; empty if one may."""
    limit = control.miss_limit_mm
    probability = probability_beyond(limit, decision.miss, decision.miss_sd)
    if probability < control.miss_confidence:
        return ""
    return (
        f"no path to the target found: predicted miss {decision.miss:+.2f} ± {decision.miss_sd:.2f} mm is beyond "
        f"control.miss_limit_mm = {limit:g} with a probability of {probability:.3f} "
        f"(limit {control.miss_confidence:g}); use --force to insert anyway"
    )


def warning(decision: Decision) -> str:
    """A line if the insertion is likely to miss by more than 1 mm; empty otherwise."""
    probability = probability_beyond(_RADIUS_MM, decision.miss, decision.miss_sd)
    if probability < _LIKELY:
        return ""
    return (
        f"predicted miss {decision.miss:+.2f} ± {decision.miss_sd:.2f} mm: "
        f"beyond {_RADIUS_MM:g} mm with a probability of {probability:.2f}"
    )
