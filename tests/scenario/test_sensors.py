"""Kinds of sensors along the needle, against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import flexneedle
from flexneedle.scenario.sensors.fbg import Fbg, tilts_at
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import turn
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.sensors.view import View
from flexneedle.types import Needles, Reading

LENGTH = 150.0
PROJECTION = [[8.0, 1.0, 2.0, 300.0], [-1.0, 8.0, 3.0, 200.0], [0.001, 0.0, 0.002, 1.0]]


def arc(radius, angle=0.0, nodes=61):
    """A needle on an arc of a circle, whose base is along x, in a plane through x at an angle from y."""
    s = np.linspace(0.0, LENGTH, nodes)
    x, off = radius * np.sin(s / radius), radius * (1.0 - np.cos(s / radius))
    slope = np.tan(s / radius)
    cos, sin = np.cos(angle), np.sin(angle)
    return Needles(np.stack([x, cos * off, sin * off, cos * slope, sin * slope], axis=1)[None], s[1])


def wave(nodes):
    """A needle along a sine."""
    x = np.linspace(0.0, LENGTH, nodes)
    slope, off = 0.02 * np.sin(x / 25.0), -0.5 * np.cos(x / 25.0)
    return Needles(np.stack([x, off, 0 * x, slope, 0 * x], axis=1)[None], x[1])


def straight(point, slopes, nodes=31):
    """A straight needle from a point."""
    slopes = np.array(slopes)
    s = np.linspace(0.0, LENGTH, nodes)
    x = s / np.sqrt(1.0 + slopes @ slopes)
    rows = np.column_stack([point[0] + x, point[1] + slopes[0] * x, point[2] + slopes[1] * x])
    return Needles(np.concatenate([rows, np.tile(slopes, (nodes, 1))], axis=1)[None], s[1])


@given(st.floats(150.0, 3000.0), st.floats(0.0, 6.28), st.floats(6.0, 140.0))
def test_the_curvature_of_an_arc_is_that_of_its_circle(radius, angle, site):
    sensor = Fbg(kind="fbg", sites_mm=(site,), gauge_mm=5.0)
    found = sensor.predict(arc(radius, angle), 2)[0]
    np.testing.assert_allclose(found, [np.cos(angle) / radius, np.sin(angle) / radius], rtol=0.02, atol=1e-7)


def test_slopes_between_nodes_converge_with_the_third_power_of_their_distance():
    places = np.linspace(8.0, 140.0, 400)

    def error(nodes):
        exact = np.arctan(0.02 * np.sin((LENGTH - places) / 25.0))
        return np.abs(tilts_at(wave(nodes), places)[0, :, 0] - exact).max()

    assert error(31) / error(61) == pytest.approx(8.0, rel=0.1)


def test_the_derivatives_to_the_sites_are_those_of_moved_sites():
    needle = wave(61)
    sensor = Fbg(kind="fbg", sites_mm=(20.0, 70.0))
    moved = Fbg(kind="fbg", sites_mm=(20.5, 70.0)).predict(needle, 2) - sensor.predict(needle, 2)
    np.testing.assert_allclose(sensor.slopes(needle, 2)[:, :, 0] * 0.5, moved, rtol=0.03, atol=1e-9)
    assert not sensor.slopes(needle, 2)[:, 2:, 0].any()


@given(*[st.floats(-0.15, 0.15)] * 2, *[st.floats(-0.3, 0.3)] * 2, st.floats(20.0, 120.0))
def test_a_straight_needle_crosses_a_plane_of_any_pose_at_the_point_of_the_line(up, out, lean, turn_, at):
    sensor = Slice(kind="slice", plane_mm=at, normal=(1.0, lean, turn_))
    needle = straight((0.0, 1.0, -2.0), (up, out))
    normal, line, start = np.array([1.0, lean, turn_]), np.array([1.0, up, out]), np.array([0.0, 1.0, -2.0])
    crossing = start + line * (normal @ ([at, 0.0, 0.0] - start)) / (normal @ line)
    values = sensor.predict(needle, 2)[0]
    np.testing.assert_allclose(sensor.report(values, 2)[0], crossing, atol=1e-9)
    np.testing.assert_allclose(sensor.read(Reading(0.0, (tuple(crossing),)), needle, 2), values, atol=1e-9)
    assert sensor.sees(needle, 2).all() == (normal @ (needle.points[0, -1] - [at, 0.0, 0.0]) >= 0.0)


def test_points_anywhere_along_the_needle_are_read_at_the_stations():
    sensor = Points(kind="points", from_mm=10.0, to_mm=120.0)
    needle = arc(300.0, 0.7)
    x = np.random.default_rng(0).uniform(12.0, 100.0, 40)
    off, cos, sin = 300.0 - np.sqrt(300.0**2 - x**2), np.cos(0.7), np.sin(0.7)
    rows = np.column_stack([x, cos * off + 0.2, sin * off - 0.1])
    reading = Reading(0.0, tuple(map(tuple, rows.tolist())))
    off = sensor.read(reading, needle, 2) - sensor.predict(needle, 2)[0]
    off = off[np.isfinite(off)].reshape(-1, 2)
    np.testing.assert_allclose(off, np.tile([0.2, -0.1], (len(off), 1)), atol=2e-3)
    passed = np.repeat(sensor.stations <= needle.points[0, -1, 0], 2)
    np.testing.assert_array_equal(sensor.sees(needle, 2)[0], passed)


def test_a_view_measures_pixels_across_the_image_of_the_axis():
    sensor = View(kind="view", to_mm=100.0, projection=PROJECTION)
    needle = straight((-20.0, 0.0, 0.0), (0.05, -0.03))
    matrix = np.array(PROJECTION)
    image = np.column_stack([needle.points[0], np.ones(31)]) @ matrix.T
    pixels = image[:, :2] / image[:, 2:]
    found = sensor.read(Reading(0.0, tuple(map(tuple, pixels.tolist()))), needle, 2)
    seen = np.isfinite(found)
    np.testing.assert_allclose(found[seen], sensor.predict(needle, 2)[0][seen], atol=0.02)
    assert not sensor.predict(straight((-20.0, 0.0, 0.0), (0.0, 0.0)), 2).round(9).any()
    values = sensor.predict(needle, 2)[0]
    back = sensor.read(Reading(0.0, sensor.report(values, 2)), needle, 2)
    np.testing.assert_allclose(back, values, atol=1e-9)


def test_pairs_turn_as_complex_numbers_and_in_the_plane_by_the_cosine():
    values = np.array([[1.0, 2.0, -0.5, 0.3]])
    turned = turn(values, np.exp(1j * np.array([0.4])), 2)
    pairs = (values[:, ::2] + 1j * values[:, 1::2]) * np.exp(0.4j)
    np.testing.assert_allclose(turned[:, ::2] + 1j * turned[:, 1::2], pairs)
    np.testing.assert_allclose(turn(values, np.array([-1.0 + 0j]), 1), -values)


def test_a_scenario_without_sensors_does_not_list_them():
    assert "sensor" not in flexneedle.load_scenario("phantom").values()
