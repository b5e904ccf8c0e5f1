"""The picture of a profile likelihood."""

from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from flexneedle.figures.layout import legend_of, look
from flexneedle.figures.style import QUIET, apply_style, new_figure, settle
from flexneedle.files import replace_file
from flexneedle.lab.calibration.calibration import Calibration, Profile
from flexneedle.lab.calibration.intervals import SAME_COST, Interval

_HEIGHT = 3.8  # inches
_WIDE = 20.0  # factor of the values from which the axis names only decades
_NOTE = (
    "The interval of the table adds the scatter of three or more insertions (jackknife) to this profile's."
)


def draw_profile(found: Profile, interval: Interval) -> Figure:
    """Return the figure of a profile, with the fitted value of an interval."""
    parameter = found.parameter
    fitted, unit = parameter.value(interval.value), f" {parameter.unit}".rstrip()
    with apply_style():
        figure = new_figure(_HEIGHT)
        ax = figure.subplots()
        ax.plot(
            found.values,
            found.rise,
            "o-",
            color=look(0).color,
            markersize=4.0,
            label="other parameters fitted again",
        )
        ax.axhline(SAME_COST, color=QUIET, linestyle="--", linewidth=1.0, label="95 % of the profile")
        ax.axvline(fitted, color=QUIET, linewidth=0.8, label=f"fitted value: {fitted:.4g}{unit}")
        if parameter.log:
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("" if found.values[-1] > _WIDE * found.values[0] else "{x:.3g}")
        ax.set_title(f"Profile of {parameter.label}{'' if interval.identified else ': not identified'}")
        kind = ", factor" if parameter.name == "stiffness" else f" ({parameter.unit})" * bool(parameter.unit)
        ax.set_xlabel(f"{parameter.label}{kind}")
        ax.set_ylabel("rise of the loss")
        ax.set_ylim(bottom=min(0.0, float(np.min(found.rise))))
        legend_of(figure, [ax], [_NOTE] if interval.identified else [])
    return figure


def save_profile(found: Calibration, name: str, scenario: Path) -> Path:
    """Write the picture of a parameter's profile beside a calibrated scenario; return its path."""
    profile = found.profile(name)
    interval = found.intervals[profile.parameter.label]
    path, image = scenario.with_suffix(f".{name.replace(' ', '_')}.png"), BytesIO()
    with apply_style():
        figure = draw_profile(profile, interval)
        settle(figure)
        figure.savefig(image, format="png", dpi=200, metadata={"Software": None})
    replace_file(path, image.getvalue())
    return path
