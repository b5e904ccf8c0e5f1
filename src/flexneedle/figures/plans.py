"""The figure of plans: each to scale, below them guide, energy and cost (as in the paper's Fig. 2)."""

from collections.abc import Sequence
from math import cos, degrees, isnan, sin
from textwrap import shorten, wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flexneedle.figures import curves, scene
from flexneedle.figures.panels import Line, draw_panels
from flexneedle.figures.style import (
    BAD,
    INK,
    PLAN,
    QUIET,
    STRATEGIES,
    TARGET,
    signed,
    stacked,
    styled,
)
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, Plan

# Heights in inches: of labels and legend of a scene, of a line of its title, of the panels.
_LABELS, _LINE, _PANELS = 0.7, 0.18, 2.8
_CHARACTERS = 95  # of a line of a title


def plan_figure(scenario: Scenario, plans: Sequence[Plan]) -> Figure:
    """Return the figure of one or more plans to the same target."""
    depth, lateral = plans[0].target
    window = scene.view_of(scenario, depth, [*(plan.tips for plan in plans), np.array([[depth, lateral]])])
    ends = [wrap(f"{plan.strategy}: {plan.summary} (cost {plan.cost:.2f})", _CHARACTERS) for plan in plans]
    heights = [_LABELS + _LINE * len(end) + scene.AXES * window.ratio for end in ends]
    with styled():
        name = shorten(scenario.name, 60, placeholder=" …")
        goal = f"plan to {signed(depth)} mm deep, {signed(lateral)} mm lateral"
        figure, (*scenes, below) = stacked(f"{name}: {goal} (seed {plans[0].seed})", [*heights, _PANELS])
        for part, plan, end, color in zip(scenes, plans, ends, STRATEGIES, strict=False):
            ax = part.subplots()
            ax.set_title("\n".join(end), color=TARGET if plan.reached else BAD, fontsize=9.5)
            _scene(ax, scenario, plan, window, color)
            part.legend(handles=_handles(plan, color), loc="outside lower center", ncols=3)
        grid = below.add_gridspec(2, 2, width_ratios=(2.1, 1.0))
        _panels([below.add_subplot(grid[k, 0]) for k in range(2)], scenario, plans)
        _cost(below.add_subplot(grid[:, 1]), plans)
    return figure


def _scene(ax: Axes, scenario: Scenario, plan: Plan, window: scene.View, color: str) -> None:
    scene.draw_tissue(ax, scenario, window)
    before = curves.intermediate_shapes(plan.tips, list(plan.shapes))
    scene.draw_needle(ax, plan.shapes[-1], before, scenario.needle.outer_diameter)
    if scenario.setup.guide_x is not None:
        scene.draw_guide(ax, scenario.setup.guide_x, plan.guide, float(plan.guide[-1]))
    ax.plot(*plan.tips[:, :2].T, "--", color=color, linewidth=1.4, zorder=5, label="planned")
    scene.draw_target(ax, plan.target)
    scene.name_target(ax, plan.target)
    scene.name_bevel(ax, plan)
    scene.draw_rolls(ax, curves.planned_rolls(plan), PLAN, solid=False, label="bevel roll, planned")
    _entry(ax, plan)


def _handles(plan: Plan, color: str) -> list[Line2D]:
    handles = [
        scene.needle_handle("planned needle"),
        Line2D([], [], ls="--", color=color, label="planned path"),
    ]
    roll: dict[str, Any] = {"marker": "^", "label": "bevel roll, planned"}
    rolls = [Line2D([], [], **roll, **scene.roll_style(PLAN, solid=False))]
    return handles + rolls if curves.planned_rolls(plan) else handles


def _entry(ax: Axes, plan: Plan) -> None:
    """Draw the direction of the tip at the skin, with its angle."""
    angle = plan.entry_angle
    if isnan(angle):
        return
    y = float(np.interp(0.0, plan.tips[:, 0], plan.tips[:, 1]))
    reach = np.array([-12.0, 12.0])
    ax.plot(
        reach * cos(angle),
        y + reach * sin(angle),
        color=INK,
        linewidth=0.8,
        zorder=6,
        label="direction of entry",
    )
    high = ax.get_ylim()[1]
    text = f"enters at {signed(degrees(angle), '+.1f')}°"
    ax.annotate(
        text,
        (0.0, y),
        (-6.0, high - 1.2),
        ha="right",
        va="top",
        arrowprops={"arrowstyle": "-", "color": QUIET, "linewidth": 0.6},
    )


def _panels(panels: Sequence[Axes], scenario: Scenario, plans: Sequence[Plan]) -> None:
    span = (float(plans[0].tips[0, 0]), max(float(plan.tips[:, 0].max()) for plan in plans))
    energy = ("Energy stored in the tissue (mJ)", _energy(plans), 0.01)
    draw_panels(panels, scenario, ((*_motion(scenario, plans), 0.4), energy), span)


def _motion(scenario: Scenario, plans: Sequence[Plan]) -> tuple[str, list[Line]]:
    """Lateral position of the guide over depth, or of the base where there is no guide."""
    guided = scenario.setup.has_guide
    values = [plan.guide if guided else np.cumsum([0.0, *plan.controls[:, 1]]) for plan in plans]
    title = "Guide, lateral (mm)" if guided else "Base, lateral (mm)"
    return title, _lines(plans, values)


def _energy(plans: Sequence[Plan]) -> list[Line]:
    return _lines(plans, [plan.strain_energy for plan in plans])


def _lines(plans: Sequence[Plan], values: Sequence[Floats]) -> list[Line]:
    return [
        Line(plan.strategy, plan.tips[:, 0], value, color)
        for plan, value, color in zip(plans, values, STRATEGIES, strict=False)
    ]


def _cost(ax: Axes, plans: Sequence[Plan]) -> None:
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
