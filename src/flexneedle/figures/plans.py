"""The figure of plans: each to scale, with guide, energy and cost below (as in the paper's Fig. 2)."""

from collections.abc import Sequence
from math import cos, degrees, isnan, sin
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures import curves, scene, space, zones
from flexneedle.figures.labels import name_parts
from flexneedle.figures.layout import fit, mosaic, short
from flexneedle.figures.panels import ENERGY, DepthPanel, Line, draw_depths
from flexneedle.figures.scene import View
from flexneedle.figures.style import INK, STRATEGIES, apply_style, format_signed, is_column, small, tone
from flexneedle.results import Plan, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.types import X, Y

_LINES = {1: 90, 2: 66}  # characters of a line above a plan, by the number of lateral axes
_ENTRY = np.array([-12.0, 12.0])  # mm; ends of the line along the tip at the skin


def plan_figure(scenario: Scenario, plans: Sequence[Plan]) -> Figure:
    """Return the figure of one or more plans to the same target."""
    roll = {"roll": _roll(plans)} if scenario.setup.axes == 2 else {}
    panels = (
        {"motion": _motion(scenario, plans)} | roll | {"energy": _energy(plans)} | _clearance(scenario, plans)
    )
    with apply_style():
        figure, axes = _sheet(scenario, plans, list(panels))
        known = [*(plan.tips for plan in plans), np.array([plans[0].target])]
        known += [scene.guide_path(scenario, plan.guide) for plan in plans]
        scenes: list[Axes] = []
        for plan, color in zip(plans, STRATEGIES, strict=False):
            drawn = [axes[plan.strategy + end] for end in scene.sections(scenario)]
            for ax, view in zip(drawn, scene.sections(scenario).values(), strict=True):
                scene.draw_tissue(ax, scenario, known, view)
                _draw_plan(ax, scenario, plan, color, view)
            title = fill(_result(scenario, plan), fit(_LINES[1 if is_column() else scenario.setup.axes]))
            scene.name_scenes(drawn, title, scene.color_of(plan), 9.5)
            if is_column() and plan is not plans[-1]:
                drawn[-1].set_xlabel("")
                drawn[-1].tick_params(labelbottom=False)
            scenes += drawn
            if scenario.setup.axes == 2:
                along = axes[f"{plan.strategy} along"]
                _draw_along(along, scenario, plan, single=len(plans) == 1)
                if is_column() and len(plans) > 1:
                    along.set_title(f"Along: {plan.strategy}")
        draw_depths([axes[name] for name in panels], scenario, list(panels.values()))
        _draw_cost(axes["cost"], plans)
        name_parts(figure, scenes, scenes, scenario)
    return figure


def _sheet(scenario: Scenario, plans: Sequence[Plan], panels: list[str]) -> tuple[Figure, dict[str, Axes]]:
    names, first = [plan.strategy for plan in plans], plans[0]
    title = f"{short(scenario.name, 60)}: plan to {scene.place(scenario, first.target)} (seed {first.seed})"
    title += zones.name_lost(scenario)
    taller = 1.15 * ("clearance" in panels)
    if scenario.setup.axes == 1:
        rows = [*((name, name) for name in names), *((panel, "cost") for panel in panels)]
        heights = [2.4] * len(plans) + [1.0] * len(panels)
        return mosaic(title, 3.4 + 2.4 * len(plans) + taller, rows, heights)
    ends = [(name, end) for name in names for end in scene.sections(scenario)]
    sections = [(name + end, name + end, f"{name} along") for name, end in ends]
    below = [(panel, "cost", "cost") for panel in panels]
    heights = [1.6] * len(ends) + [1.0] * len(panels)
    return mosaic(title, 4.6 + 3.2 * len(plans) + taller, sections + below, heights, space.COLUMNS)


def _draw_plan(ax: Axes, scenario: Scenario, plan: Plan, color: str, view: View) -> None:
    before = curves.intermediate_shapes(plan.tips, list(plan.shapes))
    zones.draw_zones(ax, scenario, plan.shapes[-1], view)
    scene.draw_needle(ax, plan.shapes[-1], before, scenario.needle.outer_diameter, "planned needle", view)
    how: dict[str, Any] = {"color": color, "linewidth": 1.4, "zorder": 5}
    ax.plot(*plan.tips[:, view].T, "--", label=f"planned path, {plan.strategy}", **how)
    space.draw_planned(ax, scenario, plan, view, 4.0)
    zones.draw_nearest(ax, scenario, plan.shapes, plan.least_clearance_mm, view)
    scene.draw_target(ax, plan.target, view)
    if scenario.setup.guide_x is not None:
        travel = plan.guide[:, view[1] - Y]
        scene.draw_guide(ax, scenario.setup.guide_x, travel, float(travel[-1]))
    _draw_entry(ax, plan, view)


def _draw_along(ax: Axes, scenario: Scenario, plan: Plan, *, single: bool) -> None:
    """Draw the view along the axis: paths of tip and guide, directions of the bevel, target."""
    travel = np.column_stack([np.zeros(len(plan.guide)), plan.guide])
    space.set_up_along(ax, scenario, [plan.tips, travel, np.array([plan.target])])
    zones.draw_zones(ax, scenario, plan.shapes[-1], scene.ALONG)
    if scenario.setup.has_guide:
        space.draw_guide_along(ax, plan.guide)
    space.draw_along(ax, plan.tips, scale=not is_column() or single)
    space.draw_planned(ax, scenario, plan, scene.ALONG, space.arrow_along(ax))
    scene.draw_target(ax, plan.target, scene.ALONG)


def _result(scenario: Scenario, plan: Plan) -> str:
    """Return the plan in a line: result, cost, and angles of the tip at the skin, if they are known."""
    angles = [
        f"{format_signed(round(degrees(angle), 1) + 0.0, '+.1f')}°"
        for angle in plan.entry_angles[: scenario.setup.axes]
    ]
    entry = "" if isnan(plan.entry_angle) else f", enters at {' and '.join(angles)}"
    if is_column():
        return f"{plan.strategy}: {_outcome(plan)}".replace(" mm", "\u00a0mm")
    return f"{plan.strategy}: {_outcome(plan)} (cost {plan.cost:.3g}){entry}"


def _outcome(plan: Plan) -> str:
    """Return the summary of a plan, shorter for a miss."""
    if plan.reached and not plan.limit:
        return plan.summary
    limit = f", limited by {plan.limit.partition(' (')[0]}" if plan.limit else ""
    distance = format_mm(plan.error_mm)
    if plan.refusal:
        return f"ends {distance} from the target, refused by {plan.limit}"
    if plan.reached:
        return f"ends {distance} from the target{limit}"
    return f"MISSES the target by {distance}{limit}"


def _draw_entry(ax: Axes, plan: Plan, view: View) -> None:
    """Draw the direction of the tip at the skin, if it is known."""
    lateral = view[1]
    angle = plan.entry_angles[lateral - Y]
    if isnan(angle):
        return
    y = float(np.interp(0.0, plan.tips[:, X], plan.tips[:, lateral]))
    how: dict[str, Any] = {"color": INK, "linewidth": 0.8, "zorder": 6, "label": "direction of entry"}
    ax.plot(_ENTRY * cos(angle), y + _ENTRY * sin(angle), **how)


def _motion(scenario: Scenario, plans: Sequence[Plan]) -> DepthPanel:
    """Return the lateral position of the guide over depth, or of the base where there is no guide."""
    guided = scenario.setup.has_guide
    title = "Guide, lateral (mm)" if guided else "Base, lateral (mm)"
    lines = [
        Line(
            plan.strategy + end, plan.tips[:, X], curves.planned_motion(plan, guided, axis), tone(color, axis)
        )
        for plan, color in zip(plans, STRATEGIES, strict=False)
        for end, axis in scene.moved_axes(scenario).items()
    ]
    return DepthPanel(title, lines, 0.4)


def _roll(plans: Sequence[Plan]) -> DepthPanel:
    """Return the angle of the needle over depth."""
    angles = [curves.planned_angles(plan) for plan in plans]
    lines = [
        Line(plan.strategy, depth, np.degrees(angle), color)
        for plan, (depth, angle), color in zip(plans, (one.T for one in angles), STRATEGIES, strict=False)
    ]
    return DepthPanel("Roll of the needle (°)", lines, 30.0, angles=True)


def _energy(plans: Sequence[Plan]) -> DepthPanel:
    lines = [
        Line(plan.strategy, plan.tips[:, X], 1e3 * plan.strain_energy, color)
        for plan, color in zip(plans, STRATEGIES, strict=False)
    ]
    return DepthPanel(ENERGY, lines, 1.0, peaks=True)


def _clearance(scenario: Scenario, plans: Sequence[Plan]) -> dict[str, DepthPanel]:
    """Return the panel of the clearance from zones, by name; none without zones near the plans."""
    near = [
        (plan, color)
        for plan, color in zip(plans, STRATEGIES, strict=False)
        if zones.has_clearance(plan.clearance)
    ]
    lines = [Line(plan.strategy, plan.tips[:, X], plan.clearance, color) for plan, color in near]
    return {"clearance": zones.clearance_panel(scenario, lines)} if lines and scenario.zone else {}


def _write_terms(ax: Axes, plans: Sequence[Plan], names: Sequence[str]) -> None:
    """Write the values of each term beside its longest bar, in the order of the plans."""
    for row, name in enumerate(names):
        values = [plan.terms.get(name, 0.0) for plan in plans]
        text = " and ".join(f"{value:.3g}" for value in values)
        how: dict[str, Any] = {"va": "center", "fontsize": small(), "textcoords": "offset points"}
        ax.annotate(text, (max(0.0, *values), row), (2, 0), **how)


def _draw_cost(ax: Axes, plans: Sequence[Plan]) -> None:
    """Draw the terms of the cost as bars, one colour for each plan, with the values at their ends."""
    names = list(dict.fromkeys(name for plan in plans for name in plan.terms))
    thick = 0.76 / len(plans)
    rows = np.arange(len(names))
    for k, plan in enumerate(plans):
        values = np.array([plan.terms.get(name, 0.0) for name in names])
        where = rows + (k - (len(plans) - 1) / 2) * thick
        bars = ax.barh(where, values, 0.9 * thick, color=STRATEGIES[k], label=plan.strategy)
        if not is_column():
            ax.bar_label(bars, [f"{value:.3g}" for value in values], padding=2, fontsize=min(7.5, small()))
    if is_column():
        _write_terms(ax, plans, names)
    ax.set_yticks(rows, names)
    ax.tick_params(axis="y", length=0)
    ax.invert_yaxis()
    ax.margins(x=0.4 if is_column() else 0.2)
    ax.locator_params(axis="x", nbins=4)
    costs = " and ".join(f"{plan.cost:.3g}" for plan in plans)
    ax.set_title(f"Terms of the cost, {costs} mm in all" if is_column() else "Terms of the cost (mm)")
