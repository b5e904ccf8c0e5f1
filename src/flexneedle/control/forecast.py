"""Reactions to the miss that a decision predicts at the target: a warning, or a hold."""

import cmath
import math

from scipy.special import chndtr

from flexneedle.control.interface import Decision
from flexneedle.scenario.sections.settings import ControlSettings

_RADIUS_MM = 1.0  # radius of the paper's target circles: an insertion that ends outside has missed
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


def format_miss(miss: float | complex, digits: int = 3) -> str:
    """Return a miss (mm) as text: with its sign in the plane, its size in space."""
    return f"{abs(miss):.{digits}f}" if isinstance(miss, complex) else f"{miss:+.{digits}f}"


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
        f"(limit {control.miss_confidence:g}); to insert anyway: flexneedle insert --force"
    )


def count_likely_misses(decision: Decision, before: int) -> int:
    """Return the number of successive decisions that predict a miss of more than 1 mm, including this one.

    before: the number before this decision.
    """
    probability = probability_beyond(_RADIUS_MM, decision.miss, decision.miss_sd)
    return before + 1 if probability >= _LIKELY else 0


def warn_of_miss(decision: Decision, in_a_row: int) -> str:
    """Return a warning after enough successive decisions that predict a miss of more than 1 mm, else ""."""
    if in_a_row < _IN_A_ROW or cmath.isnan(decision.miss):
        return ""
    return f"predicted miss {_format_prediction(decision)}: likely beyond {_RADIUS_MM:g} mm"


def _format_prediction(decision: Decision) -> str:
    return f"{format_miss(decision.miss, 2)} ± {decision.miss_sd:.2f} mm"


def describe_miss(true: float, estimated: float) -> str:
    """Return a line if an insertion ended more than 1 mm from its target, else "".

    true, estimated: distances of the true and the estimated tip (mm), true NaN if unknown.
    """
    if not math.isnan(true):
        return f"missed the target by {true:.2f} mm" if true > _RADIUS_MM else ""
    return f"the estimated tip ended {estimated:.2f} mm from the target" if estimated > _RADIUS_MM else ""
