"""Which figures the rows of a study support, and what goes into them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from flexneedle.plot.layout import MOST_PANELS, Look, look
from flexneedle.plot.style import save
from flexneedle.study.plot.comparison import DifferencePanel, DifferenceRow, difference_figure
from flexneedle.study.plot.cumulative import SharePanel, ShareRow, share_figure
from flexneedle.study.plot.distributions import (
    ErrorPanel,
    ErrorRow,
    error_rows_figure,
    errors_by_level_figure,
)
from flexneedle.study.plot.energy import EnergyPanel, energy_figure
from flexneedle.study.plot.sweeps import Sweep, sweep_figure
from flexneedle.study.plot.targeting import TargetPanel, targeting_figure
from flexneedle.study.report.design import Design, Factor, controllers_in_order
from flexneedle.study.report.findings import Findings
from flexneedle.study.report.rows import Codes, Flags, Floats, Rows
from flexneedle.study.report.statistics import Estimate
from flexneedle.study.report.summary import Difference, depths, finished
from flexneedle.study.report.worlds import failures, has_worlds

_MOST_ROWS = 40  # levels of names that are still an axis


@dataclass(frozen=True)
class Drawn:
    """A figure on disk: title and what it shows, as the page says it; alt: what one sees, for who does not."""

    name: str
    title: str
    caption: str
    alt: str
    png: Path
    svg: Path


@dataclass(frozen=True, eq=False)
class _Sheet:
    name: str
    title: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


@dataclass(frozen=True, eq=False)
class _Facts:
    """What all figures are made from; `known`: rows that finished and whose true error is known."""

    rows: Rows
    design: Design
    looks: Sequence[Look]
    error: Floats
    done: Flags
    known: Flags

    def of(self, controller: int) -> Flags:
        """Return which rows a controller has."""
        return np.asarray(self.design.controller.codes == controller)

    @property
    def controllers(self) -> list[tuple[int, str]]:
        """Numbers and names of as many controllers as there are panels."""
        return list(enumerate(self.design.controller.names))[:MOST_PANELS]


def draw_figures(found: Findings, folder: Path) -> list[Drawn]:
    """Draw every figure that the rows support into a folder, PNG and SVG each, and return them in reading order."""
    rows, design, against, cases = found.study.rows, found.design, found.against, found.cases
    names = design.controller.names
    order = [*controllers_in_order(), *sorted(set(names) - set(controllers_in_order()))]
    looks = [order.index(name) for name in names]
    error, done = rows.number("true_error_mm"), finished(rows)
    facts = _Facts(rows, design, [look(k) for k in looks], error, done, done & ~np.isnan(error))
    drawn = []
    for sheet in _sheets(facts, against, cases):
        png, svg = save(sheet.draw(), folder, sheet.name)
        drawn.append(Drawn(sheet.name, sheet.title, sheet.caption, sheet.alt, png, svg))
    return drawn


def _sheets(facts: _Facts, against: Sequence[Difference], cases: Sequence[Difference]) -> Iterator[_Sheet]:
    if has_worlds(facts.rows):  # a target each: no map of them
        if facts.known.any():
            yield _shares(facts)
    elif _tips(facts).size and not np.isnan(_tips(facts)).all():
        yield _targeting(facts)
    if not facts.known.any():
        return
    if facts.design.controller.varies:
        yield _by_controller(facts)
    depth = depths(facts.rows)
    if depth.varies or not facts.design.controller.varies:
        yield _by_depth(facts, depth.codes, depth.names)
    for number, axis in enumerate(facts.design.axes):
        if len(axis.names) <= _MOST_ROWS:
            yield _along(facts, axis, number)
    if any(not isnan(d.mean_mm.value) for d in against):
        yield _against(facts, against)
    if any(not isnan(d.mean_mm.value) for d in cases):
        yield _cases(facts, cases)
    if (facts.known & (facts.rows.number("strain_energy_mj") > 0)).any():
        yield _energy(facts)


def _shares(facts: _Facts) -> _Sheet:
    failed, cases = failures(facts.rows), facts.design.cases
    panels = []
    for level, title in enumerate(cases.names[:MOST_PANELS]):
        case = cases.codes == level
        rows = [
            ShareRow(name, facts.looks[k], facts.error[own & facts.known], int((own & counted).sum()))
            for k, name in facts.controllers
            for own, counted in ((facts.of(k) & case, facts.done | failed),)
            if own.any()
        ]
        worlds = len(np.unique(facts.rows.number("world")[case]))
        panels.append(SharePanel(title or "all", f"{worlds} worlds", rows))
    return _Sheet(
        "shares",
        "True error in worlds",
        "Share of the insertions that end nearer to their target than an error. A line that ends below 100 % is short "
        "of failures. Errors are on a logarithmic scale.",
        "Cumulative distributions of the true error, a line for each controller. "
        + "; ".join(
            f"{p.title}: "
            + ", ".join(
                f"{row.name} median {np.median(row.errors):.3f} mm" for row in p.rows if len(row.errors)
            )
            for p in panels
        )
        + ".",
        lambda: share_figure(panels),
    )


def _targeting(facts: _Facts) -> _Sheet:
    rows = facts.rows
    targets = np.stack([rows.number("target_depth_mm"), rows.number("target_lateral_mm")], axis=1)
    tips = _tips(facts)
    panels = [
        TargetPanel(
            name, _note(facts, own), _alarm(facts, own), look, targets[own], tips[own], facts.done[own]
        )
        for name, own, look in _panels(facts)
    ]
    number = len(np.unique(targets, axis=0))
    return _Sheet(
        "targeting",
        "Where the tips ended",
        f"True tips of all insertions and the {number} target{'s' if number > 1 else ''}, each in its circle of "
        "1 mm radius, to scale.",
        "Map of targets with circles of 1 mm and a dot for each true tip. " + _means(panels),
        lambda: targeting_figure(panels),
    )


def _panels(facts: _Facts) -> list[tuple[str, Flags, Look]]:
    """Return what has a panel: the levels of the first factor after a single controller, or the controllers."""
    factor = _shown_apart(facts)
    if factor is None:
        return [(name, facts.of(k), facts.looks[k]) for k, name in facts.controllers]
    return [
        (factor.titles[k], np.asarray(factor.codes == k), facts.looks[0]) for k in range(len(factor.names))
    ]


def _shown_apart(facts: _Facts) -> Factor | None:
    if facts.design.controller.varies:
        return None
    return next((f for f in facts.design.factors[1:] if len(f.names) <= MOST_PANELS), None)


def _by_controller(facts: _Facts) -> _Sheet:
    rows = [
        ErrorRow(name, look, facts.error[own & facts.known], int(own.sum()))
        for k, name in enumerate(facts.design.controller.names)
        for own, look in ((facts.of(k), facts.looks[k]),)
    ]
    return _Sheet(
        "errors",
        "True error by controller",
        "Every finished insertion is a dot" + _pooled(facts) + ". Errors are on a logarithmic scale.",
        "Rows of dots, one row for each controller. "
        + "; ".join(_middle(row.name, row.errors) for row in rows if len(row.errors))
        + ".",
        lambda: error_rows_figure(rows),
    )


def _by_depth(facts: _Facts, codes: Codes, names: Sequence[str]) -> _Sheet:
    panels = [
        ErrorPanel(name, _note(facts, own), _alarm(facts, own), _depth_rows(facts, own, look, codes, names))
        for name, own, look in _panels(facts)
    ]
    return _Sheet(
        "errors-by-depth",
        "True error by depth of the target",
        "Every finished insertion is a dot"
        + _pooled(facts, _shown_apart(facts))
        + ". Errors are on a logarithmic scale.",
        "Rows of dots for each depth of the target. "
        + "; ".join(f"{p.title}: medians {_listed(p.rows[1:] or p.rows)}" for p in panels)
        + ".",
        lambda: errors_by_level_figure(panels, "depth of the target (mm)"),
    )


def _depth_rows(facts: _Facts, own: Flags, look: Look, codes: Codes, names: Sequence[str]) -> list[ErrorRow]:
    chosen = [("all", own), *((name, own & (codes == k)) for k, name in enumerate(names))]
    return [
        ErrorRow(name, look, facts.error[flags & facts.known], int(flags.sum()))
        for name, flags in (chosen if len(names) > 1 else chosen[:1])
    ]


def _along(facts: _Facts, axis: Factor, number: int) -> _Sheet:
    places = axis.places
    levels = range(len(axis.names))
    sweeps = []
    for k, name in facts.controllers:
        own = [facts.of(k) & (axis.codes == level) for level in levels]
        errors = [facts.error[flags & facts.known] for flags in own]
        sweeps.append(Sweep(name, facts.looks[k], errors, [int(flags.sum()) for flags in own]))
    with_it = f" With it change {_and(axis.along)}." if axis.along else ""
    return _Sheet(
        f"error-along-{number + 1}",
        f"True error against {axis.label}",
        f"Median, middle half (25 to 75 %) and mean of the finished insertions{_pooled(facts, axis)}.{with_it}",
        f"Lines of median and mean true error over {axis.label}. "
        + "; ".join(
            f"{s.name}: medians "
            + ", ".join(
                f"{np.median(e):.3f} mm at {n}" for e, n in zip(s.errors, axis.names, strict=True) if len(e)
            )
            for s in sweeps
        )
        + ".",
        lambda: sweep_figure(sweeps, axis.label, places, axis.names),
    )


def _against(facts: _Facts, differences: Sequence[Difference]) -> _Sheet:
    names = facts.design.controller.names
    ours = differences[0].name
    rows = [_row(d.against, facts.looks[names.index(d.against)], d.mean_mm) for d in differences]
    panel = DifferencePanel(
        f"{ours} minus each other controller", "left of zero: smaller errors", facts.looks[0].color, rows
    )
    return _Sheet(
        "controllers",
        f"{ours} against the other controllers",
        f"Mean paired difference of the true error: {ours} minus the other, on the same phantoms and targets. "
        "Where differences are far from each other in size, the scale is even around zero and logarithmic beyond.",
        "Mean differences with their intervals: " + _told(rows) + ".",
        lambda: difference_figure([panel], "difference of the true error (mm)"),
    )


def _cases(facts: _Facts, differences: Sequence[Difference]) -> _Sheet:
    base, controllers = facts.design.cases.names[0], facts.controllers
    first = [d for d in differences if d.controller == controllers[0][1]]
    order = [d.name for d in sorted(first, key=lambda d: -_or_lowest(d.mean_mm.value))]
    panels = []
    for k, name in controllers:
        own = {d.name: d.mean_mm for d in differences if d.controller == name}
        rows = [_row(case, facts.looks[k], own[case]) for case in order]
        at_base = facts.error[facts.of(k) & facts.known & (facts.design.cases.codes == 0)]
        note = f"base case: mean {at_base.mean():.3f} mm" if len(at_base) else "base case: not known"
        panels.append(DifferencePanel(name, note, facts.looks[k].color, rows))
    return _Sheet(
        "cases",
        f"Cases against the base case, {base}",
        f"Mean paired difference of the true error: the case minus {base}, on the same phantoms and targets; "
        "the largest on top.",
        "Mean differences with their intervals. "
        + "; ".join(f"{panel.title}: {_told(panel.rows)}" for panel in panels)
        + ".",
        lambda: difference_figure(panels, "more error (mm)"),
    )


def _energy(facts: _Facts) -> _Sheet:
    energy = facts.rows.number("strain_energy_mj")
    panels = []
    for name, rows, drawn in _panels(facts):
        own = rows & facts.known & (energy > 0)
        note = (
            f"medians {np.median(energy[own]):.2g} mJ, {np.median(facts.error[own]):.3f} mm"
            if own.any()
            else ""
        )
        panels.append(EnergyPanel(name, note, drawn, energy[own], facts.error[own]))
    return _Sheet(
        "energy",
        "Tissue energy against true error",
        "Every finished insertion is a dot"
        + _pooled(facts, _shown_apart(facts))
        + ". Both scales are logarithmic.",
        "Energy stored in the tissue at the end against true error. "
        + "; ".join(f"{p.title}: {p.note}" for p in panels)
        + ".",
        lambda: energy_figure(panels),
    )


def _tips(facts: _Facts) -> Floats:
    return np.stack([facts.rows.number("tip_x_mm"), facts.rows.number("tip_y_mm")], axis=1)


def _note(facts: _Facts, own: Flags) -> str:
    """Say mean, 95 % and maximum of rows in one short line."""
    errors = facts.error[own & facts.known]
    if len(errors) == 0:
        return f"n = {int(own.sum())}"
    return f"mean {errors.mean():.2f}, 95 % {np.quantile(errors, 0.95):.2f}, max {errors.max():.2f} mm"


def _alarm(facts: _Facts, own: Flags) -> str:
    missing = int((own & ~facts.done).sum())
    return f"{missing} not finished" if missing else ""


def _pooled(facts: _Facts, axis: Factor | None = None) -> str:
    """Say over what else the rows are taken together."""
    others = [f for f in facts.design.factors[1:] if axis is None or f.key != axis.key]
    return f", all levels of {_and([factor.label for factor in others])} together" if others else ""


def _row(name: str, look: Look, found: Estimate) -> DifferenceRow:
    return DifferenceRow(name, look, found.value, found.low, found.high)


def _means(panels: Sequence[TargetPanel]) -> str:
    return "; ".join(f"{panel.title}: {panel.note}" for panel in panels) + "."


def _middle(name: str, errors: Floats) -> str:
    return f"{name}: median {np.median(errors):.3f} mm, 95 % {np.quantile(errors, 0.95):.3f} mm"


def _listed(rows: Sequence[ErrorRow]) -> str:
    return ", ".join(f"{np.median(row.errors):.3f} mm at {row.name}" for row in rows if len(row.errors))


def _told(rows: Sequence[DifferenceRow]) -> str:
    return ", ".join(f"{row.name} {row.mean:+.3f} mm ({row.low:+.3f} to {row.high:+.3f})" for row in rows)


def _and(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _or_lowest(value: float) -> float:
    return float("-inf") if isnan(value) else value
