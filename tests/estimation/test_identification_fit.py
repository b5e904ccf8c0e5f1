"""The parts of the fit: derivatives, step and shortened step, readings, and the uncertainty left."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from flexneedle.estimation import fit
from flexneedle.estimation import identification as idn
from flexneedle.estimation.fit import differentiate, simulate_due
from flexneedle.estimation.identification import Identification
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import ROLL, Control, Measurement, Motion, X, Y
from identified import (
    AT,
    NEEDLES,
    OWN,
    PHANTOM,
    QUIET,
    Needle,
    commands,
    off_the_prior,
    predicted,
    readings,
    stepped,
    unexplained,
)
from tasks import begun_with

# ---- its derivatives


def finely(estimate):
    """The estimate with all derivatives simulated now, on a grid so fine that interpolation loses nothing."""
    grid = np.arange(estimate.grid[0], estimate.grid[-1], 0.05)
    size = estimate.parameters.size
    estimate = replace(estimate, grid=grid, curves=np.zeros((1, size, grid.size)))
    return differentiate(estimate, simulate_due(estimate, estimate.parameters, range(size)))


def test_derivatives_agree_with_central_differences():
    """Derivatives of the readings by every parameter, off the prior; with small steps they agree closely."""
    estimate, readings = off_the_prior()
    fine = replace(estimate, prior=replace(estimate.prior, steps=1e-3 * estimate.prior.steps))
    jacobian, close = fit.jacobian_of(finely(estimate)), fit.jacobian_of(finely(fine))
    assert jacobian.shape == (readings.y.size, estimate.parameters.size)
    for k in range(AT.cells + 11):
        step = np.zeros(estimate.parameters.size)
        step[k] = 1e-3 * estimate.prior.steps[k]
        rows = commands(55)
        ends = (
            predicted(estimate.parameters + s * step, rows, readings, estimate.axial) for s in (1.0, -1.0)
        )
        central = np.subtract(*ends) / (2.0 * step[k])
        scale = np.abs(central).max()
        np.testing.assert_allclose(close[:, k], central, atol=6e-3 * scale + 1e-7)
        # A step of a boundary is long, and may lie across the middles of contacts' intervals, where the slope jumps;
        # of the clearance, across where the needle leaves a wall.
        off = 0.35 if AT.shift <= k < AT.cells or k == AT.clearance else 0.03
        assert np.linalg.norm(jacobian[:, k] - central) <= off * np.linalg.norm(central) + 1e-6
    deepest = estimate.tips[:, X].max()
    np.testing.assert_array_equal(jacobian[:, AT.cells + int(deepest // 2.5) + 1 :], 0.0)


def test_no_derivative_is_older_than_a_round():
    """All are simulated again within it, the derivatives of start, needle and guide each time."""
    rows, states = commands(40), Needle().inserted(PHANTOM, commands(40))
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1)))
    last, leading = {}, (AT.base, AT.slope, AT.bend, AT.bevel, AT.clearance)
    for k, row in enumerate(rows):
        batch = readings(Needle(), states[k], states[k + 1], k, 2, 0.0, np.random.default_rng(0))
        estimate = estimate.move(Motion(row, k, k + 1.0)).observe(batch)
        last |= {one.parameter: k for one in estimate.perturbed}
    everyone = set(range(estimate.parameters.size)) - {AT.run_out}
    assert set(last) == everyone
    assert min(last.values()) > len(rows) - 1 - fit.ROUND
    assert {last[k] for k in leading} == {len(rows) - 1}
    assert len(estimate.perturbed) < 0.5 * len(everyone)


def test_a_parameter_has_no_effect_before_the_depth_where_it_begins():
    """It is not simulated there; the derivatives are the same if it is."""
    estimate, _ = off_the_prior()
    prior = replace(estimate.prior, begins=np.full_like(estimate.prior.begins, -np.inf))
    jacobian, again = (fit.jacobian_of(finely(one)) for one in (estimate, replace(estimate, prior=prior)))
    np.testing.assert_allclose(jacobian, again, rtol=1e-6, atol=1e-6)
    assert np.abs(jacobian[:, AT.cells + 9]).max() > 1e-4


def test_insertions_simulated_together_are_those_simulated_alone_and_step_by_step():
    """To the bit, whatever the companions: tips, states and models."""
    estimate, _ = off_the_prior()
    sets = [
        estimate.parameters + step * (np.arange(estimate.parameters.size) == k)
        for k, step in enumerate(estimate.prior.steps)
    ]
    found = estimate.simulate_all(sets)
    for k in (0, AT.bend, AT.clearance, AT.modulus + 1, AT.shift, len(sets) - 1):
        alone = estimate.simulate_with(sets[k])
        states = stepped(sets[k], commands(55), estimate.axial)
        assert found.states[k] == alone.state == states[-1]
        assert found.tips[k].tobytes() == alone.tips.tobytes()
        np.testing.assert_array_equal(found.tips[k], [state.tip for state in states])
        assert found.models[k].nodes.tobytes() == alone.simulator.model.nodes.tobytes()
    assert len({tips.tobytes() for tips in found.tips}) > 10


def test_one_step_is_the_maximum_a_posteriori_of_the_linear_problem():
    """The reference is the least-squares solution of readings and prior, each over its standard deviation."""
    estimate, readings = off_the_prior("bend")
    y = estimate.tips[:, Y]
    bends = np.abs(np.diff(np.concatenate([y[:1], y, y[-1:]]), n=2))
    chord = 0.25 * np.maximum(bends[readings.index], bends[readings.index + 1])
    assert chord.max() > 0.01
    jitter = QUIET.tracker.jitter_per_axis / np.sqrt(readings.count)
    sd = np.sqrt(jitter**2 + unexplained(QUIET, estimate.settings) ** 2 + chord**2)
    prior = np.linalg.cholesky(estimate.prior.precision).T
    jacobian = fit.jacobian_of(estimate)
    matrix = np.concatenate([jacobian / sd[:, None], prior])
    missing = readings.y - predicted(estimate.parameters, commands(55), readings, estimate.axial)
    right = np.concatenate([missing / sd, prior @ (estimate.prior.mean - estimate.parameters)])
    step = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert (np.abs(step) > 1e-4).sum() > 10
    found = fit.improve_fit(estimate).parameters
    np.testing.assert_allclose(found, estimate.parameters + step, rtol=1e-6, atol=1e-8)


def misfit(estimate, readings, before):
    """Half of the squares over variances, which the fit minimises; variances from the estimate `before`."""
    variance = estimate.variances()[0] + readings.estimate_sag(before.tips[:, Y]) ** 2
    off = estimate.parameters - estimate.prior.mean
    rows, p = np.array([done.applied for done in estimate.moves]), estimate.parameters
    y = estimate.tips[:, Y]
    y = y[readings.index] + readings.part * (y[readings.index + 1] - y[readings.index])
    first = estimate.start.bevel.real
    sides = first * np.cumprod(np.where(rows[:, ROLL] > 0.0, -1.0, 1.0))[readings.index]
    left = readings.y - y - p[AT.run_out] * sides
    return 0.5 * (left**2 / variance).sum() + 0.5 * off @ estimate.prior.precision @ off


KNOWN = {"control.start_axial_sd_mm": 0.0}


def test_a_step_never_fits_worse(monkeypatch):
    """Over whole insertions, one with readings that jump from side to side; the start along the axis is known.

    The first fit is left out: it takes up the clearance, which the start has not.
    """
    costs, tried, improved, with_ = [], [], fit.improve_fit, idn.Identified.take

    def spied(estimate):
        tried.append(0)
        fitted, readings = improved(estimate), estimate.readings[0]
        if len(estimate.moves) > 1:
            costs.append((misfit(estimate, readings, estimate), misfit(fitted, readings, estimate)))
        return fitted

    def counted(estimate, *which):
        tried[-1] += 1
        return with_(estimate, *which)

    monkeypatch.setattr(idn, "improve_fit", spied)
    monkeypatch.setattr(idn.Identified, "take", counted)
    for scenario, jump in ((PHANTOM, 1.0), (QUIET, 0.1)):
        estimate, states = (
            Identification().begin(begun_with(Simulator(scenario.with_values(KNOWN), 1))),
            Needle().inserted(scenario, commands(50)),
        )
        for k, row in enumerate(commands(50)):
            x, y = states[k + 1].tip[:2].tolist()
            off = jump * (-1) ** (k // 5)
            estimate = estimate.move(Motion(row, k, k + 1.0)).observe([Measurement(k + 1.0, x, y + off)])
    before, after = np.array(costs).T
    assert (after <= before * (1.0 + 1e-8)).all()
    assert len(set(tried)) >= 3
    assert sum(tried) < 4 * len(tried)


@pytest.mark.parametrize("factor", [-1.0, 1e-3])
def test_a_wrong_step_is_not_taken(monkeypatch, factor):
    """A wrong Jacobian leads the other way, or far too far; the fit does not become worse."""
    estimate, readings = off_the_prior()
    jacobian = fit.jacobian_of
    monkeypatch.setattr(fit, "jacobian_of", lambda *args: factor * jacobian(*args))
    fitted = fit.improve_fit(estimate)
    assert misfit(fitted, readings, estimate) <= misfit(estimate, readings, estimate) * (1.0 + 1e-12)


def with_nan(estimate):
    return replace(estimate, tips=np.full_like(estimate.tips, np.nan))


def not_converged(estimate):
    needle = estimate.state.needle
    solution = needle.solution._replace(converged=0.0)
    return replace(
        estimate,
        state=replace(
            estimate.state, solved=estimate.state.solved.with_needle(needle._replace(solution=solution))
        ),
    )


@pytest.mark.parametrize("spoil", [with_nan, not_converged])
@pytest.mark.parametrize("failing", [2, 99])
def test_a_trial_step_that_fails_is_refused(monkeypatch, spoil, failing):
    """Shorter steps are tried; if all of them fail, the parameters stay."""
    estimate, readings = off_the_prior()
    take, tried = idn.Identified.take, []

    def take_spoilt(self, parameters, *which):
        other = take(self, parameters, *which)
        tried.append(parameters)
        stays = np.array_equal(parameters, estimate.parameters)
        return spoil(other) if len(tried) <= failing and not stays else other

    monkeypatch.setattr(idn.Identified, "take", take_spoilt)
    fitted = fit.improve_fit(estimate)
    assert len(tried) >= 3
    assert fitted.state.converged
    assert np.isfinite(fitted.tips).all()
    if failing == 99:
        np.testing.assert_array_equal(fitted.parameters, estimate.parameters)
    assert misfit(fitted, readings, estimate) <= misfit(estimate, readings, estimate)


@given(st.integers(0, 10_000))
def test_a_step_within_bounds_is_the_bounded_least_squares_solution(seed):
    """The reference is SciPy's; it may leave a bound again, and so be a little better."""
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(9, 5)) @ rng.normal(size=(5, 5)), rng.normal(size=9)
    bounds = np.stack([-rng.exponential(0.3, 5), rng.exponential(0.3, 5)])
    found = fit.step_within(matrix.T @ matrix, matrix.T @ right, bounds)
    best = lsq_linear(matrix, right, tuple(bounds), method="bvls").x
    assert ((bounds[0] <= found) & (found <= bounds[1])).all()

    def off(step):
        return float(((matrix @ step - right) ** 2).sum())

    assert off(best) - 1e-9 <= off(found)
    assert off(found) <= off(np.zeros(5))
    if not np.isin(best, bounds).any():
        np.testing.assert_allclose(found, best, atol=1e-6)


def test_the_others_follow_a_parameter_that_ends_at_its_bound():
    """Two parameters of nearly the same effect: the one that may not move leaves all of it to the other."""
    matrix = np.array([[1.0, 0.99], [0.0, 0.1]])
    bounds = np.array([[-10.0, 0.0], [10.0, 0.0]])
    found = fit.step_within(matrix.T @ matrix, matrix.T @ np.array([1.0, -1.0]), bounds)
    np.testing.assert_allclose(found, [1.0, 0.0], rtol=1e-12)


def test_a_jacobian_that_is_not_finite_leaves_the_parameters(monkeypatch):
    estimate, readings = off_the_prior()
    monkeypatch.setattr(
        fit, "jacobian_of", lambda *_: np.full((readings.y.size, estimate.parameters.size), np.nan)
    )
    np.testing.assert_array_equal(fit.improve_fit(estimate).parameters, estimate.parameters)


def test_readings_of_a_move_are_averaged_at_their_mean_time():
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1)))
    for k in range(2):
        estimate = estimate.move(Motion(Control(db_x=1.0), 2.0 * k, 2.0 * k + 2.0))
    readings = [Measurement(2.5, -27.3, 0.1), Measurement(3.5, -26.7, 0.3)]
    (means,) = estimate.observe(readings).readings
    assert (means.index.tolist(), means.count.tolist()) == ([1], [2.0])
    assert (means.part[0], means.x[0], means.y[0]) == pytest.approx((0.5, -27.0, 0.2))
    np.testing.assert_allclose(means.between(np.array([0.0, 10.0, 20.0])), [15.0])


@pytest.mark.parametrize(("roll", "first"), [(0.0, 1), (np.pi, -1)])
def test_a_reading_is_on_the_side_to_which_the_bevel_rolled_before_its_move(roll, first):
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), roll))
    for k, flip in enumerate((False, True, False, True, False)):
        estimate = estimate.move(Motion(Control(db_x=1.0, flip=flip), float(k), k + 1.0))
    readings = [Measurement(k + 0.5, -28.0 + k, 0.0) for k in (0, 1, 3, 4)]
    (means,) = estimate.observe(readings).readings
    np.testing.assert_array_equal(means.index, [0, 1, 3, 4])
    np.testing.assert_array_equal(means.bevel, np.multiply(first, [1, -1, 1, 1]))


def test_the_low_pass_follows_the_newest_and_forgets():
    gain = OWN.residual_gain
    assert idn.low_pass(OWN, np.array([1.0])) == pytest.approx(gain)
    assert idn.low_pass(OWN, np.array([1.0, 0.0])) == pytest.approx(gain * (1.0 - gain))
    assert idn.low_pass(OWN, np.full(200, 0.3)) == pytest.approx(0.3, rel=0.01)
    assert idn.low_pass(OWN, np.zeros(0)) == 0.0


# ---- uncertainty


def prior_sd_of_the_tip(estimate):
    """Standard deviation (mm) of the tip's lateral position at the start, by moving one parameter after another."""
    prior = estimate.prior
    slope = np.zeros(prior.mean.size)
    start = stepped(prior.mean, [])[0].tip[Y]
    for k in range(prior.mean.size):
        parameters = prior.mean.copy()
        parameters[k] += prior.steps[k]
        slope[k] = (stepped(parameters, [])[0].tip[Y] - start) / prior.steps[k]
    slope[AT.run_out] = estimate.state.bevel.real
    return float(np.sqrt(slope @ np.linalg.solve(prior.precision, slope)))


def test_before_any_reading_the_tip_is_as_uncertain_as_the_prior():
    """The standard deviation is for both directions, across and along the axis."""
    estimate = Identification().begin(begun_with(Simulator(QUIET, 1)))
    across = prior_sd_of_the_tip(estimate)
    assert across > 0.1
    assert estimate.tip_sd == pytest.approx(np.hypot(across, QUIET.control.start_axial_sd_mm), rel=1e-3)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(estimate.prior.precision))


def test_readings_increase_no_uncertainty():
    """The covariance is below the prior's in every direction, and far below it at the end."""
    rows, needle = commands(60), NEEDLES["all"]
    states = needle.inserted(PHANTOM, rows)
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1)))
    volumes, prior = [], np.linalg.inv(estimate.prior.precision)
    for k, row in enumerate(rows):
        batch = readings(needle, states[k], states[k + 1], k, 4, 0.0, np.random.default_rng(0))
        estimate = estimate.move(Motion(row, k, k + 1.0)).observe(batch)
        volumes.append(np.linalg.slogdet(estimate.covariance)[1])
        assert np.linalg.eigvalsh(prior - estimate.covariance).min() > -1e-9
    assert volumes[0] < np.linalg.slogdet(prior)[1]
    assert volumes[-1] < volumes[len(volumes) // 2] < volumes[0]
