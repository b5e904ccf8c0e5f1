"""Figure of a check in air: readings of each sensor beside their prediction, before and after the correction."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures.style import BAD, ESTIMATE, MEASURED, apply_style, new_figure
from flexneedle.lab.rig.sensor_check.air_fit import AirFit
from flexneedle.types import Floats

_ROW = 2.1  # height of a row (inches)
_NEAR_S = 0.1  # time over which a change counts, to both sides
_ZOOM_S = 1.0  # to both sides


def draw_check(fit: AirFit) -> Figure:
    """Return the figure: for each sensor that measures the needle the value that changes most, and a part of it."""
    before = fit.predict_without_errors()
    shown = [k for k, used in enumerate(fit.used) if used.any()]
    with apply_style():
        figure = new_figure(max(1, len(shown)) * _ROW)
        panels = figure.subplots(max(1, len(shown)), 2, squeeze=False, width_ratios=(3, 1))
        for row, k in zip(panels, shown, strict=False):
            _draw_sensor(row[0], row[1], fit, k, before[k])
        figure.legend(*panels[0, 0].get_legend_handles_labels(), ncols=3, loc="outside upper right")
    return figure


def _draw_sensor(whole: Axes, part: Axes, fit: AirFit, number: int, before: Floats) -> None:
    """Draw the value with the largest scatter of its prediction; the part is where that changes fastest."""
    one, after, used = fit.model.sensors[number], fit.predicted[number], fit.used[number]
    column = int(np.argmax(np.where(used.any(axis=0), after.std(axis=0), -1.0)))
    factor, unit = one.sensor.unit
    kept, time = used[:, column], one.time
    value, *predicted = (
        np.where(kept, factor * rows[:, column], np.nan) for rows in (one.value, before, after)
    )
    for panel in (whole, part):
        panel.plot(time, value, ".", color=MEASURED, markersize=2, alpha=0.5, label="measured")
        for line, color, style, name in zip(
            predicted, (BAD, ESTIMATE), ("--", "-"), ("without", "with"), strict=True
        ):
            drawn = np.isfinite(line)
            panel.plot(
                time[drawn], line[drawn], style, color=color, linewidth=1.0, label=f"predicted, {name} errors"
            )
        panel.set_xlabel("time (s)")
    whole.set(title=one.name, ylabel=f"value {column + 1} of {after.shape[1]} ({unit})")
    seen, curve = time[kept], after[kept, column]
    change = np.interp(seen + _NEAR_S, seen, curve) - np.interp(seen - _NEAR_S, seen, curve)
    middle = seen[int(np.argmax(np.abs(change)))]
    near = np.abs(time - middle) < _ZOOM_S
    part.set_xlim(middle - _ZOOM_S, middle + _ZOOM_S)
    low, high = np.nanmin(value[near]), np.nanmax(value[near])
    part.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
