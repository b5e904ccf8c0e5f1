"""Figures of studies. They see arrays and names, no tables; `run.report` chooses which a study supports."""

from flexneedle.plot.studies.comparison import DifferencePanel, DifferenceRow, difference_figure
from flexneedle.plot.studies.cumulative import SharePanel, ShareRow, share_figure
from flexneedle.plot.studies.distributions import (
    ErrorPanel,
    ErrorRow,
    error_rows_figure,
    errors_by_level_figure,
)
from flexneedle.plot.studies.energy import EnergyPanel, energy_figure
from flexneedle.plot.studies.layout import MOST_PANELS, Look, look
from flexneedle.plot.studies.sweeps import Sweep, sweep_figure
from flexneedle.plot.studies.targeting import TargetPanel, targeting_figure

__all__ = [
    "MOST_PANELS",
    "DifferencePanel",
    "DifferenceRow",
    "EnergyPanel",
    "ErrorPanel",
    "ErrorRow",
    "Look",
    "SharePanel",
    "ShareRow",
    "Sweep",
    "TargetPanel",
    "difference_figure",
    "energy_figure",
    "error_rows_figure",
    "errors_by_level_figure",
    "look",
    "share_figure",
    "sweep_figure",
    "targeting_figure",
]
