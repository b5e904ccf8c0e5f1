"""Sensors: noise, orientation, and the indicator of a reference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle.geometry.quaternion import along, z_axis
from flexneedle.phantom.tracking.field.room import Room, grid
from flexneedle.phantom.tracking.field.sensors import LARGEST_INDICATOR, indicator, noiseless, noisy
from rooms import environment

GRID = grid(100.0)
UPRIGHT = np.tile([1.0, 0.0, 0.0, 0.0], (125, 1))
DIRECTIONS = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1)


def exact(tracker, sensor, positions=GRID, orientations=UPRIGHT, seed=1, plate=None):
    return noiseless(Room(tracker, seed), sensor, positions, orientations, plate)


def read(tracker, sensor, count, seed=2):
    """Return many readings of a sensor at the center."""
    at_rest = exact(tracker, sensor, np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))
    return noisy(tracker, at_rest, np.random.default_rng(seed))


# ---- without an error


@given(direction=DIRECTIONS)
@hypothesis_settings(max_examples=15)
def test_a_sensor_without_errors_reads_the_true_pose(direction):
    orientation = along(np.array(direction) / np.linalg.norm(direction))
    orientations = np.tile(orientation, (125, 1))
    for sensor in ("tip", "ref3"):
        read = noisy(
            environment(), exact(environment(), sensor, orientations=orientations), np.random.default_rng(0)
        )
        np.testing.assert_allclose(read.positions, GRID, atol=1e-12)
        np.testing.assert_allclose(read.orientations, orientations, atol=1e-15)
        if sensor == "ref3":
            np.testing.assert_allclose(read.indicators, 0.0, atol=1e-12)
        else:
            assert read.indicators is None


def test_the_error_of_a_reference_is_the_mean_of_its_coils():
    """Their difference does not move it."""
    different = {"bias_mm": 1.0, "coils_mm": 2.0, "spacing_mm": 0.01}
    with_, without = environment(reference=different), environment(reference=different | {"coils_mm": 0.0})
    center = exact(with_, "ref1").coils.mean(axis=1)
    np.testing.assert_allclose(center, exact(without, "ref1").coils.mean(axis=1), atol=1e-3)
    np.testing.assert_allclose(center, GRID + Room(with_, 1).error("ref1", GRID), atol=1e-3)


# ---- noise


@pytest.mark.parametrize("sensor", ["tip", "ref1"])
def test_jitter_is_the_rms_length_of_the_deviation_white_on_each_axis(sensor):
    tracker = environment(tip={"jitter_mm": 0.09}, reference={"jitter_mm": 0.09})
    positions = read(tracker, sensor, 20_000).positions
    np.testing.assert_allclose(positions.std(axis=0), 0.09 / np.sqrt(3), rtol=0.02)
    assert np.sqrt(np.mean(np.sum(positions**2, axis=1))) == pytest.approx(0.09, rel=0.01)
    assert np.abs(np.corrcoef(positions.T) - np.eye(3)).max() < 0.025
    assert abs(np.corrcoef(positions[1:, 0], positions[:-1, 0])[0, 1]) < 0.025


def test_the_coils_noise_is_in_the_indicator():
    """Two coils of σ√2 on an axis, where σ is their mean's: |N(0, 2σ)| over the distance, to first order."""
    tracker = environment(reference={"jitter_mm": 0.09, "spacing_mm": 20.0})
    values = read(tracker, "ref1", 20_000).indicators
    sigma = 2.0 * 0.09 / np.sqrt(3) / 20.0
    assert values.mean() == pytest.approx(sigma * np.sqrt(2.0 / np.pi), rel=0.02)
    assert np.sqrt(np.mean(values**2)) == pytest.approx(sigma, rel=0.02)


def test_the_axis_jitters_by_its_rms_angle():
    tracker = environment(tilt_jitter_mrad=5.0)
    axes = z_axis(read(tracker, "tip", 20_000).orientations)
    assert np.sqrt(np.mean(axes[:, 0] ** 2 + axes[:, 1] ** 2)) == pytest.approx(5e-3, rel=0.02)


# ---- orientation


def test_a_position_error_tilts_the_axis():
    tracker = environment(tip={"bias_mm": 2.0}, tilt_mrad_per_mm=10.0)
    error = Room(tracker, 1).error("tip", GRID)
    angle = 2.0 * np.linalg.norm(exact(tracker, "tip").orientations[:, 1:], axis=-1)
    np.testing.assert_allclose(angle, 0.01 * np.linalg.norm(error, axis=-1), rtol=1e-4)


# ---- the indicator


@pytest.mark.parametrize(
    ("distance", "value"), [(10.0, 0.0), (10.5, 0.05), (9.5, 0.05), (0.0, 1.0), (500.0, LARGEST_INDICATOR)]
)
def test_the_indicator_is_the_relative_error_of_the_distance(distance, value):
    coils = np.array([[[1.0, 2.0, 3.0], [1.0 + 0.6 * distance, 2.0, 3.0 - 0.8 * distance]]])
    np.testing.assert_allclose(indicator(coils, 10.0), [value], atol=1e-12)


def test_the_indicator_responds_to_a_gradient_and_not_to_a_shift():
    """The indicator: the slope of the distortion along the axis of the coils."""
    plate, short = {"reference_mm": 1.0, "distance_mm": 100.0}, {"spacing_mm": 0.01}
    mild, steep = (
        environment(plate=plate | {"decay_mm": decay}, reference=short, length_mm=1e6)
        for decay in (1e6, 50.0)
    )
    assert indicator(exact(mild, "ref1").coils, 0.01).max() < 1e-4
    slope = np.abs(Room(steep, 1).distortion("ref1", GRID)[:, 2]) / 50.0
    np.testing.assert_allclose(indicator(exact(steep, "ref1").coils, 0.01), slope, rtol=1e-2)
