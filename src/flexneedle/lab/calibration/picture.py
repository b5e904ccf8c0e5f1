"""The picture of a profile likelihood."""

from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from flexneedle.figures.layout import look
from flexneedle.figures.style import QUIET, apply_style, new_figure, settle
from flexneedle.files import replace_file
from flexneedle.lab.calibration.calibration import Calibration, Profile

_HEIGHT = 3.2  # inches
_LEVEL = 0.95


def draw_profile(found: Profile, fitted: float) -> Figure:
    """Return the figure of a profile, with the fitted value."""
    parameter = found.parameter
    with apply_style():
        figure = new_figure(_HEIGHT)
        ax = figure.subplots()
        ax.plot(found.values, found.rise, "o-", color=look(0).color, markersize=4.0)
        ax.axhline(float(chi2.ppf(_LEVEL, 1)), color=QUIET, linestyle="--", linewidth=1.0)
        ax.annotate("95 %", (found.values[0], chi2.ppf(_LEVEL, 1)), va="bottom", fontsize=8, color=QUIET)
        ax.axvline(fitted, color=QUIET, linewidth=0.8)
        if parameter.log:
            ax.set_xscale("log")
            for place in (ax.xaxis.set_major_formatter, ax.xaxis.set_minor_formatter):
                place(lambda value, _: f"{value:.3g}")
        unit = f" ({parameter.unit})" if parameter.unit else ""
        ax.set_xlabel(f"{parameter.label}{unit}")
        ax.set_ylabel("rise of the loss")
        ax.set_ylim(bottom=min(0.0, float(np.min(found.rise))))
    return figure


def save_profile(found: Calibration, name: str, scenario: Path) -> Path:
    """Write the picture of a parameter's profile beside a calibrated scenario; return its path."""
    profile = found.profile(name)
    interval = found.intervals[profile.parameter.label]
    path, image = scenario.with_suffix(f".{name.replace(' ', '_')}.png"), BytesIO()
    with apply_style():
        figure = draw_profile(profile, profile.parameter.value(interval.value))
        settle(figure)
        figure.savefig(image, format="png", dpi=200, metadata={"Software": None})
    replace_file(path, image.getvalue())
    return path
