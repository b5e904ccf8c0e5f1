"""The error field: slices of the volume, an arrow from each grid point along its error."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flexneedle.plot.layout import short
from flexneedle.plot.style import QUIET, WIDTH, axes, new_figure, signed, styled

MOST_ROWS, MOST_SLICES = 6, 5
MOST_ARROWS = 400
"""In a slice; of more, every k-th is drawn, and that is said."""
_LEFT, _RIGHT, _GAP, _TITLE, _FOOT = 0.6, 1.0, 0.14, 0.68, 0.42  # inches
_COLORS = "viridis_r"

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FieldRow:
    """A sensor in an environment: true positions (n, 3) and error vectors (n, 3) of its grid points, mm."""

    title: str
    true: Floats
    error: Floats


def field_figure(rows: Sequence[FieldRow]) -> Figure:
    """Return the figure: a row of slices (x, y at heights z) for each of up to six sensors and environments."""
    shown = rows[:MOST_ROWS]
    layers = [_slices(row.true[:, 2]) for row in shown]
    columns = max(map(len, layers))
    across = 2 if columns == 1 and len(shown) > 1 else 1  # planes, two side by side
    share = WIDTH / across
    width = min((share - _LEFT - _RIGHT - (columns - 1) * _GAP) / columns, 3.0)
    with styled():
        figure = new_figure(-(-len(shown) // across) * (width + _TITLE) + _FOOT)
        for number, (row, slices) in enumerate(zip(shown, layers, strict=True)):
            down, right = divmod(number, across)
            top, left = _TITLE + down * (width + _TITLE), _LEFT + right * share
            made = [axes(figure, left + k * (width + _GAP), top, width, width) for k in range(len(slices))]
            _draw_row(made, row, slices)
            side = axes(figure, left + len(slices) * (width + _GAP), top, 0.1, width)
            _draw_scale(figure, side, row)
            below = shown[number + across] if number + across < len(shown) else None
            _label_x(made, below is None or _frame(below.true) != _frame(row.true), below is None)
        if len(rows) > MOST_ROWS:
            figure.text(
                0.99, 0.005, f"{len(rows) - MOST_ROWS} more not shown", ha="right", color=QUIET, fontsize=8
            )
    return figure


def _label_x(made: Sequence[Axes], numbers: bool, name: bool) -> None:
    for ax in made:
        ax.tick_params(labelbottom=numbers)
        if name:
            ax.set_xlabel("x (mm)", labelpad=1.0)


def _draw_row(made: Sequence[Axes], row: FieldRow, slices: Sequence[NDArray[np.int64]]) -> None:
    length = np.linalg.norm(row.error, axis=1)
    factor = _factor(row, max(map(len, slices)))
    left, right, bottom, top = _frame(row.true)
    for ax, chosen in zip(made, slices, strict=True):
        _draw_slice(ax, row, chosen, length, factor)
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        ax.set_aspect("equal", adjustable="box")
        ax.tick_params(labelleft=ax is made[0])
        ax.locator_params(nbins=4)
        ax.text(0.0, 1.02, _level(row.true[chosen, 2]), transform=ax.transAxes, color=QUIET, fontsize=8)
    made[0].set_ylabel("y (mm)")
    thinned = max(map(len, slices)) > MOST_ARROWS
    told = f"arrows {factor:g} times as long as the errors in x, y" + (
        ", not every one drawn" if thinned else ""
    )
    wide = len(made) > 2  # else one above the other
    how: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    made[0].annotate(short(row.title, 60), (0, 1), (0, 19 if wide else 31), weight="bold", **how)
    place, side = (made[-1], 1) if wide else (made[0], 0)
    place.annotate(told, (side, 1), (0, 19), color=QUIET, ha="right" if wide else "left", fontsize=7.5, **how)


def _draw_slice(ax: Axes, row: FieldRow, chosen: NDArray[np.int64], length: Floats, factor: float) -> None:
    chosen = chosen[:: -(-len(chosen) // MOST_ARROWS) or 1]
    x, y, _ = row.true[chosen].T
    u, v, _ = factor * row.error[chosen].T
    how: dict[str, Any] = {"cmap": _COLORS, "norm": Normalize(0.0, float(length.max()) or 1.0)}
    ax.quiver(
        x,
        y,
        u,
        v,
        length[chosen],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.012,
        zorder=3,
        **how,
    )
    ax.scatter(x, y, c=length[chosen], s=9, linewidths=0.0, zorder=2, **how)


def _draw_scale(figure: Figure, ax: Axes, row: FieldRow) -> None:
    most = float(np.linalg.norm(row.error, axis=1).max()) or 1.0
    mapped = matplotlib.cm.ScalarMappable(Normalize(0.0, most), _COLORS)
    bar = figure.colorbar(mapped, cax=ax)
    bar.set_label("error, x, y, z (mm)", fontsize=8)
    bar.locator = matplotlib.ticker.MaxNLocator(4)
    bar.update_ticks()


def _slices(height: Floats) -> list[NDArray[np.int64]]:
    """Return the points at each height z, or in five slabs of equal depth where there are more heights than that."""
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
        return f"z = {signed(low, '.4g')} mm"
    return f"z = {signed(low, '.3g')} to {signed(high, '.3g')} mm"


def _factor(row: FieldRow, in_slice: int) -> float:
    """Return how much longer to draw: 1, 2 or 5 times a power of ten.

    The 95th percentile is at most as long as a grid step, and at least 95 % of the arrows end inside the frame; the
    others are cut at its edge.
    """
    step = float(np.ptp(row.true[:, :2], axis=0).max()) / max(1.0, np.sqrt(in_slice) - 1.0)
    typical = float(np.quantile(np.linalg.norm(row.error, axis=1), 0.95))
    if not (step > 0.0 and typical > 0.0):
        return 1.0
    most = min(step / typical, float(np.quantile(_room(row), 0.05, method="inverted_cdf")))
    decade = 10.0 ** np.floor(np.log10(most))
    return float(decade * max(digit for digit in (1.0, 2.0, 5.0) if digit * decade <= most * (1.0 + 1e-9)))


def _room(row: FieldRow) -> Floats:
    """Return by how much each arrow (n,) could be lengthened before it leaves the frame."""
    left, right, bottom, top = _frame(row.true)
    place, error = row.true[:, :2], row.error[:, :2]
    ends = np.where(error > 0.0, np.array([right, top]), np.array([left, bottom]))
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(error != 0.0, (ends - place) / error, np.inf)
    room: Floats = times.min(axis=1)
    return room


def _frame(true: Floats) -> tuple[float, float, float, float]:
    """Return the limits of a square around all points, with a margin."""
    low, high = true[:, :2].min(axis=0), true[:, :2].max(axis=0)
    middle, half = (low + high) / 2.0, 0.68 * float((high - low).max() or 1.0)
    return middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half
