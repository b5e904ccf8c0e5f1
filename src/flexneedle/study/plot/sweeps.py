"""The true error along an axis of a study: median with the middle half, and mean, for each controller."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.plot.layout import FAINT, OVERLAID, Floats, Look, Panels, decades, head, legend, panels, short
from flexneedle.plot.style import BAD, INK, styled

_FIRST, _THIRD = partial(np.quantile, q=0.25), partial(np.quantile, q=0.75)
_WIDE = 20.0  # times between the smallest and the largest median or mean: from there on, decades


@dataclass(frozen=True, eq=False)
class Sweep:
    """True errors of one controller along an axis: for each of its m levels an array (mm) of the finished ones.

    counts (m,): insertions in all.
    """

    name: str
    look: Look
    errors: Sequence[Floats]
    counts: Sequence[int]


def sweep_figure(sweeps: Sequence[Sweep], label: str, places: Floats, names: Sequence[str]) -> Figure:
    """Return the figure along an axis with levels at `places` (m,) called `names`."""
    groups = [list(sweeps)] if len(sweeps) <= OVERLAID else [[sweep] for sweep in sweeps]
    with styled():
        made = panels(len(groups), 0.42, title=0.36) if len(groups) == 1 else panels(len(groups), 0.7)
        for ax, group in zip(made.axes, groups, strict=True):
            for other in sweeps if len(groups) > 1 else ():
                ax.plot(places, _each(other, np.median), color=FAINT, linewidth=1.0, zorder=1, label="others")
            for sweep in group:
                _draw(ax, sweep, places)
            if len(groups) > 1:
                head(
                    ax,
                    group[0].name,
                    f"n = {sum(group[0].counts)}",
                    group[0].look.color,
                    _unfinished(group[0]),
                )
        _scale(made, sweeps, places, names, label)
        if len(groups) == 1:
            _say_unfinished(made.axes[0], sweeps, places)
        legend(made.figure, _handles(sweeps if len(groups) == 1 else ()))
    return made.figure


def _draw(ax: Axes, sweep: Sweep, places: Floats) -> None:
    color, marker = sweep.look.color, sweep.look.marker
    low, high = _each(sweep, _FIRST), _each(sweep, _THIRD)
    ax.fill_between(places, low, high, color=color, alpha=0.16, linewidth=0.0, zorder=2)
    middle, average = _each(sweep, np.median), _each(sweep, np.mean)
    ax.plot(places, middle, color=color, marker=marker, markersize=5, zorder=4, label="median")
    ax.plot(places, average, color=color, linestyle=(0, (4, 2)), linewidth=1.2, zorder=3, label="mean")


def _each(sweep: Sweep, statistic: Callable[[Floats], object]) -> Floats:
    return np.array([statistic(errors) if len(errors) else np.nan for errors in sweep.errors], dtype=float)


def _scale(made: Panels, sweeps: Sequence[Sweep], places: Floats, names: Sequence[str], label: str) -> None:
    shown = [_each(sweep, statistic) for sweep in sweeps for statistic in (np.median, np.mean)]
    band = [_each(sweep, statistic) for sweep in sweeps for statistic in (_FIRST, _THIRD)]
    values = np.concatenate(shown)
    values = values[values > 0.0]
    pad = 0.05 * (float(places.max() - places.min()) or 1.0)
    for ax in made.axes:
        if len(values) and values.max() > _WIDE * values.min():
            decades(ax.yaxis, [*shown, *band], 6)
        else:
            ax.set_ylim(0.0, 1.08 * float(np.nanmax(np.concatenate([*shown, *band, np.array([1e-6])]))))
        ax.set_xlim(places.min() - pad, places.max() + pad)
        _name_levels(ax, places, names)
        ax.grid(axis="y", color=FAINT, linewidth=0.4)
        ax.set_axisbelow(True)
        ax.tick_params(labelleft=ax in made.leftmost, labelbottom=ax in made.lowest)
    for ax in made.lowest:
        ax.set_xlabel(short(label, 60), labelpad=1.0)
    for ax in made.leftmost:
        ax.set_ylabel("true error (mm)")


def _name_levels(ax: Axes, places: Floats, names: Sequence[str]) -> None:
    """Put a tick at each level that has room for its name."""
    low, high = ax.get_xlim()
    inches = float(ax.bbox.width) / float(ax.figure.dpi) / (high - low)
    kept: list[int] = []
    for k, place in enumerate(places.tolist()):
        room = 0.07 * (len(names[k]) + len(names[kept[-1]])) / 2 + 0.08 if kept else 0.0
        if not kept or (place - float(places[kept[-1]])) * inches > room:
            kept.append(k)
    ax.set_xticks([float(places[k]) for k in kept], [names[k] for k in kept])


def _unfinished(sweep: Sweep) -> str:
    missing = sum(sweep.counts) - sum(map(len, sweep.errors))
    return f"{missing} not finished" if missing else ""


def _say_unfinished(ax: Axes, sweeps: Sequence[Sweep], places: Floats) -> None:
    """Write above each level how many did not finish, where any did not."""
    missing = [sum(s.counts[k] - len(s.errors[k]) for s in sweeps) for k in range(len(places))]
    if not any(missing):
        return
    inch = float(ax.figure.dpi) / float(ax.bbox.height)
    look: dict[str, Any] = {"color": BAD, "fontsize": 7.5}
    ax.text(0.0, 1.0 + 0.16 * inch, "not finished:", transform=ax.transAxes, **look)
    for place, count in zip(places.tolist(), missing, strict=True):
        if count:
            above = ax.get_xaxis_transform()
            ax.text(place, 1.0 + 0.02 * inch, str(count), transform=above, ha="center", **look)


def _handles(named: Sequence[Sweep]) -> list[Line2D]:
    names = [
        Line2D([], [], color=s.look.color, marker=s.look.marker, markersize=5, label=short(s.name, 30))
        for s in named
    ]
    return [
        *names,
        Line2D([], [], color=INK, label="median"),
        Line2D([], [], color=INK, alpha=0.16, linewidth=6.0, label="middle half"),
        Line2D([], [], color=INK, linestyle=(0, (4, 2)), linewidth=1.2, label="mean"),
        *([] if named else [Line2D([], [], color=FAINT, linewidth=1.0, label="medians of the others")]),
    ]
