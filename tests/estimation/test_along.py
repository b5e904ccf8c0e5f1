"""Sensors along the needle in the fit: derivatives by finite differences, and linear problems with known answers."""

import itertools

import numpy as np
import pytest

from flexneedle.estimation.along import DOUBT, between, whiten
from flexneedle.estimation.fit import differentiate, jacobian_of, lasting_covariance, simulate_due
from flexneedle.estimation.fitted import LASTING
from flexneedle.types import Reading
from sensed import followed


def expected(estimate, number):
    """Predicted means of a sensor with the present parameters."""
    one, bins = estimate.along[number], estimate.bins[number]
    return one.expected(bins, estimate.quantities[number], estimate.depths(bins), estimate.parameters)


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_derivatives_are_those_of_simulations_with_other_parameters(axes, number):
    estimate, _ = followed(axes)
    estimate = differentiate(estimate, simulate_due(estimate, estimate.parameters, range(estimate.slots.end)))
    one, bins, ends = estimate.along[number], estimate.bins[number], estimate.quantities[number]
    depth = estimate.depths(bins)
    jacobian = one.jacobian(
        bins, ends, depth, estimate.along_slopes(depth, number), estimate.parameters, estimate.timeline
    )
    sd = np.sqrt(np.diag(estimate.covariance))
    scale = one.sensor.noise
    before = expected(estimate.simulate_with(estimate.parameters), number)
    for k in range(estimate.parameters.size):
        if k == one.slots.clock:
            continue
        step = estimate.prior.steps[k] if k < estimate.slots.end else sd[k]
        shifted = estimate.parameters + step * (np.arange(sd.size) == k)
        change = (expected(estimate.simulate_with(shifted), number) - before) * sd[k] / step
        seen = bins.count > 0.0
        assert np.abs(change - jacobian[:, :, k] * sd[k])[seen].max(initial=0.0) < 0.25 * scale, k


def test_turns_in_air_have_derivatives_of_their_own():
    """Of the natural bend, which turns with the needle: at one depth, before and after half a turn."""
    first = (np.pi, 0.0, -np.pi, 0.0)
    estimate, _ = followed(count=4, first=first, **{"tracker.bias_sd_mm": 1.0})
    estimate = differentiate(estimate, simulate_due(estimate, estimate.parameters, range(estimate.slots.end)))
    jacobian, bins, sd = estimate.along_jacobians[0], estimate.bins[0], estimate.prior.steps
    seen = bins.count > 0.0
    before, tip = expected(estimate, 0), estimate.residuals[0]
    for k in range(estimate.slots.bend.start, estimate.slots.bend.stop):
        shifted = estimate.simulate_with(estimate.parameters + sd[k] * (np.arange(sd.size) == k))
        change = (expected(shifted, 0) - before) / sd[k]
        np.testing.assert_allclose(change[seen], jacobian[:, :, k][seen], atol=0.1 * np.abs(change).max())
        at_tip = (tip - shifted.residuals[0]) / sd[k]
        still = ~estimate.readings[0].turns
        np.testing.assert_allclose(
            jacobian_of(estimate)[still, k], at_tip[still], atol=0.1 * np.abs(at_tip).max()
        )


def test_a_prediction_is_as_uncertain_as_the_parameters_in_the_axes_of_the_sensor():
    """By predictions with other parameters, of a needle that has rolled by an odd angle."""
    estimate, _ = followed(count=20)
    reading = [Reading(estimate.along[0].time[-1], ((0.0, 0.0),) * 4)]
    compared = estimate.compare("fbg", reading)
    sd = estimate.prior.steps
    columns = []
    for k in range(estimate.parameters.size):
        step = sd[k] if k < estimate.slots.end else 1e-3 * np.sqrt(estimate.prior.covariance[k, k])
        other = estimate.simulate_with(
            estimate.parameters + step * (np.arange(estimate.parameters.size) == k)
        )
        columns.append((compared.residual - other.compare("fbg", reading).residual)[-1] / step)
    jacobian = np.array(columns).T
    known = jacobian @ estimate.covariance @ jacobian.T
    one = estimate.along[0]
    model = np.diag((DOUBT * one.sensor.model_error((compared.value - compared.residual)[-1:])[0]) ** 2)
    np.testing.assert_allclose(compared.covariance - model, known, atol=0.05 * np.diag(known).max())


def test_a_shift_of_all_points_is_one_error():
    """Stations do not average the error of a registration; sites of a fibre err each by itself."""
    estimate, _ = followed()
    counts = {one.name: one.slots.offset.stop - one.slots.offset.start for one in estimate.along}
    assert counts == {"fbg": 8, "slice": 2, "points": 2}


def test_the_tip_is_known_less_well_than_the_parameters_by_what_lasts():
    estimate, _ = followed()
    slope = estimate.slopes(estimate.state.tip[:1])[0]
    slope[estimate.slots.run_out] = estimate.state.bevel * np.array([1.0, 1.0j])
    parts = np.stack([slope.real, slope.imag])
    more = np.trace(estimate.tip_covariance[1:, 1:] - parts @ estimate.present_covariance @ parts.T)
    model = estimate.sensors[0].unexplained(estimate.nominal.scenario, estimate.settings)
    assert more > 2.0 * model**2 * (1.0 - np.exp(-2.0 / LASTING)) - 1e-12


def test_derivatives_that_change_after_the_fit_do_not_blow_up_the_tip():
    """Readings that depend more on the parameters tell more: with the covariance of the fit, 30 times the variance."""
    estimate, _ = followed()
    steeper = estimate.change(along_curves=tuple(5.0 * curves for curves in estimate.along_curves))
    assert np.trace(steeper.tip_covariance[1:, 1:]) < 1.5 * np.trace(estimate.tip_covariance[1:, 1:])


def test_the_derivative_to_the_clock_is_that_of_readings_at_other_times():
    """In moves whose readings stay in them; the needle turns and bends between the ends of a move."""
    estimate, _ = followed(turn="spin")
    one, ends, step = estimate.along[0], estimate.quantities[0], 1e-4

    def residual(clock):
        bins = one.bins(estimate.timeline, clock)
        parameters = estimate.parameters.copy()
        parameters[one.slots.clock] = clock
        return bins, bins.value - one.expected(bins, ends, estimate.depths(bins), parameters)

    bins, off = residual(0.0)
    later, shifted = residual(step)
    same = (bins.count == later.count).all(axis=1) & np.isin(
        bins.index, np.flatnonzero(estimate.timeline.turned)
    )
    assert same.sum() >= 1
    depth = estimate.depths(bins)
    jacobian = one.jacobian(
        bins, ends, depth, estimate.along_slopes(depth, 0), estimate.parameters, estimate.timeline
    )
    found, known = -(shifted - off)[same] / step, jacobian[same][:, :, one.slots.clock]
    np.testing.assert_allclose(found, known, atol=0.2 * np.abs(known).max())  # of noisy readings


def test_the_estimate_is_near_the_truth_and_says_how_near():
    estimate, rig = followed()
    off = np.subtract(rig.truth().tip[1:3], estimate.tip[1:3])
    assert np.hypot(*off) < 0.1
    assert off @ np.linalg.solve(estimate.tip_covariance[1:, 1:], off) < 14.0


def test_a_constant_error_of_the_tracker_is_found_with_a_guide():
    bias = {"phantom.tracker_bias_mm": 2.0, "tracker.bias_sd_mm": 1.5, "control.start_axial_sd_mm": 0.0}
    estimate, rig = followed(**bias, **{"phantom.start_axial_sd_mm": 0.0})
    assert np.linalg.norm(np.subtract(rig.truth().tip[:3], estimate.tip[:3])) < 0.25
    assert np.linalg.norm(estimate.bias) == pytest.approx(2.0, abs=0.25)


def test_a_sensor_without_weight_changes_nothing():
    plain, _ = followed()
    none = plain.change(along=tuple(one.without(0.0) for one in plain.along))
    assert not any(one.used.any() for one in none.along)
    assert none.along_residuals[0].size == 0


def test_white_rows_have_the_inverse_of_the_covariance_as_weight():
    rng = np.random.default_rng(0)
    variance, distance = rng.uniform(0.5, 2.0, 7), np.sort(rng.uniform(0.0, 3.0, 7))
    rows, values = rng.normal(size=(7, 3)), rng.normal(size=7)
    covariance = np.diag(variance) + 1.3**2 * np.exp(-np.abs(distance[:, None] - distance))
    white, values_white = whiten([rows, values], variance, 1.3, distance)
    np.testing.assert_allclose(white.T @ values_white, rows.T @ np.linalg.solve(covariance, values))
    variance[2] = np.inf
    kept = np.arange(7) != 2
    white, values_white = whiten([rows, values], variance, 1.3, distance)
    part = covariance[np.ix_(kept, kept)]
    np.testing.assert_allclose(white.T @ values_white, rows[kept].T @ np.linalg.solve(part, values[kept]))


def test_readings_are_averaged_over_the_moves_in_which_they_were_taken():
    estimate, _ = followed()
    one, bins, line = estimate.along[1], estimate.bins[1], estimate.timeline
    index, _, _ = line.at(one.time - one.clock(estimate.parameters))
    for k, move in enumerate(bins.index):
        mine = one.value[index == move]
        np.testing.assert_allclose(bins.count[k], np.isfinite(mine).sum(axis=0))
        if np.isfinite(mine).all():
            np.testing.assert_allclose(bins.value[k], mine.mean(axis=0))
    assert (np.diff(bins.index) > 0).all()
    np.testing.assert_allclose(
        between(bins, np.arange(len(line.begun) + 1.0)[:, None])[:, 0], bins.index + bins.part
    )


def test_errors_of_the_model_that_last_add_what_they_have_in_common():
    """Against a sum over all pairs of readings of a sensor, one after another."""
    estimate, _ = followed()
    gains = np.random.default_rng(3).normal(size=(2, estimate.parameters.size))
    known = np.zeros((2, 2))
    for k, one in enumerate(estimate.along):
        bins, error = estimate.bins[k], one.sensor.model_error(estimate.bins[k].value)
        pull = np.einsum("nk,bdk->nbd", gains, estimate.along_jacobians[k]) / one.variances(bins)
        for i, j in itertools.permutations(range(len(bins.index)), 2):
            alike = np.exp(-abs(int(bins.index[i]) - int(bins.index[j])) / LASTING)
            known += alike * (pull[:, i] * error[i]) @ (pull[:, j] * error[j]).T
    np.testing.assert_allclose(lasting_covariance(estimate, gains), known, rtol=1e-9)


def test_an_offset_is_constant_in_the_sensor_s_axes():
    estimate, _ = followed()
    one, bins = estimate.along[0], estimate.bins[0]
    still = np.abs(bins.facing) > 1.0 - 1e-9
    rows = estimate.along_jacobians[0].transpose(2, 0, 1)[one.slots.offset]
    own = one.in_its_axes(rows, bins)[:, still]
    assert np.ptp(rows[:, still], axis=1).max() > 1.0
    np.testing.assert_allclose(own, np.broadcast_to(np.eye(one.size)[:, None], own.shape), atol=1e-9)
