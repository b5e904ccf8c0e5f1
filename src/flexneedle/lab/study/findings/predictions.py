"""Quality of the predictions of a controller: the final needle with its standard deviation, and the warnings."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.lab.study.coverage import Shares, columns_of, covered
from flexneedle.lab.study.findings.design import Design
from flexneedle.lab.study.findings.rows import Flags, Floats, Rows
from flexneedle.lab.study.findings.summary import HIT_MM, finished, members_of
from flexneedle.lab.study.findings.worlds import mean_of
from flexneedle.record.results import DEPTH_FRACTIONS, PREDICTED_PARTS

GOOD_MM = 0.5


@dataclass(frozen=True)
class Predictions:
    """Predictions in the finished insertions with the same level of every factor.

    count: insertions; tip_covered, middle_covered: share of the final true tips, and of the needles at half of the
    target's depth, within ±1.96 sd of the prediction at a quarter, half and three quarters of the depth, where y and
    z count separately; in_vain: share of false warnings among insertions that end within 0.5 mm; unwarned: number of
    insertions that end beyond 1 mm without a warning, None if the controller predicts no miss. NaN: unknown.
    """

    levels: dict[str, str]
    count: int
    tip_covered: Shares
    middle_covered: Shares
    in_vain: float
    unwarned: int | None


def predictions_of(rows: Rows, design: Design) -> list[Predictions]:
    """Return the groups with predictions, in the order of the factors."""
    tip, middle = (_deviations(rows, part) for part in PREDICTED_PARTS)
    known = finished(rows) & ~(np.isnan(tip) & np.isnan(middle)).all(axis=(0, 1))
    sds = np.array([rows.number(f"predicted_{name}_sd_mm") for name in DEPTH_FRACTIONS])
    warning: Flags = ~np.isnan(sds).all(axis=0)
    error, warned = rows.number("true_error_mm"), np.array([bool(line) for line in rows.text("warning")])
    groups = [(levels, own[known[own]]) for levels, own in members_of(design.factors)]
    return [
        Predictions(
            levels,
            len(own),
            covered(tip[..., own]),
            covered(middle[..., own]),
            mean_of(warned[own][error[own] < GOOD_MM]) if warning[own].any() else nan,
            int(np.count_nonzero((error[own] > HIT_MM) & ~warned[own])) if warning[own].any() else None,
        )
        for levels, own in groups
        if len(own) > 0
    ]


def _deviations(rows: Rows, part: str) -> Floats:
    """The deviations (3, 2, n) of tip or middle from the predictions at the fractions of the depth, in y and z."""
    return np.array([[rows.number(name) for name in axes] for axes in columns_of(part)])
