"""The figure of an insertion: the scene to scale, panels over depth below it, and the end magnified.

With a tracker that measures its field, a panel over time shows the indicators and the times of holds.
"""

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures import curves, scene
from flexneedle.figures.layout import legend_of, mosaic, short
from flexneedle.figures.panels import DepthPanel, Line, draw_depths, draw_timeline
from flexneedle.figures.style import BAD, ESTIMATE, MEASURED, PLAN, QUIET, TARGET, TRUE, signed, styled
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, Insertion

_PANELS = ("deviation", "motion", "energy")
_FAR = 6.0  # mm; further from the target, the close-up shows the tip instead
_LONG = 0.5  # mm; shorter paths would be hidden below their ends
_LINE = 92  # characters of the verdict


def insertion_figure(scenario: Scenario, insertion: Insertion) -> Figure:
    """Return the figure of an insertion with at least one period, finished or not."""
    field = curves.worst_indicator(insertion, scenario.monitor.indicator_window_s)
    rows = [("scene", "scene"), *((name, "end") for name in _PANELS)]
    if len(field):
        rows.append(("field", "."))
    with styled():
        figure, axes = mosaic(_title(scenario, insertion), 2.8 + 1.15 * len(rows), rows)
        _scene(axes["scene"], scenario, insertion)
        motion = _motion(scenario, insertion)
        draw_depths(
            [axes[name] for name in _PANELS], scenario, [_deviation(insertion), motion, _energy(insertion)]
        )
        _close_up(axes["end"], scenario, insertion)
        if len(field):
            _field(axes["field"], scenario, insertion, field)
        legend_of(figure, [axes["scene"]])
        figure.draw_without_rendering()
        scene.name_layers(axes["scene"], scenario)
    return figure


def _title(scenario: Scenario, insertion: Insertion) -> str:
    depth, lateral = insertion.target
    target = f"target {signed(depth)} mm deep, {signed(lateral)} mm lateral"
    return f"{short(scenario.name, 60)}: {target} (seed {insertion.seed})"


def _scene(ax: Axes, scenario: Scenario, insertion: Insertion) -> None:
    plan, last = insertion.plan, insertion.periods[-1]
    estimated = curves.estimated_path(insertion)
    known = [plan.tips, estimated, curves.true_path(insertion), np.array([plan.target])]
    scene.draw_tissue(ax, scenario, known)
    before = curves.intermediate_shapes(estimated, [period.shape for period in insertion.periods])
    scene.draw_needle(ax, last.shape, before, scenario.needle.outer_diameter, "estimated needle")
    _paths(ax, insertion)
    scene.draw_start(ax, plan)
    scene.draw_rolls(ax, curves.planned_rolls(plan), PLAN, solid=False, label="bevel flip, planned")
    scene.draw_rolls(ax, curves.applied_rolls(insertion), ESTIMATE, solid=True, label="bevel flip, applied")
    scene.draw_target(ax, plan.target)
    if scenario.setup.guide_x is not None:
        travel = np.array([0.0, *(period.guide for period in insertion.periods)])
        scene.draw_guide(ax, scenario.setup.guide_x, travel, last.guide)
    color = TARGET if insertion.reached else BAD
    ax.set_title(fill(insertion.summary, _LINE), color=color, fontsize=10)


def _paths(ax: Axes, insertion: Insertion, scale: float = 1.0) -> None:
    """Draw paths and readings of the tip, as far as there are any."""
    estimated, true = curves.estimated_path(insertion), curves.true_path(insertion)
    _path(
        ax, insertion.plan.tips, "planned path", color=PLAN, linestyle="--", linewidth=1.1 * scale, zorder=5
    )
    _path(ax, true, "true path", color=TRUE, linewidth=1.3 * scale, zorder=4)
    _path(ax, estimated, "estimated path", color=ESTIMATE, linestyle=":", linewidth=1.5 * scale, zorder=4.5)
    used, rejected = curves.good_measurements(insertion), curves.rejected_measurements(insertion)
    if len(used):
        ax.plot(*used.T, "o", color=MEASURED, markersize=2.0 * scale, zorder=3, label="tracker")
    if len(rejected):
        ax.plot(*rejected.T, "x", color=QUIET, markersize=3.5 * scale, zorder=3, label="tracker, rejected")


def _path(ax: Axes, points: Floats, label: str, **how: Any) -> None:
    """Draw a path (k, ≥ 2) that is long enough to be visible."""
    if len(points) and np.ptp(points[:, :2], axis=0).max() > _LONG:
        ax.plot(*points[:, :2].T, label=label, **how)


def _deviation(insertion: Insertion) -> DepthPanel:
    plan = insertion.plan
    measured, truth = curves.good_measurements(insertion), curves.true_path(insertion)
    lines = [
        Line("tracker", measured[:, 0], curves.lateral_error(plan, measured), MEASURED, "o"),
        Line("true", truth[:, 0], curves.lateral_error(plan, truth), TRUE),
    ]
    return DepthPanel("Deviation from the plan (mm)", lines, 0.4)


def _motion(scenario: Scenario, insertion: Insertion) -> DepthPanel:
    """Lateral position of the guide over depth, or of the base where there is no guide."""
    plan, guided = insertion.plan, scenario.setup.has_guide
    applied = [period.guide if guided else period.base[1] for period in insertion.periods]
    lines = [
        Line("planned", plan.tips[:, 0], curves.planned_motion(plan, guided), PLAN, "--"),
        Line("applied", curves.estimated_path(insertion)[:, 0], np.array(applied), ESTIMATE),
    ]
    return DepthPanel("Guide, lateral (mm)" if guided else "Base, lateral (mm)", lines, 0.4)


def _energy(insertion: Insertion) -> DepthPanel:
    plan, truth = insertion.plan, curves.true_energy(insertion)
    lines = [
        Line("planned", plan.tips[:, 0], plan.strain_energy, PLAN, "--"),
        Line("true", truth[:, 0], truth[:, 1], TRUE),
    ]
    return DepthPanel("Energy stored in the tissue (mJ)", lines, 0.01)


def _field(ax: Axes, scenario: Scenario, insertion: Insertion, field: Floats) -> None:
    """Draw the largest indicator of the references over time, the monitor's limits, and the times of holds."""
    monitor, held = scenario.monitor, curves.held_spans(insertion)
    span = np.array([min(0.0, float(field[0, 0])), max(insertion.periods[-1].time, float(field[-1, 0]))])
    limits = [(f"limit {monitor.indicator_limit:g}", monitor.indicator_limit, "--")]
    if not monitor.enabled:
        limits = [("limit, monitor off", monitor.indicator_limit, "--")]
    elif held and monitor.resume_fraction < 1.0:
        lower = monitor.indicator_limit * monitor.resume_fraction
        limits.append((f"resumes below {lower:.4f}", lower, ":"))
    worst = Line(f"median over {monitor.indicator_window_s:g} s", field[:, 0], field[:, 1], MEASURED)
    lines = [worst, *(Line(name, span, np.full(2, y), BAD, style) for name, y, style in limits)]
    shade = f"needle held, {insertion.held_s:.2f} s"
    draw_timeline(ax, "Largest indicator of the references", lines, held, shade)


def _close_up(ax: Axes, scenario: Scenario, insertion: Insertion) -> None:
    """Magnify the end: around the target, or around the tip where that is far from the target."""
    tip = _last_tip(insertion)
    distance = float(np.hypot(*(tip - insertion.target)))
    near = distance <= _FAR
    centre, half = (insertion.target, max(1.6, 1.15 * distance)) if near else (tip, 3.0)
    ax.set_xlim(centre[0] - half, centre[0] + half)
    ax.set_ylim(centre[1] - half, centre[1] + half)
    ax.set(aspect="equal", anchor="N")
    ax.set_title("The end, magnified (mm)" if near else f"The tip, {distance:.1f} mm from the target")
    scene.tint_layers(ax, scenario)
    _paths(ax, insertion, scale=1.6)
    scene.draw_target(ax, insertion.target)
    if near and not insertion.reached:
        ax.plot(*np.array([tip, insertion.target]).T, color=BAD, linewidth=1.0, zorder=6, label="miss")
    ax.plot(*tip, "o", color=TRUE, markersize=6, markeredgecolor="white", zorder=9, label="tip")
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    ax.locator_params(nbins=5)
    ax.set_xlabel("\n".join(_facts(insertion)))


def _last_tip(insertion: Insertion) -> Floats:
    truth = curves.true_path(insertion)
    end: Floats = (truth if len(truth) else curves.estimated_path(insertion))[-1]
    return end


def _facts(insertion: Insertion) -> list[str]:
    """Errors, bevel flips, controller and phantom, as far as they are known."""
    values = (("true error", insertion.true_error_mm), ("tracker residual", insertion.residual_mm))
    errors = [f"{name} {value:.3f} mm" for name, value in values if not np.isnan(value)]
    flips = f"bevel flips: {insertion.flips} (planned {insertion.plan.flips})"
    phantom = f"{insertion.phantom} phantom" if insertion.phantom else ""
    return [*errors, flips, ", ".join(filter(None, (insertion.controller, phantom)))]
