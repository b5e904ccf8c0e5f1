"""Reactions to the miss that a decision predicts at the target: a warning, or a hold."""

import cmath
import math

from scipy.special import chndtr

from flexneedle.control.interface import Decision
from flexneedle.errors import TO_INSERT_ANYWAY
from flexneedle.results import TARGET_RADIUS_MM, format_mm
from flexneedle.scenario.sections.settings import ControlSettings

_LIKELY = 0.5  # probability of a miss from which a decision counts towards a warning
_IN_A_ROW = 3  # such decisions make one: a single prediction, right after the skin for example, may be wrong


def probability_beyond(limit: float, miss: float | complex, sd: float) -> float:
    """Return the probability that a normal miss is larger than `limit` (mm); 0 where nothing is predicted (NaN).

    miss: its mean; sd: its standard deviation on each axis (mm).
    """
    if cmath.isnan(miss) or math.isnan(sd):
        return 0.0
    if sd == 0.0:
        return float(abs(miss) > limit)
    if isinstance(miss, complex):  # (size/sd)² is noncentral χ² distributed
        return 1.0 - float(chndtr((limit / sd) ** 2, 2.0, (abs(miss) / sd) ** 2))
    scale = sd * math.sqrt(2.0)
    return 0.5 * (math.erfc((limit - miss) / scale) + math.erfc((limit + miss) / scale))


def format_miss(miss: float | complex) -> str:
    """Return a miss (mm) as text: with its sign in the plane, its size in space."""
    return f"{abs(miss):.3f}" if isinstance(miss, complex) else f"{miss:+.3f}"


def reason_to_hold(decision: Decision, control: ControlSettings) -> str:
    """Return the reason to hold the needle: no path was found, or none that ends within the limit; else ""."""
    if decision.cost == math.inf:
        return decision.why
    limit = control.miss_limit_mm
    probability = probability_beyond(limit, decision.miss, decision.miss_sd)
    if probability < control.miss_confidence:
        return ""
    return (
        f"no path to the target found: predicted miss {_format_prediction(decision)} is beyond "
        f"control.miss_limit_mm = {limit:g} with a probability of {probability:.3f} "
        f"(limit {control.miss_confidence:.3f}){TO_INSERT_ANYWAY}"
    )


def count_likely_misses(decision: Decision, before: int) -> int:
    """Return the number of successive decisions that predict a miss of more than 1 mm, including this one.

    before: the number before this decision.
    """
    probability = probability_beyond(TARGET_RADIUS_MM, decision.miss, decision.miss_sd)
    return before + 1 if probability >= _LIKELY else 0


def warn_of_miss(decision: Decision, in_a_row: int) -> str:
    """Return a warning after enough successive decisions that predict a miss of more than 1 mm, else ""."""
    if in_a_row < _IN_A_ROW or cmath.isnan(decision.miss):
        return ""
    return f"predicted miss {_format_prediction(decision)}: likely beyond {TARGET_RADIUS_MM:g} mm"


def _format_prediction(decision: Decision) -> str:
    return f"{format_miss(decision.miss)} ± {format_mm(decision.miss_sd)}"


def describe_miss(true: float, estimated: float) -> str:
    """Return a line if an insertion ended more than 1 mm from its target, else "".

    true, estimated: distances of the true and the estimated tip (mm), true NaN if unknown.
    """
    if not math.isnan(true):
        return f"missed the target by {format_mm(true)}" if true > TARGET_RADIUS_MM else ""
    return (
        f"the estimated tip ended {format_mm(estimated)} from the target"
        if estimated > TARGET_RADIUS_MM
        else ""
    )
