"""The figure of a map of entries, by its artists."""

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
