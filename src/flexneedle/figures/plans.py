"""The figure of plans: each to scale, below them guide, energy and cost (as in the paper's Fig. 2)."""

from collections.abc import Sequence
from math import cos, degrees, isnan, sin
from textwrap import fill, shorten

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexneedle.figures import curves, scene
from flexneedle.figures.panels import Line, draw_panel
from flexneedle.figures.style import (
    BAD,
    INK,
    PLAN,
    QUIET,
    STRATEGIES,
    TARGET,
    WIDTH,
    axes,
    new_figure,
    signed,
    styled,
)
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats, Plan

# Positions in inches from the top left.
_LEFT, _RIGHT, _HEAD, _BETWEEN = 0.62, 0.15, 0.66, 0.75
_PANEL_WIDTH, _PANEL_HEIGHT, _PANEL_GAP = 4.2, 0.9, 0.3
_BARS_WIDTH = 2.0
_TITLE_CHARACTERS = 95


def plan_figure(scenario: Scenario, plans: Sequence[Plan]) -> Figure:
    """Return the figure of one or more plans to the same target."""
    target = plans[0].target
    paths = [plan.tips for plan in plans]
    window = scene.view_of(scenario, target[0], [*paths, np.array([[*target]])])
    width = WIDTH - _LEFT - _RIGHT
    each = width * window.ratio + _BETWEEN
    below = _HEAD + len(plans) * each + 0.1
    with styled():
        figure = new_figure(below + 2 * _PANEL_HEIGHT + _PANEL_GAP + 0.5)
        _head(figure, scenario, plans[0])
        for k, plan in enumerate(plans):
            ax = axes(figure, _LEFT, _HEAD + k * each, width, width * window.ratio)
            _scene(ax, scenario, plan, window, STRATEGIES[k])
        _panels(figure, scenario, plans, below)
        _cost(
            axes(figure, WIDTH - _RIGHT - _BARS_WIDTH, below, _BARS_WIDTH, 2 * _PANEL_HEIGHT + _PANEL_GAP),
            plans,
        )
    return figure


def _head(figure: Figure, scenario: Scenario, plan: Plan) -> None:
    depth, lateral = plan.target
    name = shorten(scenario.name, 60, placeholder=" …")
    title = f"{name}: plan to {signed(depth)} mm deep, {signed(lateral)} mm lateral (seed {plan.seed})"
    height = float(figure.get_figheight())
    figure.text(0.12 / WIDTH, 1 - 0.1 / height, title, fontsize=11, weight="bold", va="top")


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
    ax.set_title(
        fill(f"{plan.strategy}: {plan.summary} (cost {plan.cost:.2f})", _TITLE_CHARACTERS),
        color=TARGET if plan.reached else BAD,
        fontsize=9.5,
    )


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


def _panels(figure: Figure, scenario: Scenario, plans: Sequence[Plan], top: float) -> None:
    span = (float(plans[0].tips[0, 0]), max(float(plan.tips[:, 0].max()) for plan in plans))
    contents = ((*_motion(scenario, plans), 0.4), ("Energy stored in the tissue (mJ)", _energy(plans), 0.01))
    for k, (title, lines, least) in enumerate(contents):
        ax = axes(figure, _LEFT, top + k * (_PANEL_HEIGHT + _PANEL_GAP), _PANEL_WIDTH, _PANEL_HEIGHT)
        draw_panel(ax, scenario, title, lines, span, least)
        ax.tick_params(labelbottom=k == len(contents) - 1)
    ax.set_xlabel("depth of the tip (mm)", labelpad=1.0)


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
