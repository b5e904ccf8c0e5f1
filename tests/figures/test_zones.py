"""Zones in figures, by their artists against circles and boxes by hand."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from drawn import axes, lines, names, texts, unarranged
from flexneedle.figures import zones
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.scene import ABOVE, ALONG, SIDE
from flexneedle.simulator.zones import zones_of
from synthetic import blind, make_insertion, make_plan
from synthetic_space import in_space
from zoned import SPHERE, grid_files, with_zones

CENTER, RADIUS = np.array(SPHERE["center_mm"]), SPHERE["radius_mm"]


def straight(y=0.0, z=0.0):
    """Return nodes (n, 5) of a straight needle, 1 mm apart."""
    x = np.arange(-60.0, 41.0)
    return np.column_stack([x, np.full_like(x, y), np.full_like(x, z), 0.0 * x, 0.0 * x])


def shown(scenario, shape, view, low, high):
    """Return axes with these limits (mm), with the zones of a scenario."""
    ax = Figure().subplots()
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    zones.draw_zones(ax, scenario, shape, view)
    return ax


def outline(ax, label):
    return np.concatenate([line.get_xydata() for line in ax.lines if line.get_label() == label])


def filled(ax, label):
    """Return the corners of all areas with a label."""
    return np.concatenate([p.get_path().vertices for p in ax.patches if p.get_label() == label])


def test_the_section_of_a_sphere_is_a_circle_and_its_margin_keeps_the_axis_of_the_needle_away():
    scenario = with_zones("phantom", SPHERE)
    ax = shown(scenario, straight(), SIDE, (10.0, 0.0), (40.0, 18.0))
    center, found = CENTER[:2], zones_of(scenario)
    kept = RADIUS + 2.0 + 0.5 * scenario.needle.outer_diameter + found.added[0]
    for label, radius in (("_zone", RADIUS), ("margin of zones", kept)):
        np.testing.assert_allclose(np.linalg.norm(outline(ax, label) - center, axis=1), radius, atol=2e-3)
    assert [text.get_text() for text in ax.texts] == ["node"]
    np.testing.assert_allclose(ax.texts[0].get_position(), center, atol=0.1)
    assert not [p for p in ax.patches if p.get_label() == "zone, silhouette"]


def test_a_section_in_space_is_at_the_needle_and_the_silhouette_is_the_whole_zone():
    scenario = with_zones("phantom3d", {**SPHERE, "center_mm": [25.0, 3.0, 2.0]})
    ax = shown(scenario, straight(), SIDE, (10.0, -6.0), (40.0, 12.0))
    off = np.linalg.norm(outline(ax, "_zone") - [25.0, 3.0], axis=1)
    np.testing.assert_allclose(off, np.sqrt(RADIUS**2 - 2.0**2), atol=5e-3)
    whole = np.linalg.norm(filled(ax, "zone, silhouette") - [25.0, 3.0], axis=1)
    assert whole.max() == pytest.approx(RADIUS, abs=0.1)
    beside = shown(scenario, straight(z=9.0), SIDE, (10.0, -6.0), (40.0, 12.0))
    assert not [line for line in beside.lines if line.get_label() == "_zone"]
    above = shown(scenario, straight(y=3.0), ABOVE, (10.0, -6.0), (40.0, 12.0))
    off = np.linalg.norm(outline(above, "_zone") - [25.0, 2.0], axis=1)
    np.testing.assert_allclose(off, RADIUS, atol=5e-3)


def test_the_view_along_the_axis_has_the_silhouettes_of_zones_above_the_tip():
    deep = {**SPHERE, "name": "deep", "center_mm": [50.0, 0.0, 0.0]}
    scenario = with_zones("phantom3d", {**SPHERE, "center_mm": [25.0, 3.0, 2.0]}, deep)
    ax = shown(scenario, straight(), ALONG, (-6.0, -6.0), (9.0, 9.0))
    corners = filled(ax, "zone, silhouette")
    np.testing.assert_allclose(corners.min(axis=0), [-1.0, 0.0], atol=0.1)
    np.testing.assert_allclose(corners.max(axis=0), [5.0, 6.0], atol=0.1)


def test_a_zone_of_a_file_is_drawn_by_its_grid(tmp_path):
    """A ring: two circles of 2 mm in its section, at y = ± 6 mm."""
    with grid_files(tmp_path) as ring:
        ax = shown(with_zones("phantom", ring), straight(), SIDE, (20.0, -10.0), (40.0, 10.0))
    points = outline(ax, "_zone")
    off = np.hypot(points[:, 0] - 30.0, np.abs(points[:, 1]) - 6.0)
    np.testing.assert_allclose(off, 2.0, atol=0.03)


def test_the_line_of_the_least_clearance_is_the_shortest_to_a_zone():
    scenario = with_zones("phantom", SPHERE)
    ax = Figure().subplots()
    zones.draw_nearest(ax, scenario, [straight(), straight(z=3.0)], 5.59, SIDE)
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [[25.0, 0.0], [25.0, 6.0]], atol=1e-3)
    assert ax.texts[0].get_text() == "5.59 mm"


def with_clearance(scenario, insertion):
    """Return an insertion with the clearances of its shapes."""
    found = zones_of(scenario)
    periods = tuple(
        replace(
            p,
            clearance=float(found.shape_clearances(p.shape)),
            true_clearance=None if p.true_shape is None else float(found.shape_clearances(p.true_shape)),
        )
        for p in insertion.periods
    )
    clearance = found.shape_clearances(insertion.plan.shapes)
    plan = replace(insertion.plan, clearance=clearance, scenario=scenario)
    return replace(insertion, plan=plan, periods=periods, scenario=scenario)


MARGINS = ["margin of vessel", "margin of bone, node, rib"]


@pytest.mark.parametrize("known", [True, False])
def test_an_insertion_shows_true_estimated_and_planned_clearance_with_the_margins(known):
    scenario, made = with_zones("phantom"), make_insertion()
    if not known:
        made = replace(made, periods=tuple(map(blind, made.periods)))
    made = with_clearance(scenario, made)
    with unarranged():
        figure = insertion_figure(scenario, made)
    (panel,) = axes(figure, "clearance")
    expected = ["planned", *(["true"] if known else []), "estimated", *MARGINS]
    assert names(panel.get_legend()) == expected
    (estimated,) = lines(panel, "estimated")
    assert np.nanmin(estimated.get_ydata()) == made.least_clearance_mm
    least = made.true_clearance_mm if known else made.least_clearance_mm
    assert f"{least:.2f} mm" in texts(figure)
    assert [lines(panel, name)[0].get_ydata()[0] for name in MARGINS] == [1.0, 2.0]


def test_figures_of_plans_and_insertions_in_space_show_zones():
    scenario = with_zones("phantom3d")
    made = with_clearance(scenario, in_space(make_insertion(), 0.6))
    with unarranged():
        for figure in (insertion_figure(scenario, made), plan_figure(scenario, [made.plan])):
            assert {"rib", "node"} <= set(texts(figure))
            assert any(isinstance(patch, PathPatch) for ax in figure.axes for patch in ax.patches)
            assert axes(figure, "clearance")


def test_figures_without_zones_have_no_panel_of_the_clearance():
    with unarranged():
        figure = plan_figure(with_zones("phantom").with_values({"zone": []}), [make_plan()])
    assert "clearance" not in {ax.get_label() for ax in figure.axes}


@pytest.mark.parametrize("base", ["phantom", "phantom3d"])
def test_a_zone_whose_file_is_missing_is_named_in_the_title_and_no_nearest_zone_is_drawn(base):
    """The recorded clearance may be the lost zone's, so that its line must not end at another zone."""
    lost = {"name": "ring", "shape": "file", "file": "/nowhere/ring.nrrd", "segment": "ring"}
    scenario, made = with_zones(base, lost, SPHERE), make_insertion()
    made = in_space(made, 0.7) if base == "phantom3d" else made
    with unarranged():
        for figure in (insertion_figure(scenario, made), plan_figure(scenario, [made.plan])):
            assert figure.get_suptitle().split()[-1] == "ring"
            assert "node" in texts(figure)
            assert not [line for ax in figure.axes for line in lines(ax, "least clearance")]
