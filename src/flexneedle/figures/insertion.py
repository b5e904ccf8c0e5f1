"""The figure of an insertion: the scene to scale, panels over depth below it, and the end magnified.

With a tracker that measures its field, a panel over time shows the indicators and the times of holds.
"""

from collections.abc import Sequence
from textwrap import shorten, wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures import curves, scene
from flexneedle.figures.panels import Line, draw_panels, draw_timeline
from flexneedle.figures.style import (
    BAD,
    ESTIMATE,
    MEASURED,
    PLAN,
    QUIET,
    TARGET,
    TRUE,
    signed,
    stacked,
    styled,
)
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, Insertion

# Heights in inches: of labels and legend of the scene, of a line of its title, of the parts below.
_LABELS, _LINE, _PANELS, _FIELD = 0.7, 0.18, 3.7, 1.5
_CHARACTERS = 84  # of a line of the verdict
_FAR = 6.0  # mm; further from the target, the close-up shows the tip instead


def insertion_figure(scenario: Scenario, insertion: Insertion) -> Figure:
    """Return the figure of an insertion with at least one period, finished or not."""
    plan = insertion.plan
    known = [
        plan.tips,
        curves.estimated_path(insertion),
        curves.true_path(insertion),
        np.array([[*plan.target]]),
    ]
    window = scene.view_of(scenario, max(plan.target[0], float(known[1][:, 0].max())), known)
    field = curves.worst_indicator(insertion, scenario.monitor.indicator_window_s)
    verdict = wrap(insertion.summary, _CHARACTERS)
    heights = [_LABELS + _LINE * len(verdict) + scene.AXES * window.ratio, _PANELS]
    heights += [_FIELD] if len(field) else []
    with styled():
        figure, (above, below, *last) = stacked(_title(scenario, insertion), heights)
        ax = above.subplots()
        color = TARGET if insertion.reached else BAD
        ax.set_title("\n".join(verdict), fontsize=10, color=color, gid="verdict")
        _scene(ax, scenario, insertion, window)
        above.legend(handles=_handles(insertion), loc="outside lower center", ncols=8, columnspacing=1.3)
        below.suptitle(_facts(insertion), fontsize=8.5, x=0.012, ha="left")
        grid = below.add_gridspec(3, 2, width_ratios=(1.9, 1.0))
        _panels([below.add_subplot(grid[k, 0]) for k in range(3)], scenario, insertion)
        for part in last:
            _field(part.subplots(), scenario, insertion, field)
        _close_up(below.add_subplot(grid[:, 1]), scenario, insertion)
    return figure


def _title(scenario: Scenario, insertion: Insertion) -> str:
    depth, lateral = insertion.target
    name = shorten(scenario.name, 60, placeholder=" …")
    return f"{name}: target {signed(depth)} mm deep, {signed(lateral)} mm lateral (seed {insertion.seed})"


def _scene(ax: Axes, scenario: Scenario, insertion: Insertion, window: scene.View) -> None:
    plan, last = insertion.plan, insertion.periods[-1]
    scene.draw_tissue(ax, scenario, window)
    shapes = [period.shape for period in insertion.periods]
    before = curves.intermediate_shapes(curves.estimated_path(insertion), shapes)
    scene.draw_needle(ax, last.shape, before, scenario.needle.outer_diameter)
    if scenario.setup.guide_x is not None:
        travel = np.array([0.0, *(period.guide for period in insertion.periods)])
        scene.draw_guide(ax, scenario.setup.guide_x, travel, last.guide)
    _paths(ax, insertion)
    scene.draw_target(ax, plan.target)
    scene.name_target(ax, plan.target)
    scene.name_bevel(ax, plan)
    scene.draw_rolls(ax, curves.planned_rolls(plan), PLAN, solid=False, label="bevel roll, planned")
    scene.draw_rolls(ax, curves.applied_rolls(insertion), ESTIMATE, solid=True, label="bevel roll, applied")


def _paths(ax: Axes, insertion: Insertion, scale: float = 1.0) -> None:
    plan = insertion.plan
    samples, rejected = curves.good_samples(insertion), curves.rejected_samples(insertion)
    dots: dict[str, Any] = {"color": MEASURED, "markersize": 2.6 * scale**2, "markeredgewidth": 0.0}
    ax.plot(*samples.T, ".", zorder=3, label="tracker", **dots)
    ax.plot(*rejected.T, "x", color=QUIET, markersize=3.5 * scale, zorder=3, label="tracker, rejected")
    ax.plot(*plan.tips[:, :2].T, "--", color=PLAN, linewidth=1.1 * scale, zorder=5, label="planned")
    ax.plot(*curves.true_path(insertion).T, color=TRUE, linewidth=1.3 * scale, zorder=4, label="true")
    estimated = curves.estimated_path(insertion)
    ax.plot(*estimated.T, ":", color=ESTIMATE, linewidth=1.5 * scale, zorder=4.5, label="estimated")


def _handles(insertion: Insertion) -> list[Line2D]:
    planned, applied = scene.roll_style(PLAN, solid=False), scene.roll_style(ESTIMATE, solid=True)
    true, estimated = curves.true_path(insertion), curves.estimated_path(insertion)
    good, rejected = curves.good_samples(insertion), curves.rejected_samples(insertion)
    rolls_planned, rolls_applied = curves.planned_rolls(insertion.plan), curves.applied_rolls(insertion)
    name = "rejected" if len(good) else "tracker, rejected"
    roll = "applied" if rolls_planned else "bevel roll, applied"
    entries: tuple[tuple[bool, dict[str, Any]], ...] = (
        (_travels(true), {"color": TRUE, "linewidth": 1.3, "label": "true path"}),
        (_travels(estimated), {"color": ESTIMATE, "ls": ":", "linewidth": 1.6, "label": "estimated path"}),
        (len(good) > 0, {"color": MEASURED, "marker": ".", "ls": "none", "label": "tracker"}),
        (len(rejected) > 0, {"color": QUIET, "marker": "x", "markersize": 4, "ls": "none", "label": name}),
        (len(rolls_planned) > 0, {"marker": "^", "label": "bevel roll, planned", **planned}),
        (len(rolls_applied) > 0, {"marker": "^", "label": roll, **applied}),
    )
    return [
        scene.needle_handle("estimated needle"),
        Line2D([], [], color=PLAN, linestyle="--", linewidth=1.1, label="planned path"),
        *(Line2D([], [], **how) for drawn, how in entries if drawn),
    ]


def _travels(path: Floats) -> bool:
    """Whether a path (k, 2) is long enough to be visible as a line."""
    return len(path) > 0 and bool(np.ptp(path, axis=0).max() > 0.5)


def _panels(panels: Sequence[Axes], scenario: Scenario, insertion: Insertion) -> None:
    """Draw the panels over depth, the lowest with the axis."""
    plan = insertion.plan
    span = (float(plan.tips[0, 0]), max(float(plan.tips[:, 0].max()), plan.target[0]))
    contents = (
        ("Deviation from the plan (mm)", _error_lines(insertion), 0.4),
        _motion(scenario, insertion),
        ("Energy stored in the tissue (mJ)", _energy_lines(insertion), 0.01),
    )
    draw_panels(panels, scenario, contents, span)


def _error_lines(insertion: Insertion) -> list[Line]:
    plan = insertion.plan
    samples, truth = curves.good_samples(insertion), curves.true_path(insertion)
    return [
        Line("tracker", samples[:, 0], curves.lateral_error(plan, samples), MEASURED, marker="o"),
        Line("true", truth[:, 0], curves.lateral_error(plan, truth), TRUE),
    ]


def _motion(scenario: Scenario, insertion: Insertion) -> tuple[str, list[Line], float]:
    """Lateral position of the guide over depth, or of the base where there is no guide."""
    plan, depth = insertion.plan, curves.estimated_path(insertion)[:, 0]
    if scenario.setup.has_guide:
        title, planned = "Guide, lateral (mm)", plan.guide
        applied = np.array([period.guide for period in insertion.periods])
    else:
        title, planned = "Base, lateral (mm)", np.cumsum([0.0, *plan.controls[:, 1]])
        applied = np.array([period.base[1] for period in insertion.periods])
    lines = [Line("planned", plan.tips[:, 0], planned, PLAN, "--"), Line("applied", depth, applied, ESTIMATE)]
    return title, lines, 0.4


def _energy_lines(insertion: Insertion) -> list[Line]:
    plan, truth = insertion.plan, curves.true_energy(insertion)
    return [
        Line("planned", plan.tips[:, 0], plan.strain_energy, PLAN, "--"),
        Line("true", truth[:, 0], truth[:, 1], TRUE),
    ]


def _field(ax: Axes, scenario: Scenario, insertion: Insertion, field: Floats) -> None:
    """Draw the largest indicator of the references over time, the monitor's limits, and the times of holds."""
    monitor, held = scenario.monitor, curves.held_spans(insertion)
    span = (min(0.0, float(field[0, 0])), max(insertion.periods[-1].time, float(field[-1, 0])))
    shaded = f"; shaded: needle held, {insertion.held_s:.2f} s" if held else ""
    title = f"Largest indicator of the references (median over {monitor.indicator_window_s:g} s{shaded})"
    limits = [(f"limit {monitor.indicator_limit:g}", monitor.indicator_limit, "--")]
    if not monitor.enabled:
        limits = [("limit, monitor off", monitor.indicator_limit, "--")]
    elif held and monitor.resume_fraction < 1.0:
        lower = monitor.indicator_limit * monitor.resume_fraction
        limits.append((f"resumes below {lower:.4f}", lower, ":"))
    lines = [Line(name, np.array(span), np.full(2, y), BAD, style) for name, y, style in limits]
    draw_timeline(ax, title, [Line("references", field[:, 0], field[:, 1], MEASURED), *lines], span, held)
    ax.set_xlabel("time (s)", labelpad=1.0)


def _close_up(ax: Axes, scenario: Scenario, insertion: Insertion) -> None:
    """Magnify the end: around the target, or around the tip where that is far from the target."""
    tip = _last_tip(insertion)
    distance = float(np.hypot(*(tip - insertion.target)))
    near = distance <= _FAR
    centre, half = (insertion.target, max(1.6, 1.15 * distance)) if near else (tip, 3.0)
    ax.set_xlim(centre[0] - half, centre[0] + half)
    ax.set_ylim(centre[1] - half, centre[1] + half)
    ax.set_aspect("equal")
    ax.set_title("The end, magnified" if near else f"The tip, {distance:.1f} mm from the target")
    scene.tint_layers(ax, scenario, centre[0] + half)
    _paths(ax, insertion, scale=1.6)
    scene.draw_target(ax, insertion.target)
    if near and not insertion.reached:
        ax.plot(*np.array([tip, insertion.target]).T, color=BAD, linewidth=1.0, zorder=6, label="miss")
    ax.plot(*tip, "o", color=TRUE, markersize=6, markeredgecolor="white", zorder=9, label="tip")
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    ax.locator_params(nbins=5)
    ax.set_anchor("N")


def _last_tip(insertion: Insertion) -> Floats:
    truth = curves.true_path(insertion)
    end: Floats = (truth if len(truth) else curves.estimated_path(insertion))[-1]
    return end


def _facts(insertion: Insertion) -> str:
    """Errors, rolls, controller and phantom, as far as they are known, in one line."""
    values = (("true error", insertion.true_error_mm), ("tracker residual", insertion.residual_mm))
    errors = [f"{name} {value:.3f} mm" for name, value in values if not np.isnan(value)]
    rolls = f"bevel rolls {insertion.flips} (planned {insertion.plan.flips})"
    phantom = f"{insertion.phantom} phantom" if insertion.phantom else ""
    return "   ".join(filter(None, (*errors, rolls, insertion.controller, phantom)))
