"""The needle's advance along its axis: start error, scale and play, fitted to all readings."""

import numpy as np
import pytest

import flexneedle
from flexneedle.estimation.axial import (
    axial_variance,
    fit_axial_error,
    fit_even_advance,
    play_prior,
    rest_variance,
)
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.observer import StateCorrection
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, Control, Measurement, Motion, X
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom")
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


@pytest.mark.parametrize("turn", [-0.006, 0.006])
@pytest.mark.parametrize("observer", OBSERVERS)
def test_an_oblique_needle_that_starts_turned_advances_as_commanded(observer, turn):
    """Turning it moves its tip along the axis: no sign of a scale."""
    scenario = SCENARIOS["phantom"].with_values(
        {"entry.slope_mrad": 180.0, "control.start_angle_sd_mrad": 3.0}
    )
    simulator, slope = Simulator(scenario, 1), scenario.entry.slope.real
    start = simulator.start()
    truth = simulator.step(start.with_estimate(slope=(slope + turn,)), Control())
    estimate, scales = OBSERVERS[observer].begin(begun_with(simulator)), []
    for k in range(25):
        row = Control(db_x=1.0, db_y=slope)
        truth = simulator.replay(truth, np.array([row]))[0]
        estimate = estimate.move(Motion(row, k, k + 1.0)).observe(
            [Measurement(k + 1.0, *truth.tip[:2].tolist())]
        )
        scales.append(estimate.axial_scale)
    np.testing.assert_allclose(scales, 1.0, atol=3e-3)
    np.testing.assert_allclose(estimate.tip[:2], truth.tip[:2], atol=0.03)
    assert estimate.even_advance.scale == pytest.approx(1.0, abs=3e-3)


ADVANCES = np.arange(12) % 4 > 0  # every fourth move is a rest in tissue


def columns_of(travel, *others):
    return np.stack([np.ones_like(travel), travel, *others])


def test_the_fit_is_the_least_squares_solution_with_the_prior():
    """The play is a parameter beside the error of the start: at rest the needle is behind by it."""
    rng = np.random.default_rng(1)
    travel, variance, sds = np.arange(12.0), rng.uniform(0.01, 0.1, 12), np.array([1.0, 0.01, 0.3])
    ahead = 0.3 + 0.02 * travel - 0.5 * ~ADVANCES + rng.normal(0.0, 0.1, 12)
    rows = np.concatenate(
        [columns_of(travel, -1.0 * ~ADVANCES).T / np.sqrt(variance)[:, None], np.diag(1.0 / sds)]
    )
    right = np.append(ahead / np.sqrt(variance), np.zeros(3))
    start, scale, play = np.linalg.lstsq(rows, right, rcond=None)[0]
    found, covariance = fit_axial_error(
        ahead, columns_of(travel, ADVANCES), variance, play_prior(PHANTOM.control)
    )
    np.testing.assert_allclose(found, [start - play, scale, play], rtol=1e-9)
    inverse = np.linalg.inv(rows.T @ rows)
    for columns, sensitivity in (((1.0, 7.0, 0.0), [1.0, 7.0, -1.0]), ((1.0, 7.0, 1.0), [1.0, 7.0, 0.0])):
        assert axial_variance(covariance, columns) == pytest.approx(sensitivity @ inverse @ sensitivity)
    known, _ = fit_axial_error(ahead, columns_of(travel), variance, np.zeros((2, 2)))
    assert known.tolist() == [0.0, 0.0]


def test_a_shallow_rest_or_a_roll_does_not_show_the_whole_play():
    depth, turns = np.array([0.0, 5.0, 10.0, 40.0, 40.0]), np.array([False, False, False, False, True])
    np.testing.assert_allclose(rest_variance(depth, turns), [0.09, 0.0225, 0.0, 0.0, 0.09])


@pytest.mark.parametrize("scale", [0.5, 1.1, -1.0, 25.4])
def test_an_even_advance_has_any_scale_and_readings_that_jump_have_none(scale):
    travel, prior = np.arange(12.0), np.diag([1.0, 1e-4])
    noise = np.full(12, 1e-4)
    columns = columns_of(travel)
    found = fit_even_advance(0.3 + (scale - 1.0) * travel, columns, noise, prior)
    assert found.scale == pytest.approx(scale, abs=1e-3)
    assert found.misfit < 1e-3
    jump = fit_even_advance(0.3 + (scale - 1.0) * travel - 0.6 * (travel > 6.0), columns, noise, prior)
    assert jump.misfit == pytest.approx(0.6 * np.sqrt(1 / 4 - 3 / 16 * 144 / 143), abs=0.03)


def test_an_advance_with_play_is_even():
    travel, noise = np.arange(12.0), np.full(12, 1e-4)
    ahead = 0.3 + 0.1 * travel - 0.8 * ~ADVANCES
    found = fit_even_advance(ahead, columns_of(travel, ADVANCES), noise, play_prior(PHANTOM.control))
    assert found == pytest.approx((1.1, 0.0), abs=2e-3)
    assert fit_even_advance(ahead, columns_of(travel), noise, np.diag([1.0, 1e-4])).misfit > 0.3


@pytest.mark.parametrize("play", [0.6, -0.1])
@pytest.mark.parametrize("name", SCENARIOS)
def test_the_play_is_found_from_rests_in_tissue(name, play):
    """The model's needle is at rest; in motion and in air the tip is ahead on its path by the play."""
    simulator, lateral = Simulator(SCENARIOS[name], 1), SCENARIOS[name].setup.axes + 1
    estimate, truth = Identification().begin(begun_with(simulator)), simulator.start()
    for k in range(60):
        command = Control() if k in (10, 45, 52, 57) else Control(db_x=1.0, dg_y=0.12 * (k < 50))
        before, truth = truth.tip, simulator.replay(truth, np.array([command]))[0]
        moves_on = k not in (45, 52, 57)
        tips = {part: (1.0 - part) * before + part * truth.tip for part in (0.5, 1.0)}
        seen = {k + part: tip[:3] + play * moves_on * np.array([1.0, *tip[3:]]) for part, tip in tips.items()}
        estimate = estimate.move(Motion(command, float(k), k + 1.0))
        estimate = estimate.observe([Measurement(at, *tip[:lateral].tolist()) for at, tip in seen.items()])
        np.testing.assert_allclose(estimate.measured[:lateral], seen[k + 1.0][:lateral], atol=0.02)
        if k >= 57:
            np.testing.assert_allclose(estimate.tip[:lateral], seen[k + 1.0][:lateral], atol=0.02)
            assert estimate.state.tip[X] == pytest.approx(truth.tip[X], abs=0.02)
            assert estimate.play == pytest.approx(play, abs=0.02)
            assert estimate.even_advance == pytest.approx((1.0, 0.0), abs=0.02)
    assert truth.tip[3] > 0.09
    assert estimate.tip_at(59.5)[0] == pytest.approx(seen[59.5][X], abs=0.02)
