"""Figures of a validation: errors by distance, coverage, errors by depth and order, paths, response to the guide."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from flexneedle.figures.layout import Look, fit, legend_of, look, mosaic, short
from flexneedle.figures.style import ESTIMATE, INK, NEEDLE, QUIET, TRUE, apply_style, is_column, new_figure
from flexneedle.lab.calibration.baselines import REGRESSION
from flexneedle.lab.calibration.comparison import MODEL, WIDTH, Errors, Tested
from flexneedle.lab.calibration.importing.picture import GUIDE_STYLES
from flexneedle.lab.calibration.validation_report.response import responses
from flexneedle.lab.calibration.verdicts import NAMES, depth_limits, groups_of, row_of

if TYPE_CHECKING:
    from flexneedle.lab.calibration.validation import Validation

_FAINT = "#c9cbd0"
_RIGHT = 90.0, 98.0  # %, of a coverage
_BINS = 6
_LEAST_RESPONSES = 3
_SHARES = 0.1, 0.5  # depths from which paths are predicted, of the deepest
_RANKS = {0.25: "small error", 0.5: "median error", 0.9: "large error"}
_DECADES = 200.0  # range of errors up to which the axis has marks between decades


def draw_overview(found: "Validation") -> Figure:
    """Return the figure of errors by distance, coverage, and errors by depth and order."""
    errors = {ahead: _shown(each) for ahead, each in found.errors.items()}
    kind = "guided predictions" if any(each.guided.any() for each in errors.values()) else "all predictions"
    middle = found.ahead[len(found.ahead) // 2]
    rows = [["errors"] * 3, ["coverage", "depth", "order"]]
    with apply_style():
        figure, axes = mosaic(f"Errors of predictions ahead: {kind}", 6.2, rows, (1.25, 1.0), (1.0, 1.0, 1.0))
        _draw_errors(axes["errors"], errors)
        _draw_coverage(axes["coverage"], found)
        _draw_trend(axes["depth"], errors[middle], errors[middle].depth, found.deepest)
        axes["depth"].set_xlabel("depth at the start (mm)")
        axes["depth"].set_title(f"{middle:g} mm ahead, by depth")
        _draw_trend(axes["order"], errors[middle], errors[middle].place, 1.0)
        axes["order"].set_xlabel("place in the session, 0 to 1")
        axes["order"].set_title(f"{middle:g} mm ahead, by order")
        legend_of(figure, [axes["errors"], axes["coverage"], axes["depth"]])
    return figure


def _shown(errors: Errors) -> Errors:
    """Return the guided predictions, all if the guide rests in all."""
    return errors.select(errors.guided) if errors.guided.any() else errors


def _look(name: str) -> Look:
    return look([*NAMES].index(name))


def _draw_errors(ax: Axes, shown: dict[float, Errors]) -> None:
    """Draw quartiles, median and 95 % of each predictor in a group for each distance."""
    step = 1.0 / (len(NAMES) + 1.5)
    for place, errors in enumerate(shown.values()):
        for k, name in enumerate(NAMES):
            x = place + (k - 0.5 * (len(NAMES) - 1)) * step
            low, middle, high, most = np.quantile(errors.size[name], (0.25, 0.5, 0.75, 0.95))
            color, half = _look(name).color, 0.3 * step
            ax.plot([x, x], [high, most], color=color, linewidth=1.0, zorder=2)
            ax.plot([x - half, x + half], [most, most], color=color, linewidth=1.4, zorder=2)
            ax.plot(
                [x, x], [low, high], color=color, linewidth=5.0, alpha=0.55, solid_capstyle="butt", zorder=3
            )
            label, mark = NAMES[name], _look(name).marker
            ax.plot(
                [x],
                [middle],
                mark,
                color=color,
                markeredgecolor="white",
                markersize=6.5,
                label=label,
                zorder=4,
            )
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    parts = (1.0, 2.0, 5.0) if high < _DECADES * low else (1.0,)
    ax.yaxis.set_major_locator(FixedLocator([part * 10.0**k for k in range(-6, 4) for part in parts]))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.grid(axis="y", color=_FAINT, linewidth=0.4)
    ax.set_axisbelow(True)
    names = [f"{ahead:g} mm ahead\n{len(errors)} predictions" for ahead, errors in shown.items()]
    ax.set_xticks(range(len(shown)), names)
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.5, len(shown) - 0.5)
    ax.set_ylabel("error (mm)")
    ax.set_title("Median (mark), quartiles (bar), 95 % (line)")


def _draw_coverage(ax: Axes, found: "Validation") -> None:
    ax.axhspan(*_RIGHT, color=_FAINT, alpha=0.45, linewidth=0.0, zorder=0)
    ax.axhline(95.0, color=QUIET, linewidth=0.8, zorder=1)
    _, deep = depth_limits(found.deepest)
    lines = {"all": ("-", QUIET), "guided": ("-", ESTIMATE), f"guided, to {deep:g} mm": ("--", TRUE)}
    lowest = 85.0
    for group, (style, color) in lines.items():
        chosen = {ahead: groups_of(each, found.deepest)[group] for ahead, each in found.errors.items()}
        known = [ahead for ahead in found.ahead if chosen[ahead].any()]
        shares = [100.0 * float(found.errors[a].inside[chosen[a]].mean()) for a in known]
        ax.plot(known, shares, style, color=color, label=f"coverage, {group}", zorder=3)
        ax.plot(known, shares, "o", color=color, markersize=4, zorder=3)
        lowest = min([lowest, *(share - 2.0 for share in shares)])
    _distances(ax, found.ahead)
    ax.set_ylim(lowest, 100.5)
    ax.set_ylabel("readings inside (%)")
    ax.set_title("Coverage of 95 % intervals")


def _distances(ax: Axes, ahead: Sequence[float]) -> None:
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(FixedLocator([*ahead]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.set_xlim(0.85 * ahead[0], ahead[-1] / 0.85)
    ax.set_xlabel("distance ahead (mm)")


def _draw_trend(ax: Axes, errors: Errors, at: Any, end: float) -> None:
    """Draw medians and 95 % over a quantity from 0 to an end, in bins, of the model and two simple predictors."""
    edges = np.linspace(0.0, end, _BINS + 1)
    bins = np.clip(np.digitize(at, edges) - 1, 0, _BINS - 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    for name in (MODEL, row_of("", 0.0, errors).best, REGRESSION):
        values = [errors.size[name][bins == k] for k in range(_BINS)]
        known = [k for k in range(_BINS) if len(values[k]) >= 5]
        shown: dict[str, Any] = {"color": _look(name).color, "zorder": 3}
        medians = [float(np.median(values[k])) for k in known]
        ax.plot(middles[known], medians, marker=_look(name).marker, markersize=5, **shown)
        label = "95 % of the errors" if name == MODEL else None
        most = [float(np.quantile(values[k], 0.95)) for k in known]
        ax.plot(middles[known], most, linestyle=":", linewidth=1.1, label=label, **shown)
    ax.set_xlim(0.0, end)
    ax.set_ylim(bottom=0.0)
    ax.grid(axis="y", color=_FAINT, linewidth=0.4)
    ax.set_ylabel("error (mm)")


def draw_paths(found: "Validation") -> Figure:
    """Return the figure of insertions, predicted and measured: a typical one, a good and a bad one."""
    chosen = dict(_choose(found))
    axes = found.tested[0].recording.axes
    with apply_style():
        figure = new_figure(1.0 + 1.9 * axes + 1.1)
        panels = figure.subplots(
            axes + 1,
            len(chosen),
            squeeze=False,
            sharex="col",
            sharey="row",
            height_ratios=[1.9] * axes + [1.0],
        )
        for column, (title, tested) in zip(panels.T, chosen.items(), strict=True):
            for axis in range(axes):
                _draw_path(column[axis], tested, axis, (found.deepest, found.ahead[-1]))
            _draw_guide(column[-1], tested)
            column[0].set_title("\n".join(short(line, fit(36)) for line in title.split("\n")))
            column[-1].set_xlabel("depth (mm)")
        for axis in range(axes):
            panels[axis, 0].set_ylabel(f"tip along {'yz'[axis]} (mm)")
        panels[-1, 0].set_ylabel("guide (mm)")
        size = 8 if is_column() else 11
        figure.suptitle("Predicted and measured paths", x=0.01, ha="left", fontsize=size, weight="bold")
        legend_of(figure, [*panels[0], panels[-1, 0]])
    return figure


def _choose(found: "Validation") -> Iterator[tuple[str, Tested]]:
    """Yield insertions by title, at ranks of the mean error of their shown predictions."""
    errors = _shown(found.errors[found.ahead[len(found.ahead) // 2]])
    numbers = np.unique(errors.insertion)
    mean = [float(errors.size[MODEL][errors.insertion == number].mean()) for number in numbers]
    order = numbers[np.argsort(mean, kind="stable")]
    for share, words in _RANKS.items():
        tested = found.tested[int(order[round(share * (len(order) - 1))])]
        session, name = tested.recording.session, tested.recording.name
        yield f"{name if session in name else f'{session} {name}'}\n{words}", tested


def _draw_path(ax: Axes, tested: Tested, axis: int, limits: tuple[float, float]) -> None:
    """Draw a path, and predictions from some steps; limits: the deepest step, and the distance ahead (mm)."""
    one, forecast, (deepest, ahead) = tested.recording, tested.forecast, limits
    ax.plot(one.depth, one.position[:, axis], "o", color=INK, markersize=3, label="measured", zorder=4)
    for k, share in enumerate(_SHARES):
        i = int(np.argmin(np.abs(one.depth - share * deepest)))
        shown = slice(i, int(np.searchsorted(one.depth, one.depth[i] + ahead, "right")) + 1)
        middle, half = forecast.position[i, shown, axis], WIDTH * forecast.sd[i, shown, axis]
        color, depth = look(k).color, one.depth[shown]
        ax.fill_between(depth, middle - half, middle + half, color=color, alpha=0.2, linewidth=0.0, zorder=1)
        ax.plot(depth, middle, color=color, label=f"predicted from {depth[0]:.0f} mm, with 95 %", zorder=3)
        ax.plot([depth[0]], [middle[0]], "o", color=color, markersize=6, markerfacecolor="white", zorder=5)
    ax.axhline(0.0, color=_FAINT, linewidth=0.6, zorder=0)


def _draw_guide(ax: Axes, tested: Tested) -> None:
    one = tested.recording
    for axis in range(one.axes):
        name = f"guide along {'yz'[axis]}"
        style, color = "--" if axis else "-", NEEDLE if axis else INK
        steps = GUIDE_STYLES[tested.guide_order]
        ax.plot(one.depth, one.guide[:, axis], drawstyle=steps, linestyle=style, color=color, label=name)
    ax.axhline(0.0, color=_FAINT, linewidth=0.6, zorder=0)


def draw_response(found: "Validation") -> Figure | None:
    """Return the figure of the slope's response to motions of the guide over depth; None with fewer than three bins."""
    shown = list(responses(found.tested, found.deepest))
    if len(shown) < _LEAST_RESPONSES:
        return None
    depth = np.array([each.depth for each in shown])
    recorded = np.array([[each.recorded, each.low, each.high] for each in shown]) * 1e3
    with apply_style():
        title = "Response of the tip's slope to a motion of the guide"
        figure, axes = mosaic(title, 3.4, [["response"]], (1.0,), (1.0,))
        ax = axes["response"]
        ax.axhline(0.0, color=_FAINT, linewidth=0.6)
        ax.vlines(
            depth, recorded[:, 1], recorded[:, 2], color=INK, linewidth=1.4, label="95 % over insertions"
        )
        ax.plot(depth, recorded[:, 0], "o", color=INK, markersize=4, label="recorded", zorder=3)
        model = [1e3 * each.model for each in shown]
        ax.plot(depth, model, "s-", color=ESTIMATE, markersize=4, label="model, same motions", zorder=2)
        ax.set_xlim(0.0, found.deepest)
        ax.set_xlabel("depth (mm)")
        ax.set_ylabel("response (mrad/mm)")
        legend_of(figure, [ax])
    return figure
