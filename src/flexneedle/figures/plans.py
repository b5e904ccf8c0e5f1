"""The figure of plans: each to scale, below them guide, energy and cost (as in the paper's Fig. 2)."""

from collections.abc import Sequence
from math import cos, degrees, isnan, sin
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures import curves, scene
from flexneedle.figures.layout import legend_of, mosaic, short
from flexneedle.figures.panels import DepthPanel, Line, draw_depths
from flexneedle.figures.style import BAD, INK, PLAN, STRATEGIES, TARGET, signed, styled
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, Plan

_LINE = 100  # characters of the line above a plan
_ENTRY = np.array([-12.0, 12.0])  # mm; ends of the line along the tip at the skin


def plan_figure(scenario: Scenario, plans: Sequence[Plan]) -> Figure:
    """Return the figure of one or more plans to the same target."""
    strategies = [plan.strategy for plan in plans]
    rows = [*((name, name) for name in strategies), ("motion", "cost"), ("energy", "cost")]
    with styled():
        figure, axes = mosaic(_title(scenario, plans[0]), 3.4 + 2.4 * len(plans), rows)
        scenes = [axes[name] for name in strategies]
        known = [*(plan.tips for plan in plans), np.array([plans[0].target])]
        for ax, plan, color in zip(scenes, plans, STRATEGIES, strict=False):
            scene.draw_tissue(ax, scenario, known)
            _draw_plan(ax, scenario, plan, color)
        draw_depths([axes["motion"], axes["energy"]], scenario, [_motion(scenario, plans), _energy(plans)])
        _draw_cost(axes["cost"], plans)
        legend_of(figure, scenes)
        figure.draw_without_rendering()
        for ax in scenes:
            scene.name_layers(ax, scenario)
    return figure


def _title(scenario: Scenario, plan: Plan) -> str:
    depth, lateral = plan.target
    target = f"{signed(depth)} mm deep, {signed(lateral)} mm lateral"
    return f"{short(scenario.name, 60)}: plan to {target} (seed {plan.seed})"


def _draw_plan(ax: Axes, scenario: Scenario, plan: Plan, color: str) -> None:
    before = curves.intermediate_shapes(plan.tips, list(plan.shapes))
    scene.draw_needle(ax, plan.shapes[-1], before, scenario.needle.outer_diameter, "planned needle")
    ax.plot(
        *plan.tips[:, :2].T,
        "--",
        color=color,
        linewidth=1.4,
        zorder=5,
        label=f"planned path, {plan.strategy}",
    )
    scene.draw_start(ax, plan)
    scene.draw_rolls(ax, curves.planned_rolls(plan), PLAN, solid=False, label="bevel flip, planned")
    scene.draw_target(ax, plan.target)
    if scenario.setup.guide_x is not None:
        scene.draw_guide(ax, scenario.setup.guide_x, plan.guide, float(plan.guide[-1]))
    result = f"{plan.strategy}: {plan.summary} (cost {plan.cost:.2f}){_draw_entry(ax, plan)}"
    ax.set_title(fill(result, _LINE), color=TARGET if plan.reached else BAD, fontsize=9.5)


def _draw_entry(ax: Axes, plan: Plan) -> str:
    """Draw the direction of the tip at the skin and return its angle in words, "" if it is not known."""
    angle = plan.entry_angle
    if isnan(angle):
        return ""
    y = float(np.interp(0.0, plan.tips[:, 0], plan.tips[:, 1]))
    how: dict[str, Any] = {"color": INK, "linewidth": 0.8, "zorder": 6, "label": "direction of entry"}
    ax.plot(_ENTRY * cos(angle), y + _ENTRY * sin(angle), **how)
    return f", enters at {signed(degrees(angle), '+.1f')}°"


def _motion(scenario: Scenario, plans: Sequence[Plan]) -> DepthPanel:
    """Lateral position of the guide over depth, or of the base where there is no guide."""
    guided = scenario.setup.has_guide
    title = "Guide, lateral (mm)" if guided else "Base, lateral (mm)"
    return DepthPanel(title, _lines(plans, [curves.planned_motion(plan, guided) for plan in plans]), 0.4)


def _energy(plans: Sequence[Plan]) -> DepthPanel:
    lines = _lines(plans, [plan.strain_energy for plan in plans])
    return DepthPanel("Energy stored in the tissue (mJ)", lines, 0.01)


def _lines(plans: Sequence[Plan], values: Sequence[Floats]) -> list[Line]:
    return [
        Line(plan.strategy, plan.tips[:, 0], value, color)
        for plan, value, color in zip(plans, values, STRATEGIES, strict=False)
    ]


def _draw_cost(ax: Axes, plans: Sequence[Plan]) -> None:
    """Draw the terms of the cost as bars, one colour for each plan, with the values at their ends."""
    names = list(dict.fromkeys(name for plan in plans for name in plan.terms))
    thick = 0.76 / len(plans)
    rows = np.arange(len(names))
    for k, plan in enumerate(plans):
        values = np.array([plan.terms.get(name, 0.0) for name in names])
        where = rows + (k - (len(plans) - 1) / 2) * thick
        bars = ax.barh(where, values, 0.9 * thick, color=STRATEGIES[k], label=plan.strategy)
        ax.bar_label(bars, [f"{value:.2f}" for value in values], padding=2, fontsize=7.5)
    ax.set_yticks(rows, names)
    ax.tick_params(axis="y", length=0)
    ax.invert_yaxis()
    ax.margins(x=0.2)
    ax.locator_params(axis="x", nbins=4)
    ax.set_title("Terms of the cost")
