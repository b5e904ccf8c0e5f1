"""Quality of the predictions of a controller: the miss with its standard deviation, and the warnings."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.study.findings.design import Design
from flexneedle.study.findings.rows import Flags, Floats, Rows
from flexneedle.study.findings.summary import HIT_MM, finished, members_of
from flexneedle.study.findings.worlds import mean_of
from flexneedle.trace.results import DEPTH_FRACTIONS

# A normal miss is within ± this many standard deviations with a probability of 95 %.
_WIDTH = 1.959963984540054
GOOD_MM = 0.5


@dataclass(frozen=True)
class Predictions:
    """Predictions in the finished insertions with the same level of every factor whose controller predicts the miss.

    count: insertions; covered: share of lateral misses within ±1.96 sd of the prediction at a quarter, half and three
    quarters of the depth; in_vain: share of false warnings among insertions that end within 0.5 mm; unwarned: number of
    insertions that end beyond 1 mm without a warning. NaN: unknown.
    """

    levels: dict[str, str]
    count: int
    covered: tuple[float, float, float]
    in_vain: float
    unwarned: int


def predictions_of(rows: Rows, design: Design) -> list[Predictions]:
    """Return the groups whose controller predicts the miss, in the order of the factors."""
    miss = rows.number("tip_y_mm") - rows.number("target_lateral_mm")
    inside = np.stack([_inside(rows, name, miss) for name in DEPTH_FRACTIONS])
    known = finished(rows) & ~np.isnan(inside).all(axis=0) & ~np.isnan(miss)
    error, warned = rows.number("true_error_mm"), np.array([bool(line) for line in rows.text("warning")])
    groups = [(levels, own[known[own]]) for levels, own in members_of(design.factors)]
    return [_group(levels, inside[:, own], error[own], warned[own]) for levels, own in groups if len(own) > 0]


def _inside(rows: Rows, fraction: str, miss: Floats) -> Floats:
    """1 where the miss (n,) is within the interval predicted at a fraction of the depth, 0 if not, NaN if unknown."""
    mean, sd = rows.number(f"predicted_{fraction}_mm"), rows.number(f"predicted_{fraction}_sd_mm")
    within = np.abs(miss - mean) <= _WIDTH * sd
    return np.where(np.isnan(mean) | np.isnan(sd), nan, within)


def _group(levels: dict[str, str], inside: Floats, error: Floats, warned: Flags) -> Predictions:
    quarter, half, three_quarters = (mean_of(part[~np.isnan(part)]) for part in inside)
    unwarned = int(np.count_nonzero((error > HIT_MM) & ~warned))
    return Predictions(
        levels, len(error), (quarter, half, three_quarters), mean_of(warned[error < GOOD_MM]), unwarned
    )
