"""Simple predictors against paths that they know exactly."""

from dataclasses import replace

import numpy as np

from flexneedle.lab.calibration.baselines import (
    REGRESSION,
    axis_offset,
    heading,
    pairs_ahead,
    predictors,
    whole,
)
from simulated_session import AXIS, blank

DEPTH = 5.0 * np.arange(13)
CURVATURE = np.array([4e-4, -2e-4])
START = np.array([0.05, 0.02])


def recording(position, slope, guide=None, depth=DEPTH, name="a"):
    made = blank("s", name, np.zeros_like(position) if guide is None else guide, depth)
    return replace(made, position=position, slope=slope)


def circle(start=START, curvature=CURVATURE, depth=DEPTH):
    x = depth[:, None]
    return recording(start * x + 0.5 * curvature * x**2, start + curvature * x + AXIS, depth=depth)


def errors(name, training, test, ahead=20.0):
    pairs = pairs_ahead(test, ahead)
    found = predictors(training, [pairs_ahead(one, ahead) for one in training])[name]
    i, j = pairs
    return np.linalg.norm(found(test, i, j) - (test.position[j] - test.position[i]), axis=1)


def test_pairs_are_the_nearest_in_depth_and_within_a_third():
    one = circle(depth=np.array([0.0, 4.0, 11.0, 19.0, 21.0, 60.0]))
    i, j = pairs_ahead(one, 10.0)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 2), (1, 2), (2, 4)]
    assert [each.tolist() for each in whole(one)] == [[0], [5]]


def test_a_circle_is_predicted_exactly_by_the_circle_from_the_slope():
    training = [circle(START * factor) for factor in (1.0, -0.5)]
    assert errors("circle", training, circle(-START)).max() < 1e-9
    # Without its slope the start is unknown: 20 mm ahead of one with the slope 0.054 the error is 2 × 20 × 0.054.
    assert errors("circle, no slope", training, circle(-START)).max() > 0.5
    # The chord is 0.5 κ L² from the tangent.
    straight = errors("straight", training, circle())[:-1]  # the last pair is 15 mm apart
    np.testing.assert_allclose(straight, 0.5 * np.linalg.norm(CURVATURE) * 400.0, rtol=1e-6)


def test_a_straight_path_is_predicted_exactly_along_the_axis_less_its_offset():
    training = [circle(curvature=0.0 * CURVATURE)]
    np.testing.assert_allclose(axis_offset(training), AXIS, atol=1e-12)
    assert errors("straight", training, circle(-START, 0.0 * CURVATURE)).max() < 1e-9
    stays = errors("stays", training, training[0])[:-1]
    np.testing.assert_allclose(stays, 20.0 * np.linalg.norm(START), rtol=1e-9)


def test_the_axis_offset_ignores_steps_in_which_the_guide_moves():
    moved = circle()
    guide = 2.0 * np.arange(13.0)[:, None] * np.ones(2)
    wrong = recording(moved.position, moved.slope + 0.5, guide)
    np.testing.assert_allclose(axis_offset([moved, wrong]), AXIS, atol=1e-9)
    assert moved.rests
    assert not wrong.rests
    np.testing.assert_array_equal(axis_offset([wrong]), np.zeros(2))


def test_the_mean_path_is_of_recordings_that_reach_the_depth():
    short = circle(START * 9.0, depth=DEPTH[:6])  # to 25 mm
    training = [circle(START * 0.5), circle(START * 1.5), short]
    found = errors("mean path", training, circle())
    assert found[2:].max() < 1e-9
    assert found[:2].min() > 1.0


def test_the_regression_recovers_its_numbers():
    random = np.random.default_rng(0)
    weights = np.array([[0.01, 0.4, -0.2, 0.1], [-0.02, 0.6, -0.1, 0.05]])

    def draw():
        guide, slope = random.normal(size=(13, 2)), 0.1 * random.normal(size=(13, 2))
        moved = np.diff(guide, axis=0)
        length = 5.0 * np.ones((12, 1))
        features = [length + 0.0 * moved, slope[:-1] * length, moved, moved * DEPTH[:-1, None] / 50.0]
        change = np.einsum("paf,af->pa", np.stack(features, axis=2), weights)
        return recording(np.vstack([np.zeros(2), np.cumsum(change, axis=0)]), slope, guide)

    assert errors(REGRESSION, [draw(), draw()], draw(), ahead=5.0).max() < 1e-9


def test_predictors_with_too_few_pairs_add_nothing():
    training = [circle(depth=DEPTH[:3])]
    pairs = [pairs_ahead(training[0], 10.0)]
    assert len(pairs[0][0]) < 4
    found = predictors(training, pairs)[REGRESSION](circle(), np.array([0]), np.array([2]))
    np.testing.assert_array_equal(found, np.zeros((1, 2)))
    none = [(np.zeros(0, dtype=int), np.zeros(0, dtype=int))]
    for name, predict in predictors(training, none).items():
        assert np.isfinite(predict(circle(), np.array([0, 1]), np.array([1, 3]))).all(), name


def test_without_a_slope_the_heading_is_from_the_step_before():
    one = recording(circle().position, np.full((13, 2), np.nan))
    expected = np.diff(one.position, axis=0) / 5.0
    np.testing.assert_allclose(heading(one, AXIS), np.vstack([np.zeros(2), expected]), atol=1e-12)
    assert np.isfinite(errors(REGRESSION, [one, one], one)).all()
    np.testing.assert_array_equal(axis_offset([one]), np.zeros(2))
