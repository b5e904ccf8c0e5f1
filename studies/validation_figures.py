"""The figures of docs/validation.md: cantilevers, the distance from the model, and refinement."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import validation_results as results
from flexneedle.figures import style
from reference import elastica
from reference import validation as problems

COLOURS = (style.ESTIMATE, style.TRUE, style.TARGET, style.MEASURED)
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MARKS = ("o", "s", "^", "D")


def draw(found: results.Found, folder: Path) -> list[Path]:
    """Draw the three figures as PNG and SVG."""
    paths = []
    for name, draw_one in (("needle", draw_needle), ("model", draw_model), ("insertion", draw_insertion)):
        with style.apply_style():
            figure = style.new_figure(3.3)
            draw_one(*figure.subplots(1, 2), found)
            paths += style.save(figure, folder, f"validation-{name}")
    return paths


def set_logarithmic(ax: Any, title: str, x: str, y: str) -> None:
    """Set logarithmic scales, title and labels."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(lambda value, _: "10" + f"{round(np.log10(value))}".translate(RAISED))
    ax.set_title(title)
    ax.set_xlabel(x)
    ax.set_ylabel(y)


def guide_line(ax: Any, x: Sequence[float], start: float, slope: float, label: str) -> None:
    """Draw a power law through (x[0], start)."""
    ends = np.array([x[0], x[-1]])
    ax.plot(
        ends, start * (ends / ends[0]) ** slope, "--", color=style.QUIET, linewidth=1.0, label=label, zorder=1
    )


def series(
    ax: Any, k: int, x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray, label: str
) -> None:
    """Draw one of several lines."""
    ax.plot(x, y, MARKS[k] + "-", color=COLOURS[k], markersize=3.5, linewidth=1.1, label=label)


def draw_needle(ax: Any, errors: Any, found: results.Found) -> None:
    """Draw bent cantilevers and their errors."""
    set_logarithmic(errors, "Tip error", "number of segments", "tip error / L")
    for k, (load, nodes) in enumerate(found.shapes.items()):
        ax.plot(*nodes.T, color=COLOURS[k], label=f"PL²/EI = {load:g}")
        ax.plot(*elastica.cantilever(load)[:2], MARKS[k], color=style.INK, markersize=5, fillstyle="none")
        distance = np.hypot(*found.cantilever[load][:, :2].T)
        series(errors, k, results.SEGMENTS, distance, f"PL²/EI = {load:g}")
    guide_line(errors, results.SEGMENTS, 2.0 * distance[0], -2.0, "second order")
    errors.set_xticks(results.SEGMENTS, [str(n) for n in results.SEGMENTS])
    errors.minorticks_off()
    ax.set_title("Cantilevers (markers: elastica)")
    ax.set_xlabel("x/L")
    ax.set_ylabel("y/L")
    ax.set_aspect("equal", adjustable="box")
    ax.legend(loc="upper left")
    errors.legend(loc="lower left")


def draw_model(one: Any, two: Any, found: results.Found) -> None:
    """Draw the distance between the formulations over the slope, for one and two layers."""
    for ax, layers, title in ((one, 1, "Exact plant and model, one layer"), (two, 2, "Two layers")):
        set_logarithmic(ax, title, "largest slope of the tip (rad)", "")
        for k, (h, found_gaps) in enumerate(found.gaps[layers].items()):
            angle, lateral = np.array([(gap.angle, gap.lateral) for gap in found_gaps]).T
            series(ax, k, angle, lateral, f"segments of {h:g} mm")
        middle = len(results.SCALES) // 2
        start = lateral[middle] * (angle[0] / angle[middle]) ** 3
        guide_line(ax, angle, start, 3.0, "third power")
        ax.set_ylim(1e-6, 1.0)
        ax.set_xticks([0.005, 0.01, 0.02, 0.05, 0.1], ["0.005", "0.01", "0.02", "0.05", "0.1"])
        ax.minorticks_off()
    one.set_ylabel("largest distance between the tips (mm)")
    one.legend(loc="upper left")


def draw_insertion(ax: Any, other: Any, found: results.Found) -> None:
    """Draw the refinement and the comparison with the second solver."""
    set_logarithmic(ax, "Refinement", "size / default size", "tip error against the finest (mm)")
    for k, (name, errors) in enumerate(found.refined.items()):
        shipped = problems.SHIPPED[name]
        series(ax, k, results.SIZES[name][:-1] / shipped, errors, f"{name} (default: {shipped:g} mm)")
    first = found.refined["element"][0]
    guide_line(ax, (4.0, 0.25), 2.0 * first, 2.0, "second order")
    ax.set_xticks([0.25, 0.5, 1, 2, 4], ["¼", "½", "1", "2", "4"])
    set_logarithmic(other, "Second solver", "segment length (mm)", "largest tip difference")
    for k, name in enumerate(("x (mm)", "y (mm)", "θ (rad)")):
        series(other, k, results.ELEMENTS, found.second[:, k], name)
    guide_line(other, results.ELEMENTS, 2.0 * found.second[0, 1], 2.0, "second order")
    other.set_xticks(results.ELEMENTS, [f"{h:g}" for h in results.ELEMENTS])
    for one in (ax, other):
        one.minorticks_off()
        one.legend(loc="lower right")
