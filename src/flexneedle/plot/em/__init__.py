"""Figures of a tracker's evaluation. They see arrays and names, no tables."""

from flexneedle.plot.em.distance import DistanceLine, distance_figure
from flexneedle.plot.em.field import FieldRow, field_figure
from flexneedle.plot.em.indicator import IndicatorPanel, Shown, indicator_figure
from flexneedle.plot.em.roc import RocLine, roc_figure

__all__ = [
    "DistanceLine",
    "FieldRow",
    "IndicatorPanel",
    "RocLine",
    "Shown",
    "distance_figure",
    "field_figure",
    "indicator_figure",
    "roc_figure",
]
