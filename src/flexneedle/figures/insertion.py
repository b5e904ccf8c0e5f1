"""The figure of an insertion: the scene to scale, panels over depth below it, and the end magnified.

In space the scene is two sections to the same scale, x–y and x–z, with the view along the axis beside them. With a
tracker that measures its field, a panel over time shows the indicators and the times of holds.
"""

from math import dist, isfinite
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures import curves, scene, sensors, space, zones
from flexneedle.figures.labels import name_parts
from flexneedle.figures.layout import COLUMNS, fit, mosaic, short
from flexneedle.figures.panels import ENERGY, DepthPanel, Line, draw_depths, draw_timeline
from flexneedle.figures.scene import View
from flexneedle.figures.style import BAD, ESTIMATE, MEASURED, PLAN, QUIET, TRUE, apply_style, is_column, tone
from flexneedle.results import Insertion, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, X

_FAR = 6.0  # mm; further from the target, the close-up shows the tip instead
_LONG = 0.5  # mm; shorter paths would be hidden below their ends
_TALL, _ROWS = 1.3, 6  # height of a panel of sensors, over the other panels, and the names that fit beside it
_LINES = {1: 92, 2: 60}  # characters of a line of the verdict, by the number of lateral axes


def insertion_figure(scenario: Scenario, insertion: Insertion) -> Figure:
    """Return the figure of an insertion with at least one period, finished or not."""
    field = curves.worst_indicator(insertion, scenario.monitor.indicator_window_s)
    shown = _panels(scenario, insertion)
    sensed = sensors.sensor_panels(scenario, insertion)
    tall = {name: _TALL * max(1.0, panel.named / _ROWS) for name, panel in sensed.items()}
    with apply_style():
        figure, axes = _sheet(scenario, insertion, list(shown), tall, field=len(field) > 0)
        sections = scene.sections(scenario)
        scenes = [axes[f"scene{end}"] for end in sections]
        for ax, view in zip(scenes, sections.values(), strict=True):
            _scene(ax, scenario, insertion, view)
        verdict = fill(insertion.summary, fit(_LINES[1 if is_column() else scenario.setup.axes]))
        scene.name_scenes(scenes, verdict, scene.color_of(insertion))
        if scenario.setup.axes == 2:
            _along(axes["along"], scenario, insertion)
        panels = shown | sensed
        draw_depths([axes[name] for name in panels], scenario, list(panels.values()))
        for end, view in sections.items():
            _close_up(axes[f"end{end}"], scenario, insertion, view)
        facts = _facts(insertion)
        if not is_column():
            axes[f"end{end}"].set_xlabel("\n".join(facts))
        if len(field):
            _field(axes["field"], scenario, insertion, field)
        shown_axes = [*scenes, *(axes[name] for name in axes if name == "along")]
        parts = (facts[:2], facts[2:-2], facts[-2:])
        below = [", ".join(filter(None, part)) for part in parts if is_column() and part]
        name_parts(figure, scenes, shown_axes, scenario, below)
    return figure


def _panels(scenario: Scenario, insertion: Insertion) -> dict[str, DepthPanel]:
    """Return panels over depth by name, from above."""
    roll = {"roll": _roll(insertion)} if scenario.setup.axes == 2 else {}
    deviation, motion = _deviation(scenario, insertion), _motion(scenario, insertion)
    energy, clearance = {"energy": _energy(insertion)}, _clearance(scenario, insertion)
    return {"deviation": deviation, "motion": motion} | roll | energy | clearance


def _sheet(
    scenario: Scenario, insertion: Insertion, panels: list[str], sensed: dict[str, float], *, field: bool
) -> tuple[Figure, dict[str, Axes]]:
    if scenario.setup.axes == 1:
        scenes = [["scene", "scene"]]
        below = [[name, "end"] for name in panels]
        heights, widths, tall = [2.4], COLUMNS, 2.8
    else:
        scenes = [[name, name, "along"] for name in ("scene y", "scene z")]
        ends = ["end y", "end y", *["."] * (len(panels) - 4), "end z", "end z"]
        below = [[name, end, end] for name, end in zip(panels, ends, strict=True)]
        heights, widths, tall = [1.6, 1.6], space.COLUMNS, 2.8
    alone = [*sensed, *(["field"] if field else [])]
    rows = [*scenes, *below, *([name, *["."] * (len(widths) - 1)] for name in alone)]
    heights = heights + [1.0] * len(below) + [sensed.get(name, 1.0) for name in alone]
    target = f"target {scene.place(scenario, insertion.target)}"
    title = f"{short(scenario.name, 60)}: {target} (seed {insertion.seed}){zones.name_lost(scenario)}"
    return mosaic(
        title, tall + 1.15 * (len(rows) + sum(sensed.values()) - len(sensed)), rows, heights, widths
    )


def _scene(ax: Axes, scenario: Scenario, insertion: Insertion, view: View) -> None:
    plan, last = insertion.plan, insertion.periods[-1]
    estimated = curves.estimated_path(insertion)
    known = [plan.tips, estimated, curves.true_path(insertion), np.array([plan.target])]
    guide = scene.guide_path(scenario, _guide_travel(insertion)[:, 1:])
    scene.draw_tissue(ax, scenario, [*known, guide], view)
    before = curves.intermediate_shapes(estimated, [period.shape for period in insertion.periods])
    zones.draw_zones(ax, scenario, curves.last_shape(insertion), view)
    scene.draw_needle(ax, last.shape, before, scenario.needle.outer_diameter, "estimated needle", view)
    _paths(ax, insertion, view)
    sensors.draw_tip_region(ax, insertion, view)
    sensors.draw_points(ax, scenario, insertion, view)
    _rolls(ax, scenario, insertion, view, 4.0)
    zones.draw_nearest(ax, scenario, curves.known_shapes(insertion), curves.known_clearance(insertion), view)
    scene.draw_target(ax, plan.target, view)
    if scenario.setup.axes == 2 and (period := curves.prediction(insertion)) is not None:
        space.draw_prediction(ax, period, view)
    if scenario.setup.guide_x is not None:
        travel = _guide_travel(insertion)[:, view[1]]
        scene.draw_guide(ax, scenario.setup.guide_x, travel, travel[-1])


def _rolls(ax: Axes, scenario: Scenario, insertion: Insertion, view: View, length: float) -> None:
    """Draw the bevel at the start and after planned and applied rolls."""
    space.draw_planned(ax, scenario, insertion.plan, view, length)
    applied = curves.applied_rolls(insertion)
    if scenario.setup.axes == 1:
        scene.draw_rolls(ax, applied, ESTIMATE, solid=True, label="bevel roll, applied")
    else:
        label = "bevel after a roll, applied"
        space.draw_bevels(ax, applied, view, length, ESTIMATE, solid=True, label=label)


def _guide_travel(insertion: Insertion) -> Floats:
    """Return columns x (0), y, z of the guide, from the start."""
    places = [tuple(insertion.plan.guide[0]), *(period.guide for period in insertion.periods)]
    return np.array([(0.0, *place) for place in places])


def _along(ax: Axes, scenario: Scenario, insertion: Insertion) -> None:
    """Draw the view along the axis: paths of tip and guide, directions of the bevel, target."""
    travel, path = _guide_travel(insertion), _known_path(insertion)
    space.set_up_along(ax, scenario, [insertion.plan.tips, path, travel, np.array([insertion.target])])
    zones.draw_zones(ax, scenario, curves.last_shape(insertion), scene.ALONG)
    if scenario.setup.has_guide:
        space.draw_guide_along(ax, travel[:, 1:])
    space.draw_along(ax, path, insertion.plan.tips)
    sensors.draw_tip_region(ax, insertion, scene.ALONG, band=False)
    _rolls(ax, scenario, insertion, scene.ALONG, space.arrow_along(ax))
    scene.draw_target(ax, insertion.target, scene.ALONG)


def _paths(ax: Axes, insertion: Insertion, view: View, scale: float = 1.0) -> None:
    """Draw paths and readings of the tip, as far as there are any."""
    estimated, true = curves.estimated_path(insertion), curves.true_path(insertion)
    planned: dict[str, Any] = {"color": PLAN, "linestyle": "--", "linewidth": 1.1 * scale, "zorder": 5}
    _path(ax, insertion.plan.tips[:, view], "planned path", **planned)
    _path(ax, true[:, view], "true path", color=TRUE, linewidth=1.3 * scale, zorder=4)
    dotted: dict[str, Any] = {"color": ESTIMATE, "linestyle": ":", "linewidth": 1.5 * scale, "zorder": 4.5}
    _path(ax, estimated[:, view], "estimated path", **dotted)
    used, rejected = (
        points[:, view]
        for points in (curves.good_measurements(insertion), curves.rejected_measurements(insertion))
    )
    if len(used):
        ax.plot(*used.T, "o", color=MEASURED, markersize=2.0 * scale, zorder=3, label="tracker")
    if len(rejected):
        ax.plot(*rejected.T, "x", color=QUIET, markersize=3.5 * scale, zorder=3, label="tracker, rejected")


def _path(ax: Axes, points: Floats, label: str, **how: Any) -> None:
    """Draw a path (k, 2) that is long enough to be visible."""
    if len(points) and np.ptp(points, axis=0).max() > _LONG:
        ax.plot(*points.T, label=label, **how)


def _deviation(scenario: Scenario, insertion: Insertion) -> DepthPanel:
    plan = insertion.plan
    measured, truth = curves.good_measurements(insertion), curves.true_path(insertion)
    lines: list[Line] = []
    for end, (_, axis) in scene.sections(scenario).items():
        off, true = (curves.lateral_error(plan, points, axis) for points in (measured, truth))
        lines.append(Line(f"tracker{end}", measured[:, X], off, tone(MEASURED, axis), "o"))
        lines.append(Line(f"true{end}", truth[:, X], true, tone(TRUE, axis)))
    bands = sensors.tip_bands(scenario, insertion)
    return DepthPanel("Deviation from the plan (mm)", lines, 0.4, bands=bands)


def _motion(scenario: Scenario, insertion: Insertion) -> DepthPanel:
    """Return the lateral position of the guide over depth, or of the base where there is no guide."""
    plan, guided = insertion.plan, scenario.setup.has_guide
    depth = curves.estimated_path(insertion)[:, X]
    lines: list[Line] = []
    for end, axis in scene.moved_axes(scenario).items():
        planned = curves.planned_motion(plan, guided, axis)
        applied = curves.applied_motion(insertion, guided, axis)
        lines.append(Line(f"planned{end}", plan.tips[:, X], planned, tone(PLAN, axis), "--"))
        lines.append(
            Line(f"{'applied' if guided else 'estimated'}{end}", depth, applied, tone(ESTIMATE, axis))
        )
    return DepthPanel("Guide, lateral (mm)" if guided else "Base, lateral (mm)", lines, 0.4)


def _roll(insertion: Insertion) -> DepthPanel:
    """Return the angle of the needle over depth."""
    planned, applied = curves.planned_angles(insertion.plan), curves.applied_angles(insertion)
    lines = [
        Line("planned", planned[:, 0], np.degrees(planned[:, 1]), PLAN, "--"),
        Line("applied", applied[:, 0], np.degrees(applied[:, 1]), ESTIMATE),
    ]
    return DepthPanel("Roll of the needle (°)", lines, 30.0, angles=True)


def _energy(insertion: Insertion) -> DepthPanel:
    plan, truth = insertion.plan, curves.true_energy(insertion)
    estimate = curves.estimated_energy(insertion)
    name, shown, color = ("true", truth, TRUE) if len(truth) else ("estimated", estimate, ESTIMATE)
    lines = [
        Line("planned", plan.tips[:, X], 1e3 * plan.strain_energy, PLAN, "--"),
        Line(name, shown[:, 0], shown[:, 1], color),
    ]
    return DepthPanel(ENERGY, lines, 1.0, peaks=True)


def _clearance(scenario: Scenario, insertion: Insertion) -> dict[str, DepthPanel]:
    """Return the panel of the clearance from zones, by name; none without zones near the needle."""
    plan = insertion.plan
    planned = Line("planned", plan.tips[:, X], plan.clearance, PLAN, "--")
    estimated, true = (
        Line(name, rows[:, 0], rows[:, 1], color)
        for name, rows, color in (
            ("estimated", curves.estimated_clearance(insertion), ESTIMATE),
            ("true", curves.true_clearance(insertion), TRUE),
        )
    )
    lines = [line for line in (planned, true, estimated) if zones.has_clearance(line.y)]
    return {"clearance": zones.clearance_panel(scenario, lines)} if lines and scenario.zone else {}


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


def _close_up(ax: Axes, scenario: Scenario, insertion: Insertion, view: View) -> None:
    """Magnify the end: around the target, or around the tip where it is far from the target."""
    tip: Any = tuple(map(float, _known_path(insertion)[-1]))
    target = insertion.target
    distance = dist(tip, target)
    near = distance <= _FAR
    centre, half = (target, max(1.6, 1.15 * distance)) if near else (tip, 3.0)
    right, up = view
    ax.set_xlim(centre[right] - half, centre[right] + half)
    ax.set_ylim(centre[up] - half, centre[up] + half)
    ax.set(aspect="equal", anchor="N")
    seen = "" if scenario.setup.axes == 1 else f" in x–{'xyz'[up]}"
    if is_column() and seen:
        ax.set_title(f"{'End' if near else 'Tip'}{seen}")
    else:
        whole = f"The end{seen}{'' if is_column() else ', magnified'} (mm)"
        ax.set_title(whole if near else f"The tip{seen}, {format_mm(distance)} off")
    scene.tint_layers(ax, scenario)
    zones.draw_zones(ax, scenario, curves.last_shape(insertion), view, named=False)
    _paths(ax, insertion, view, scale=1.6)
    sensors.draw_tip_region(ax, insertion, view)
    scene.draw_target(ax, target, view)
    if near and not insertion.hit:
        miss = np.array([tip, target])[:, view]
        ax.plot(*miss.T, color=BAD, linewidth=1.0, zorder=6, label="miss")
    end: dict[str, Any] = {"color": TRUE, "markersize": 6, "markeredgecolor": "white", "zorder": 9}
    ax.plot(tip[right], tip[up], "o", label="tip", **end)
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    ax.locator_params(nbins=5)


def _known_path(insertion: Insertion) -> Floats:
    """Return the true path of the tip or, where it is unknown, the estimated path."""
    truth = curves.true_path(insertion)
    return truth if len(truth) else curves.estimated_path(insertion)


def _facts(insertion: Insertion) -> list[str]:
    """Return errors, bevel rolls, controller and phantom, as far as they are known."""
    values = (("true error", insertion.true_error_mm), ("tracker residual", insertion.residual_mm))
    errors = [f"{name} {format_mm(value)}" for name, value in values if not np.isnan(value)]
    if isfinite(least := curves.known_clearance(insertion)):
        errors.append(f"least clearance {format_mm(least)}")
    rolls = f"bevel rolls: {insertion.flips} (planned {insertion.plan.flips})"
    phantom = f"{insertion.phantom.rpartition(':')[2]} phantom" if insertion.phantom else ""
    return [
        *errors,
        rolls,
        ", ".join(filter(None, (insertion.controller_name or insertion.controller, phantom))),
    ]
