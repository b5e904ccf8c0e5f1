"""The figure of a map of entries, by its artists."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

import flexneedle
from drawn import axes, names
from flexneedle.figures.entries import entries_figure
from flexneedle.figures.style import figures_of_width
from flexneedle.planning.entries import map_entries

SPHERE = {"name": "vessel", "shape": "sphere", "center_mm": [15.0, 3.0, 0.0], "radius_mm": 1.5}
FREE = {"entry.free_radius_mm": 10.0, "entry.free_slope_mrad": 200.0, "zone": [SPHERE]}


@cache
def found(name):
    return map_entries(flexneedle.load_scenario(name).with_values(FREE))


@pytest.mark.parametrize("width", [3.5, 9.0])
def test_curves_over_the_entry_point_in_the_plane(width):
    entries = found("phantom")
    with figures_of_width(width):
        figure = entries_figure(entries)
    assert len(figure.axes) == 4
    clearance, offset = axes(figure, "clearance", "offset")
    curve = clearance.get_lines()[0]
    shown = ~np.isnan(curve.get_ydata())
    np.testing.assert_array_equal(shown, entries.reached)
    np.testing.assert_allclose(curve.get_ydata()[shown], entries.clearance_mm[entries.reached])
    np.testing.assert_array_equal(~np.isnan(offset.get_lines()[0].get_ydata()), entries.clear)
    recommended = next(line for line in offset.get_lines() if line.get_label() == "recommended entry")
    assert recommended.get_xdata()[0] == entries.points[entries.best(1)[0], 0]


@pytest.mark.parametrize(("width", "panels"), [(3.5, 2), (9.0, 4)])
def test_discs_at_the_entry_points_in_space(width, panels):
    entries = found("phantom3d")
    with figures_of_width(width):
        figure = entries_figure(entries)
    assert len([ax for ax in figure.axes if ax.get_label() != "<colorbar>"]) == panels
    (offset,) = axes(figure, "offset along")
    discs = [each for each in offset.collections if isinstance(each, EllipseCollection)]
    assert [len(each.get_offsets()) for each in discs] == [
        (~entries.reached).sum(),
        (entries.reached & ~entries.clear).sum(),
        entries.clear.sum(),
    ]
    np.testing.assert_allclose(discs[-1].get_offsets()[:, ::-1], entries.points[entries.clear])
    np.testing.assert_allclose(discs[-1].get_array(), entries.offset_mm[entries.clear])
    assert any(name.startswith("zone, silhouette") for name in names(figure.legends[0]))


@pytest.mark.parametrize("name", ["phantom", "phantom3d"])
def test_without_clear_entries_or_without_zones_no_panel_is_empty(name):
    some, none = found(name), np.zeros_like(found(name).clear)
    unclear = entries_figure(replace(some, clear=none, offset_mm=0.0 * some.offset_mm))
    free = entries_figure(replace(some, clearance_mm=np.full(len(none), np.inf)))
    for figure, panels in ((unclear, 2), (free, 1)):
        assert len([ax for ax in figure.axes if ax.get_label() != "<colorbar>"]) == panels


def test_names_of_zones_are_inside_and_the_margin_is_in_the_colour_bar():
    long = {"name": "rib", "shape": "box", "center_mm": [10.0, 3.0, 0.0], "size_mm": [6.0, 3.0, 90.0]}
    values = {**FREE, "zone": [long, {**SPHERE, "center_mm": [15.0, -10.9, 0.0]}]}
    some = replace(found("phantom3d"), scenario=flexneedle.load_scenario("phantom3d").with_values(values))
    figure = entries_figure(some)
    figure.draw_without_rendering()
    (ax,) = axes(figure, "offset along")
    assert "rib" in {text.get_text() for text in ax.texts}
    assert "vessel" not in {text.get_text() for text in ax.texts}  # only its edge is shown
    (rib,) = (text for text in ax.texts if text.get_text() == "rib")
    box = rib.get_window_extent()
    assert ax.bbox.x0 < box.x0 < box.x1 < ax.bbox.x1
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert [len(bar.texts) for bar in bars] == [1, 0, 0, 0]
