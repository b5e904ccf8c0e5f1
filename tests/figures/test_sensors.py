"""Sensors along the needle in figures, checked by their artists."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib.patches import Ellipse

import flexneedle
from drawn import axes, lines, names, overlapping, unarranged
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.sensors import _WINDOW, state_changes
from flexneedle.types import OK, CheckedReading, Reading
from synthetic import make_insertion
from synthetic_sensors import COVARIANCE, EXCLUDED_FROM, FROZEN, with_sensors

SCENARIO = flexneedle.load_scenario("phantom").with_values(
    {"sensor": [{"kind": "fbg", "sites_mm": [11, 26]}, {"kind": "slice", "plane_mm": 20.0}]}
)
SENSED = with_sensors()


@cache
def drawn():
    return insertion_figure(SCENARIO, SENSED)


def fbg_panel(*periods):
    """Return the panel of curvatures of an insertion with these periods."""
    with unarranged():
        return axes(insertion_figure(SCENARIO, replace(SENSED, periods=periods)), "fbg")[0]


def test_without_sensors_there_is_nothing_of_them():
    with unarranged():
        figure = insertion_figure(flexneedle.load_scenario("phantom"), make_insertion())
    assert {ax.get_label() for ax in figure.axes} == {"scene", "end", "deviation", "motion", "energy"}
    assert not [patch for ax in figure.axes for patch in ax.patches if "95 %" in patch.get_label()]


def test_the_region_of_the_tip_has_95_per_cent_of_its_samples():
    (end,) = axes(drawn(), "end")
    (region,) = (patch for patch in end.patches if isinstance(patch, Ellipse) and "95 %" in patch.get_label())
    tip = SENSED.periods[-1].estimate
    at = np.random.default_rng(0).multivariate_normal(tip[:2], np.array(COVARIANCE)[:2, :2], 20_000)
    inside = region.contains_points(end.transData.transform(at), radius=0.0)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.005)


def test_measured_curvatures_are_turned_back_to_the_stage():
    """A fibre that rolls by half a turn measures the opposite curvature of the same needle."""
    (panel,) = axes(drawn(), "fbg")
    near, _ = lines(panel, "_measured")
    rows = [period.sensors[0].readings[0].reading.rows[0][0] for period in SENSED.periods]
    still = np.array([abs(period.applied.roll) < 0.1 for period in SENSED.periods])
    turned = np.cos([period.roll for period in SENSED.periods])
    assert {-1, 1} == set(turned.round())
    np.testing.assert_allclose(near.get_ydata()[still], (1e3 * turned * rows)[still])
    assert np.isnan(near.get_ydata()[~still]).all()


def test_in_space_the_fibre_turns_with_the_needle():
    """With the fibre turned by 0.7 rad towards z, a curvature along y has components cos and −sin of it."""
    rows = ((2e-3 * np.cos(0.7), -2e-3 * np.sin(0.7)),) * 2
    bent = (CheckedReading(Reading(0.1, rows), OK),)
    periods = tuple(
        replace(one, roll=0.7, sensors=(replace(one.sensors[0], readings=bent),)) for one in SENSED.periods
    )
    fibre = {"kind": "fbg", "sites_mm": [11, 26]}
    space = flexneedle.load_scenario("phantom3d").with_values({"sensor": [fibre]})
    with unarranged():
        panels = axes(insertion_figure(space, replace(SENSED, periods=periods)), "fbg y", "fbg z")
    for panel, expected in zip(panels, (2.0, 0.0), strict=True):
        assert lines(panel, "_measured")[0].get_ydata()[0] == pytest.approx(expected)


def test_predicted_curvatures_are_those_of_the_estimated_needle():
    """A needle bent to a circle of radius 500 mm has a curvature of 2 1/m everywhere."""
    angles = np.linspace(-0.3, 0.0, 61)
    arc = np.zeros((61, 5))
    arc[:, 0], arc[:, 1], arc[:, 3] = 500 * np.sin(angles), 500 * (1 - np.cos(angles)), np.tan(angles)
    panel = fbg_panel(*(replace(period, shape=arc) for period in SENSED.periods))
    for site in ("11 mm", "26 mm"):
        np.testing.assert_allclose(lines(panel, site)[0].get_ydata(), 2.0, rtol=1e-3)


def test_innovations_are_over_the_depth_with_their_mean():
    (panel,) = axes(drawn(), "innovations")
    nis = np.array([period.sensors[0].nis for period in SENSED.periods])
    (mean,) = lines(panel, "fbg")
    np.testing.assert_allclose(mean.get_ydata()[20], np.mean(nis[21 - _WINDOW : 21]))
    assert np.isnan(mean.get_ydata()[: _WINDOW - 1]).all()
    used, _ = lines(panel, "_used")
    excluded = lines(panel, "_excluded")[0]
    assert (len(used.get_xdata()), len(excluded.get_xdata())) == (EXCLUDED_FROM, len(nis) - EXCLUDED_FROM)
    assert panel.get_yscale() == "log"


def test_an_exclusion_is_marked_where_it_happened():
    assert list(state_changes(SENSED, "fbg")) == [(SENSED.periods[EXCLUDED_FROM].estimate.x, FROZEN)]
    assert list(state_changes(SENSED, "slice")) == []
    (panel,) = axes(drawn(), "innovations")
    found = [" ".join(text.get_text().split()) for text in panel.texts]
    assert found == ["fbg: frozen: 20 identical readings while …"]
    assert FROZEN.startswith("frozen: 20 identical")


def test_eleven_sensors_with_long_names_have_room():
    """Names that are alike where they are cut have numbers, and the panel is as high as the names beside it."""
    names_of = [f"ultrasound slice number {k} of the probe" for k in range(11)]
    sensors = [{"kind": "slice", "name": name, "plane_mm": 2.0 + 3 * k} for k, name in enumerate(names_of)]
    states = [[replace(one.sensors[1], name=name) for name in names_of] for one in SENSED.periods]
    pairs = zip(SENSED.periods, states, strict=True)
    periods = tuple(replace(one, sensors=tuple(each)) for one, each in pairs)
    figure = insertion_figure(SCENARIO.with_values({"sensor": sensors}), replace(SENSED, periods=periods))
    panel, scene = axes(figure, "innovations", "scene")
    assert len(set(names(panel.get_legend()))) == 11
    assert panel.get_legend().get_window_extent().y0 >= panel.get_window_extent().y0
    assert scene.get_window_extent().width > 0.5 * figure.bbox.width


def test_crossings_of_the_last_seconds_are_drawn_beside_the_needle():
    (scene,) = axes(drawn(), "scene")
    (points,) = lines(scene, "slice, last 2 s")
    times = [period.sensors[1].readings[0].reading.time for period in SENSED.periods]
    assert len(points.get_xdata()) == sum(time >= SENSED.periods[-1].time - 2.0 for time in times)
    assert set(points.get_xdata()) == {20.0}
    (plane,) = lines(scene, "slice, plane")
    assert set(plane.get_xdata()) == {20.0}


def test_no_labels_overlap_or_are_cut():
    assert overlapping(drawn()) == []


def test_a_journals_column_has_no_panels_of_sensors():
    figure = flexneedle.plot(replace(SENSED, scenario=SCENARIO), width_mm=88.0)
    assert not {ax.get_label() for ax in figure.axes} & {"fbg", "innovations"}
    assert "tip, 95 % region" in names(figure.legends[0])
    assert overlapping(figure) == []


def test_a_sensor_without_a_reading_is_drawn():
    """As one that is lost from the start."""
    lost = [replace(period.sensors[0], readings=(), nis=np.nan) for period in SENSED.periods]
    periods = tuple(replace(one, sensors=(state,)) for one, state in zip(SENSED.periods, lost, strict=True))
    panel = fbg_panel(*periods)
    assert np.isnan([line.get_ydata() for line in lines(panel, "_measured")]).all()


def test_a_site_without_a_value_in_some_readings_has_the_mean_of_the_others():
    first = SENSED.periods[0]
    readings = tuple(
        CheckedReading(Reading(0.1, ((value, 0.0), (np.nan, np.nan))), OK) for value in (1e-3, np.nan, 3e-3)
    )
    one = replace(first, sensors=(replace(first.sensors[0], readings=readings),))
    panel = fbg_panel(one, *SENSED.periods[1:])
    near, far = lines(panel, "_measured")
    assert abs(near.get_ydata()[0]) == pytest.approx(2.0)
    assert np.isnan(far.get_ydata()[0])


def test_readings_without_rows_are_drawn():
    first = SENSED.periods[0]
    empty = replace(first.sensors[0].readings[0], reading=Reading(0.1, ()))
    one = replace(first, sensors=(replace(first.sensors[0], readings=(empty,)),))
    panel = fbg_panel(one, *SENSED.periods[1:])
    measured = lines(panel, "_measured")[0].get_ydata()
    assert np.isnan(measured[0])
    assert not np.isnan(measured[1])
