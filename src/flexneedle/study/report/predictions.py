"""What the predictions of a controller were worth: the miss with its standard deviation, and the warnings."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.study.report.design import Design
from flexneedle.study.report.html import Html, element, table
from flexneedle.study.report.rows import Flags, Floats, Rows
from flexneedle.study.report.summary import HIT_MM, finished, members_of
from flexneedle.study.report.wording import number

_PLACES = ("quarter", "half", "three_quarters")
_NOMINAL = 0.95
_WIDTH = (
    1.959963984540054  # standard deviations to either side that contain the nominal share of a normal miss
)
_GOOD_MM = 0.5


@dataclass(frozen=True)
class Predictions:
    """Of the finished insertions that share a level of every factor and whose controller predicts: their number;
    covered: share of the lateral misses within ±1.96 sd of what was predicted at a quarter, half and three quarters of
    the depth; in_vain: share of those that end within 0.5 mm that had a warning; unwarned: number of those that end
    above 1 mm without one. NaN is what is not known.
    """

    levels: dict[str, str]
    count: int
    covered: tuple[float, float, float]
    in_vain: float
    unwarned: int


def predictions_of(rows: Rows, design: Design) -> list[Predictions]:
    """Return the groups whose controller predicts, in the order of the study's factors."""
    miss = rows.number("tip_y_mm") - rows.number("target_lateral_mm")
    inside = np.stack([_inside(rows, place, miss) for place in _PLACES])
    known = finished(rows) & ~np.isnan(inside).all(axis=0) & ~np.isnan(miss)
    error, warned = rows.number("true_error_mm"), np.array([bool(line) for line in rows.text("warning")])
    groups = [(levels, own[known[own]]) for levels, own in members_of(design)]
    return [_group(levels, inside[:, own], error[own], warned[own]) for levels, own in groups if len(own) > 0]


def _inside(rows: Rows, place: str, miss: Floats) -> Floats:
    """1 where the miss (n,) is within the interval that was predicted at a place, 0 where not, NaN without one."""
    mean, sd = rows.number(f"predicted_{place}_mm"), rows.number(f"predicted_{place}_sd_mm")
    within = np.abs(miss - mean) <= _WIDTH * sd
    return np.where(np.isnan(mean) | np.isnan(sd), nan, within)


def _group(levels: dict[str, str], inside: Floats, error: Floats, warned: Flags) -> Predictions:
    good = error < _GOOD_MM
    quarter, half, three_quarters = (_mean(part[~np.isnan(part)]) for part in inside)
    return Predictions(
        levels,
        len(error),
        (quarter, half, three_quarters),
        _mean(warned[good]),
        int(np.count_nonzero((error > HIT_MM) & ~warned)),
    )


def _mean(values: Floats | Flags) -> float:
    return float(np.mean(values)) if len(values) else nan


def prediction_table(groups: Sequence[Predictions]) -> Html | None:
    """Return the section with a row for each group, or None without any."""
    if not groups:
        return None
    heads = (
        *groups[0].levels,
        *("insertions", "covered at ¼ of the depth", "at ½", "at ¾"),
        *(f"warned, of those below {_GOOD_MM:g} mm", f"above {HIT_MM:g} mm without a warning"),
    )
    caption = (
        f"Finished insertions. Covered: the miss is within the predicted {_NOMINAL:.0%} interval, the prediction "
        "±1.96 of its standard deviations."
    )
    rows = [
        [
            *group.levels.values(),
            group.count,
            *(_percent(share) for share in (*group.covered, group.in_vain)),
            group.unwarned,
        ]
        for group in groups
    ]
    return element(
        "section", element("h2", "Predictions"), table(caption, heads, rows, names=len(groups[0].levels))
    )


def _percent(share: float) -> str:
    return number(100.0 * share, 1) + ("" if np.isnan(share) else " %")
