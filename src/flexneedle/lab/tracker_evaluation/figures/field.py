"""The error field: slices of the volume with an arrow at each grid point along its error."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from flexneedle.figures.layout import short
from flexneedle.figures.style import QUIET, apply_style, format_signed, new_figure, width

MOST_ROWS, MOST_SLICES = 6, 5
MOST_ARROWS = 400
"""Most arrows per slice; of more, every k-th is drawn, with a note."""
_COLORS = "viridis_r"
_AROUND, _WIDEST = 0.95, 3.0  # inches: height of titles and labels of a row; largest width of a slice

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FieldRow:
    """A sensor in an environment: true positions (n, 3) and error vectors (n, 3) of its grid points, mm."""

    title: str
    true: Floats
    error: Floats


def draw_field(rows: Sequence[FieldRow]) -> Figure:
    """Return the figure: a row of slices (x, y at constant z) for each of up to six sensors and environments."""
    shown = rows[:MOST_ROWS]
    layers = [_slices(row.true[:, 2]) for row in shown]
    columns = max(map(len, layers))
    with apply_style():
        figure = new_figure(len(shown) * (_AROUND + min((width() - 1.6) / columns, _WIDEST)))
        parts = figure.subfigures(len(shown), 1, squeeze=False).ravel()
        for part, row, slices in zip(parts, shown, layers, strict=True):
            _draw_row(part, row, slices)
        if len(rows) > MOST_ROWS:
            figure.supxlabel(f"{len(rows) - MOST_ROWS} more not shown", color=QUIET, fontsize=8)
    return figure


def _draw_row(part: SubFigure, row: FieldRow, slices: Sequence[Numbers]) -> None:
    length = np.linalg.norm(row.error, axis=1)
    norm = Normalize(0.0, float(length.max()) or 1.0)
    factor = _factor(row, max(map(len, slices)))
    made = part.subplots(1, len(slices), sharex=True, sharey=True, squeeze=False)[0]
    left, right, bottom, top = _frame(row.true)
    for ax, chosen in zip(made, slices, strict=True):
        _draw_slice(ax, row, chosen, factor, norm)
        ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        ax.locator_params(nbins=4)
        ax.set_title(_level(row.true[chosen, 2]), color=QUIET, fontsize=8, fontweight="normal")
    made[0].set_ylabel("y (mm)")
    bar = part.colorbar(ScalarMappable(norm, _COLORS), ax=made, ticks=MaxNLocator(4), pad=0.01, aspect=15)
    bar.set_label("3D error (mm)", fontsize=8)
    thinned = ", not all drawn" if max(map(len, slices)) > MOST_ARROWS else ""
    part.suptitle(short(row.title, 60), x=0.01, ha="left", weight="bold", fontsize=8.5)
    note = f"x (mm); arrows: errors in x, y × {factor:g}{thinned}"
    part.supxlabel(note, color=QUIET, fontsize=8)


def _draw_slice(ax: Axes, row: FieldRow, chosen: Numbers, factor: float, norm: Normalize) -> None:
    chosen = chosen[:: ceil(len(chosen) / MOST_ARROWS)]
    x, y, _ = row.true[chosen].T
    u, v, _ = factor * row.error[chosen].T
    length = np.linalg.norm(row.error[chosen], axis=1)
    colors: dict[str, Any] = {"cmap": _COLORS, "norm": norm}
    ax.quiver(
        x, y, u, v, length, angles="xy", scale_units="xy", scale=1.0, width=0.012, zorder=3, **colors
    )  # fmt: skip
    ax.scatter(x, y, c=length, s=9, linewidths=0.0, zorder=2, **colors)


def _slices(height: Floats) -> list[Numbers]:
    """Return the points at each height z, or in five slabs of equal thickness if there are more heights."""
    levels = np.unique(np.round(height, 2))
    if len(levels) <= MOST_SLICES:
        near = np.argmin(np.abs(height[:, None] - levels), axis=1)
    else:
        edges = np.linspace(height.min(), height.max(), MOST_SLICES + 1)[1:-1]
        near = np.searchsorted(edges, height, side="right")
    return [np.flatnonzero(near == k) for k in np.unique(near)]


def _level(height: Floats) -> str:
    low, high = float(height.min()), float(height.max())
    if high - low < 0.01:
        return f"z = {format_signed(low, '.4g')} mm"
    return f"z = {format_signed(low, '.3g')} to {format_signed(high, '.3g')} mm"


def _factor(row: FieldRow, in_slice: int) -> float:
    """Return the scale of the arrows, 1, 2 or 5 times a power of ten: their 95th percentile is at most a grid step."""
    step = float(np.ptp(row.true[:, :2], axis=0).max()) / max(1.0, np.sqrt(in_slice) - 1.0)
    typical = float(np.quantile(np.linalg.norm(row.error, axis=1), 0.95))
    if not (step > 0.0 and typical > 0.0):
        return 1.0
    most = step / typical
    decade = 10.0 ** np.floor(np.log10(most))
    return float(decade * max(digit for digit in (1.0, 2.0, 5.0) if digit * decade <= most * (1.0 + 1e-9)))


def _frame(true: Floats) -> tuple[float, float, float, float]:
    """Return the limits of a square around all points, with a margin."""
    low, high = true[:, :2].min(axis=0), true[:, :2].max(axis=0)
    middle, half = (low + high) / 2.0, 0.68 * float((high - low).max() or 1.0)
    return middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half
