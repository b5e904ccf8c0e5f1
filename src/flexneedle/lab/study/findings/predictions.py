"""Quality of the predictions of a controller: the final needle with its standard deviation, and the warnings."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.lab.study.findings.design import StudyDesign
from flexneedle.lab.study.findings.groups import HIT_MM, find_finished, split_rows
from flexneedle.lab.study.findings.rows import Flags, Floats, InsertionRows
from flexneedle.lab.study.findings.worlds import average
from flexneedle.record.results import DEPTH_FRACTIONS, LATERAL_AXES, PREDICTED_PARTS, sds_column

GOOD_MM = 0.5
WIDTH = 1.959963984540054
"""A normal deviation is within ± this number of standard deviations with a probability of 95 %."""
Shares = tuple[float, float, float]
"""At a quarter, half and three quarters of the depth."""


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


def assess_predictions(rows: InsertionRows, design: StudyDesign) -> list[Predictions]:
    """Return the groups with predictions, in the order of the factors."""
    tip, middle = (_read_deviations(rows, part) for part in PREDICTED_PARTS)
    known = find_finished(rows) & ~(np.isnan(tip) & np.isnan(middle)).all(axis=(0, 1))
    sds = np.array([rows.number(f"predicted_{name}_sd_mm") for name in DEPTH_FRACTIONS])
    warning: Flags = ~np.isnan(sds).all(axis=0)
    error, warned = rows.number("true_error_mm"), np.array([bool(line) for line in rows.text("warning")])
    groups = [(levels, own[known[own]]) for levels, own in split_rows(design.factors)]
    return [
        Predictions(
            levels,
            len(own),
            compute_coverage(tip[..., own]),
            compute_coverage(middle[..., own]),
            average(warned[own][error[own] < GOOD_MM]) if warning[own].any() else nan,
            int(np.count_nonzero((error[own] > HIT_MM) & ~warned[own])) if warning[own].any() else None,
        )
        for levels, own in groups
        if len(own) > 0
    ]


def _read_deviations(rows: InsertionRows, part: str) -> Floats:
    """Return the deviations (3, 2, n) of tip or middle from the predictions at the fractions of the depth, y and z."""
    return np.array([[rows.number(name) for name in axes] for axes in list_deviation_columns(part)])


def list_deviation_columns(part: str) -> list[list[str]]:
    """Return the columns of the deviations of tip or middle, y and z, at each fraction of the depth."""
    return [[sds_column(name, part, axis) for axis in LATERAL_AXES] for name in DEPTH_FRACTIONS]


def compute_coverage(sds: Floats) -> Shares:
    """Return the share of the known deviations (3, 2, n) within `WIDTH`, at each fraction; NaN if none is known.

    y and z count separately.
    """
    quarter, half, three_quarters = (average(np.abs(part[~np.isnan(part)]) <= WIDTH) for part in sds)
    return quarter, half, three_quarters
