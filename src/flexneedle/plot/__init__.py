"""Figures of plans and insertions (matplotlib, Agg): same data, same bytes."""

from flexneedle.plot.insertion import insertion_figure
from flexneedle.plot.plans import plan_figure
from flexneedle.plot.style import save

__all__ = ["insertion_figure", "plan_figure", "save"]
