"""The figure of a registration: fiducials with their residuals, and the expected error."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from flexneedle.figures.style import ESTIMATE, INK, QUIET, apply_style, new_figure

Floats = NDArray[np.float64]

_HEIGHT = 3.9  # inches
_ARROW = 0.15  # length of the longest residual, as a share of the panel
_VIEWS = ((0, 1, "x (mm)", "y (mm)"), (0, 2, "x (mm)", "z (mm)"))


def draw_registration(
    stage: Floats, mapped: Floats, targets: Floats, expected: Callable[[Floats], Floats]
) -> Figure:
    """Draw fiducials (n, 3), arrows along their residuals to the positions `mapped` (n, 3), and targets (k, 3); mm.

    expected: RMS target registration error (mm) at points (m, 3), drawn as contours in planes through the centroid.
    """
    with apply_style():
        figure = new_figure(_HEIGHT)
        low, high = _extent(np.vstack([stage, targets]))
        longest = float(np.linalg.norm(mapped - stage, axis=1).max())
        scale = _round(_ARROW * float((high - low).max()) / longest) if longest > 0.0 else 1.0
        levels = _levels(expected, low, high, stage.mean(axis=0))
        panels = figure.subplots(1, len(_VIEWS))
        for ax, view in zip(panels, _VIEWS, strict=True):
            shown = _view(ax, view, stage, mapped, targets, scale, (low, high))
            filled = _field(ax, view, expected, (low, high), stage.mean(axis=0), levels)
            ax.set_title(shown)
        figure.colorbar(filled, ax=panels, label="expected error (TRE, mm)")
        note = f"○ fiducial   → residual × {scale:g}   × target"
        figure.supxlabel(note, color=QUIET, fontsize=8)
    return figure


def _view(
    ax: Axes,
    view: tuple[int, int, str, str],
    stage: Floats,
    mapped: Floats,
    targets: Floats,
    scale: float,
    box: tuple[Floats, Floats],
) -> str:
    i, j, across, up = view
    off = scale * (mapped - stage)
    ax.quiver(
        stage[:, i], stage[:, j], off[:, i], off[:, j],
        angles="xy", scale_units="xy", scale=1, color=ESTIMATE, width=0.006, zorder=3,
    )  # fmt: skip
    ax.plot(stage[:, i], stage[:, j], "o", mfc="white", mec=INK, ms=5, zorder=2)
    ax.plot(targets[:, i], targets[:, j], "x", color=INK, ms=7, mew=1.6, zorder=4)
    ax.set(xlim=(box[0][i], box[1][i]), ylim=(box[0][j], box[1][j]), xlabel=across, ylabel=up)
    ax.set_aspect("equal", adjustable="box")
    return f"{across[0]}–{up[0]}"


def _field(
    ax: Axes,
    view: tuple[int, int, str, str],
    expected: Callable[[Floats], Floats],
    box: tuple[Floats, Floats],
    middle: Floats,
    levels: Floats,
) -> QuadContourSet:
    i, j = view[:2]
    across, up = (np.linspace(box[0][k], box[1][k], 80) for k in (i, j))
    points = np.tile(middle, (across.size * up.size, 1))
    points[:, i], points[:, j] = (grid.ravel() for grid in np.meshgrid(across, up))
    values = expected(points).reshape(up.size, across.size)
    return ax.contourf(across, up, values, levels=levels, cmap="Greys", alpha=0.45, extend="max", zorder=0)


def _levels(expected: Callable[[Floats], Floats], low: Floats, high: Floats, middle: Floats) -> Floats:
    corners = np.array([[(low, high)[k >> d & 1][d] for d in range(3)] for k in range(8)])
    most, least = float(expected(corners).max()), float(expected(middle[None])[0])
    levels: Floats = np.asarray(MaxNLocator(8).tick_values(least, max(most, least + 1e-6)))
    return levels


def _extent(points: Floats) -> tuple[Floats, Floats]:
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.18 * max(float((high - low).max()), 1.0)
    return low - room, high + room


def _round(factor: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `factor`; at least 1."""
    power = 10.0 ** np.floor(np.log10(factor))
    return max(1.0, float(power * max(digit for digit in (1, 2, 5) if digit * power <= factor)))
