"""The figures of a report: a table of entries, each with condition, caption and drawing function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flexneedle.figures.layout import Floats, Look, look
from flexneedle.figures.style import INK, save
from flexneedle.lab.html.page import ReportFigure
from flexneedle.lab.study.figures.comparison import DifferenceRow, draw_differences
from flexneedle.lab.study.figures.distributions import draw_errors
from flexneedle.lab.study.figures.front import FrontSample, draw_front
from flexneedle.lab.study.figures.panels import MOST_PANELS, Panel
from flexneedle.lab.study.figures.samples import ErrorSample
from flexneedle.lab.study.figures.shares import draw_shares
from flexneedle.lab.study.figures.sweeps import draw_sweep
from flexneedle.lab.study.figures.targeting import TipPositions, draw_targeting
from flexneedle.lab.study.findings.design import Factor, list_controllers
from flexneedle.lab.study.findings.findings import Findings
from flexneedle.lab.study.findings.groups import Difference, find_finished, find_loads, group_depths
from flexneedle.lab.study.findings.rows import TARGET_COLUMNS, Flags
from flexneedle.lab.study.findings.worlds import find_failures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_LEVELS = 40  # of an axis in a figure
_LOGARITHMIC = "Errors are on a logarithmic scale."


@dataclass(frozen=True, eq=False)
class _Entry:
    """A possible figure of a report: contents of its panels and drawing function."""

    name: str
    title: str
    applies: bool
    caption: str
    panels: Callable[[], Sequence[Panel[Any]]]
    draw: Callable[[Sequence[Panel[Any]]], Figure]


@dataclass(frozen=True, eq=False)
class _Facts:
    """Data of all figures; `known`: finished rows (n,) with a known true error."""

    found: Findings
    looks: Sequence[Look]
    error: Floats
    done: Flags
    known: Flags

    @property
    def controllers(self) -> list[tuple[str, Flags, Look]]:
        """Name, rows (n,), color and marker of each controller."""
        factor = self.found.design.controller
        own = [factor.codes == k for k in range(len(factor.names))]
        return list(zip(factor.names, own, self.looks, strict=True))

    @property
    def panel_factor(self) -> Factor:
        """Factor with one panel per level: controllers, or for a single one the first other factor of few levels."""
        controller, *others = self.found.design.factors
        few = [factor for factor in others if len(factor.names) <= MOST_PANELS]
        return controller if controller.varies or not few else few[0]

    def name_pooled(self, *shown: Factor) -> str:
        """Return the pooled factors as text: all but the controller and the shown ones."""
        labels = [factor.label for factor in self.found.design.besides(self.found.design.controller, *shown)]
        return f", pooled over {_list(labels)}" if labels else ""

    def sample(self, name: str, own: Flags, look: Look) -> ErrorSample:
        """Return the errors of some of the rows (n,)."""
        return ErrorSample(name, look, self.error[own & self.known], int(own.sum()))

    def panels(self, content: Callable[[Flags, Look], Any]) -> list[Panel[Any]]:
        """Return a panel of `content` for each level of `panel_factor`."""
        factor = self.panel_factor
        looks = self.looks if factor is self.found.design.controller else [self.looks[0]] * len(factor.names)
        own = [factor.codes == k for k in range(min(len(factor.names), MOST_PANELS))]
        return [
            Panel(title, self.note(rows), look.color, content(rows, look), self.alarm(rows))
            for title, rows, look in zip(factor.titles, own, looks, strict=False)
        ]

    def note(self, own: Flags) -> str:
        """Return mean, 95 % and maximum of rows (n,) in one short line."""
        errors = self.error[own & self.known]
        if len(errors) == 0:
            return f"n = {int(own.sum())}"
        return f"mean {errors.mean():.3f}, 95 % {np.quantile(errors, 0.95):.3f}, max {errors.max():.3f} mm"

    def alarm(self, own: Flags) -> str:
        """Return the number of rows (n,) that did not finish as text, or ""."""
        missing = int((own & ~self.done).sum())
        return f"{missing} not finished" if missing else ""


def draw_figures(found: Findings, folder: Path) -> list[ReportFigure]:
    """Draw all applicable figures to a folder, PNG and SVG each, and return them in reading order."""
    drawn = []
    for entry in _list_entries(_collect_facts(found)):
        if entry.applies:
            shown = entry.panels()
            png, svg = save(entry.draw(shown), folder, entry.name)
            notes = "; ".join(f"{panel.title}: {panel.note}" for panel in shown if panel.note)
            alt = f"{entry.title}. {entry.caption} {notes}".strip()
            drawn.append(ReportFigure(entry.name, entry.title, entry.caption, alt, png, svg))
    return drawn


def _collect_facts(found: Findings) -> _Facts:
    rows, names = found.study.rows, found.design.controller.names
    order = [*list_controllers(), *sorted(set(names) - set(list_controllers()))]
    error, done = rows.number("true_error_mm"), find_finished(rows)
    looks = [look(order.index(name)) for name in names]
    return _Facts(found, looks, error, done, done & ~np.isnan(error))


def _list_entries(f: _Facts) -> list[_Entry]:
    """Return all figures in reading order."""
    found, any_known, ours = f.found, bool(f.known.any()), f.found.design.controller.names[0]
    rows = found.study.rows
    depth = group_depths(rows)
    return [
        _Entry(
            "shares", "True error in worlds", bool(found.worlds) and any_known,
            "Cumulative share of insertions by true error. A line that ends below 100 % lacks the failures. "
            f"{_LOGARITHMIC}",
            partial(_shares, f), draw_shares,
        ),
        _Entry(
            "front", "True error against tissue energy", found.design.controller.varies and _has_peaks(f),
            "Every finished insertion is a dot; medians with quartiles. Energy: largest value on the path, relative to "
            "the energy of all tissue down to the target displaced by 1 mm.",
            partial(_front, f), draw_front,
        ),
        _Entry(
            "targeting", "Final tip positions", not found.worlds and not np.isnan(rows.number("tip_x_mm")).all(),
            "True tips of all insertions, and targets with circles of 1 mm radius, to scale.",
            partial(_tips, f), draw_targeting,
        ),
        _Entry(
            "errors-by-depth", "True error by target depth",
            any_known, f"Every finished insertion is a dot{f.name_pooled(f.panel_factor)}. {_LOGARITHMIC}",
            partial(_by_depth, f, depth), partial(draw_errors, label=depth.label if depth.varies else ""),
        ),
        *(_make_axis_entry(f, axis, number) for number, axis in enumerate(found.design.axes, 1)),
        _Entry(
            "controllers", f"{ours} against the other controllers", _has_means(found.against),
            f"Mean paired difference of the true error: {ours} minus the other, on the same phantoms and targets.",
            partial(_against, f), partial(draw_differences, label="difference of the true error (mm)"),
        ),
        _Entry(
            "cases", f"Cases against the base case, {found.design.cases.names[0]}", _has_means(found.cases),
            "Mean paired difference of the true error: the case minus the base case, on the same phantoms and targets; "
            "largest first.",
            partial(_cases, f), partial(draw_differences, label="increase of the true error (mm)"),
        ),
    ]  # fmt: skip


def _make_axis_entry(f: _Facts, axis: Factor, number: int) -> _Entry:
    """Return the figure of the true error along an axis."""
    covaried = f" Also varied along the axis: {_list(axis.covaried)}." if axis.covaried else ""

    def panels() -> list[Panel[Any]]:
        levels = [(name, axis.codes == k) for k, name in enumerate(axis.names)]
        return [
            Panel(
                title,
                f"n = {int(own.sum())}",
                look.color,
                [f.sample(name, own & level, look) for name, level in levels],
                f.alarm(own),
            )
            for title, own, look in f.controllers[:MOST_PANELS]
        ]

    return _Entry(
        f"error-along-{number}",
        f"True error against {axis.label}",
        bool(f.known.any()) and len(axis.names) <= _MOST_LEVELS,
        f"Median, interquartile range (25 to 75 %) and mean of the finished insertions{f.name_pooled(axis)}.{covaried}",
        panels,
        partial(draw_sweep, label=axis.label, places=axis.positions),
    )


def _shares(f: _Facts) -> list[Panel[Any]]:
    rows, cases = f.found.study.rows, f.found.design.cases
    counted, world = f.done | find_failures(rows), rows.number("world")
    panels = []
    for level, title in enumerate(cases.names[:MOST_PANELS]):
        own = (cases.codes == level) & counted
        samples = [
            f.sample(name, own & theirs, look) for name, theirs, look in f.controllers if (own & theirs).any()
        ]
        note = f"{len(np.unique(world[cases.codes == level]))} worlds"
        panels.append(Panel(title or "all", note, INK, samples))
    return panels


def _find_peaks(f: _Facts) -> Floats:
    """Return the peak of the energy relative to E₁ (n,), NaN where it or the error is unknown."""
    return np.where(f.known, find_loads(f.found.study.rows)["peak_energy_relative"], nan)


def _has_peaks(f: _Facts) -> bool:
    return not np.isnan(_find_peaks(f)).all()


def _front(f: _Facts) -> list[Panel[Any]]:
    peaks, cases = _find_peaks(f), f.found.design.cases
    known, panels = ~np.isnan(peaks), []
    for level, title in enumerate(cases.names[:MOST_PANELS]):
        own = (cases.codes == level) & known
        samples = [
            FrontSample(name, look, f.error[own & theirs], peaks[own & theirs])
            for name, theirs, look in f.controllers
            if (own & theirs).any()
        ]
        panels.append(Panel(title or "all", f"{int(own.sum())} insertions", INK, samples))
    return panels


def _tips(f: _Facts) -> list[Panel[Any]]:
    rows = f.found.study.rows
    targets, tips = (
        np.stack([rows.number(name) for name in names], axis=1)
        for names in (TARGET_COLUMNS[:2], ("tip_x_mm", "tip_y_mm"))
    )
    return f.panels(lambda own, _: TipPositions(targets[own], tips[own], f.done[own]))


def _by_depth(f: _Facts, depth: Factor) -> list[Panel[Any]]:
    levels = [(name, depth.codes == k) for k, name in enumerate(depth.names)] if depth.varies else []
    every = np.ones(len(f.done), dtype=bool)
    return f.panels(
        lambda own, look: [f.sample(name, own & level, look) for name, level in [("all", every), *levels]]
    )


def _against(f: _Facts) -> list[Panel[Any]]:
    names = f.found.design.controller.names
    rows = [_make_row(d.against, f.looks[names.index(d.against)], d) for d in f.found.against]
    return [
        Panel(
            f"{names[0]} minus each other controller", "left of zero: smaller errors", f.looks[0].color, rows
        )
    ]


def _cases(f: _Facts) -> list[Panel[Any]]:
    differences, cases = f.found.cases, f.found.design.cases
    first = [d for d in differences if d.controller == f.controllers[0][0]]
    order = [d.name for d in sorted(first, key=lambda d: inf if isnan(d.mean_mm.value) else -d.mean_mm.value)]
    panels = []
    for name, own, mark in f.controllers[:MOST_PANELS]:
        of_case = {d.name: d for d in differences if d.controller == name}
        rows = [_make_row(case, mark, of_case[case]) for case in order]
        panels.append(Panel(name, f"base case: {f.note(own & (cases.codes == 0))}", mark.color, rows))
    return panels


def _make_row(name: str, look: Look, found: Difference) -> DifferenceRow:
    return DifferenceRow(name, look, found.mean_mm.value, found.mean_mm.low, found.mean_mm.high)


def _has_means(differences: Sequence[Difference]) -> bool:
    return any(not isnan(found.mean_mm.value) for found in differences)


def _list(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
