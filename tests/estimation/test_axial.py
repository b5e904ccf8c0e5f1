"""The needle's advance along its axis: a start error and a scale, fitted to all readings."""

import numpy as np
import pytest

import flexneedle
from flexneedle.estimation.axial import axial_variance, fit_axial_error, fit_even_advance
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, Control, Measurement, Motion, X
from tasks import begun_with

SCENARIOS = {
    name: flexneedle.load_scenario(name).with_values({"tracker.jitter_mm": 0.05})
    for name in ("phantom", "phantom3d")
}
OBSERVERS = {"state": StateCorrection(), "fit": Identification()}


def followed(name, observer, factor, count, late=0):
    """The estimate after advances that move the true needle `factor` times as far, and that needle's state."""
    simulator, axes = Simulator(SCENARIOS[name], 1), SCENARIOS[name].setup.axes
    estimate, truth, batches = observer.begin(begun_with(simulator)), simulator.start(), []
    for k in range(count):
        before, truth = truth, simulator.replay(truth, np.array([Control(db_x=factor)]))[0]
        points = {k + 0.5: 0.5 * (before.tip + truth.tip), k + 1.0: truth.tip}
        batches.append([Measurement(time, *point[: 1 + axes].tolist()) for time, point in points.items()])
        estimate = estimate.move(Motion(Control(db_x=1.0), k, k + 1.0))
        if k >= late:
            estimate = estimate.observe(batches[k - late])
    return estimate, truth


@pytest.mark.parametrize("factor", [0.98, 1.0, 1.02])
@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_the_depth_of_the_tip_is_the_trackers_whatever_the_axis_makes_of_a_command(name, observer, factor):
    """The commands, whose limits count travel of the motors, remain as they were."""
    estimate, truth = followed(name, OBSERVERS[observer], factor, 50, late=2)
    assert estimate.axial_scale == pytest.approx(factor, abs=2e-3)
    assert estimate.even_advance.scale == pytest.approx(factor, abs=2e-3)
    assert estimate.even_advance.misfit < 0.02
    assert estimate.tip[X] == pytest.approx(truth.tip[X], abs=0.03)
    assert estimate.state.travel[DB_X] == pytest.approx(50.0, abs=1e-9)


def test_the_fit_is_the_least_squares_solution_with_the_prior():
    rng = np.random.default_rng(1)
    travel, variance, sds = np.arange(12.0), rng.uniform(0.01, 0.1, 12), np.array([1.0, 0.01])
    ahead = 0.3 + 0.02 * travel + rng.normal(0.0, 0.1, 12)
    rows = np.concatenate(
        [np.stack([np.ones(12), travel], axis=1) / np.sqrt(variance)[:, None], np.diag(1.0 / sds)]
    )
    right = np.append(ahead / np.sqrt(variance), [0.0, 0.0])
    found, covariance = fit_axial_error(ahead, travel, variance, np.diag(sds**2))
    np.testing.assert_allclose(found, np.linalg.lstsq(rows, right, rcond=None)[0], rtol=1e-9)
    np.testing.assert_allclose(covariance, np.linalg.inv(rows.T @ rows), rtol=1e-9)
    known, _ = fit_axial_error(ahead, travel, variance, np.zeros((2, 2)))
    assert known.tolist() == [0.0, 0.0]
    sensitivity = np.array([1.0, 7.0])
    assert axial_variance(covariance, 7.0) == pytest.approx(sensitivity @ covariance @ sensitivity)


@pytest.mark.parametrize("scale", [0.5, 1.1, -1.0, 25.4])
def test_an_even_advance_has_any_scale_and_readings_that_jump_have_none(scale):
    travel, prior = np.arange(12.0), np.diag([1.0, 1e-4])
    noise = np.full(12, 1e-4)
    found = fit_even_advance(0.3 + (scale - 1.0) * travel, travel, noise, prior)
    assert found.scale == pytest.approx(scale, abs=1e-3)
    assert found.misfit < 1e-3
    jump = fit_even_advance(0.3 + (scale - 1.0) * travel - 0.6 * (travel > 6.0), travel, noise, prior)
    assert jump.misfit == pytest.approx(0.6 * np.sqrt(1 / 4 - 3 / 16 * 144 / 143), abs=0.03)
