"""The standard deviation of the predicted miss: a linear problem by Monte Carlo, and its bounds."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.control import outlook as ol
from flexneedle.control.outlook import Outlook, predict_ends
from flexneedle.types import Control, X, Y
from identified import AT, fitted

TARGET = 40.0
GRID = np.arange(-30.0, 60.0)


def linear(precision, curves, now=0.0, variance=1e-3):
    """Outlook and estimate of a linear problem: the tip is the sum of the parameters times their curves (K, g)."""
    scenario = SimpleNamespace(
        setup=SimpleNamespace(max_advance_mm=1.0), tracker=SimpleNamespace(field_length_mm=20.0)
    )
    estimate = SimpleNamespace(
        tracked=True,
        precision=np.asarray(precision),
        reading_variance=variance,
        lasting_variance=0.0,
        field_sd=0.0,
        slots=SimpleNamespace(bias=slice(0, 0)),
        nominal=SimpleNamespace(scenario=scenario),
        state=SimpleNamespace(tip=np.array([now, 0.0, 0.0, 0.0, 0.0])),
        axes=1,
    )
    curves = np.asarray(curves)
    return Outlook(GRID, curves, np.zeros((len(curves), 2))), estimate


def two_parameters():
    """An offset and a bend that shows beyond the skin, both uncertain."""
    return np.diag([1.0 / 0.3**2, 1.0 / 0.8**2]), np.stack(
        [np.ones(GRID.size), (np.maximum(GRID, 0.0) / TARGET) ** 2]
    )


def floor(estimate):
    """The part of the miss (mm) that no parameter explains, of a reading and of the path that is left."""
    drift = ol._DRIFT * (TARGET - estimate.state.tip[0])
    return float(np.hypot(ol._UNEXPLAINED * np.sqrt(estimate.reading_variance), drift))


@pytest.mark.parametrize("now", [-20.0, 5.0, 25.0, 34.0])
@pytest.mark.parametrize("variance", [1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_it_agrees_with_a_monte_carlo_of_a_linear_problem(now, variance, bias):
    """Draw parameters, readings up to the last correction, and the miss of a path to the estimated target then.

    bias: standard deviation of a constant error of the readings, a parameter that does not move the tip.
    """
    precision, curves = two_parameters()
    read = curves
    if bias:
        precision = np.diag([*np.diag(precision), bias**-2])
        read, curves = (np.vstack([curves, level * np.ones(GRID.size)]) for level in (1.0, 0.0))
    outlook, estimate = linear(precision, curves, now, variance)
    estimate.slots.bias = slice(2, 3) if bias else slice(0, 0)
    rng, n = np.random.default_rng(1), 20_000
    truth = rng.multivariate_normal(np.zeros(len(curves)), np.linalg.inv(precision), n)
    ahead = read[:, (now < GRID) & (GRID <= TARGET - ol.UNCORRECTED)]
    readings = truth @ ahead + rng.normal(0.0, np.sqrt(variance), (n, ahead.shape[1]))
    gain = np.linalg.solve(precision + ahead @ ahead.T / variance, ahead / variance)
    estimated = readings @ gain.T
    end = curves[:, GRID == TARGET].ravel()
    miss = (truth - estimated) @ end + rng.normal(0.0, floor(estimate), n)
    assert outlook.sd_to_come(estimate, TARGET) == pytest.approx(miss.std(), rel=0.03)


@pytest.mark.parametrize("now", [-20.0, 25.0])
@pytest.mark.parametrize("miss", [0.0, 0.1, 3.0])
def test_in_space_it_is_the_deviation_on_an_axis(now, miss):
    """The same problem on both axes, each with its own parameters: the deviation of either."""
    precision, curves = two_parameters()
    flat, plane = linear(precision, curves, now)
    deep, space = linear(np.kron(np.eye(2), precision), np.concatenate([curves, 1j * curves]), now)
    space.axes = 2
    assert deep.sd_to_come(space, TARGET) == pytest.approx(flat.sd_to_come(plane, TARGET))
    on_an_axis = flat.sd(plane, TARGET, miss, guided=True)
    assert deep.sd(space, TARGET, miss * (1 - 1j), guided=True) == pytest.approx(on_an_axis)


def test_after_the_last_correction_the_uncertainty_stays():
    """No further reading counts."""
    precision, curves = two_parameters()
    outlook, estimate = linear(precision, curves, now=TARGET - ol.UNCORRECTED)
    end = curves[:, GRID == TARGET].ravel()
    expected = np.sqrt(end @ np.linalg.inv(precision) @ end + floor(estimate) ** 2)
    assert outlook.sd_to_come(estimate, TARGET) == pytest.approx(expected)


def test_readings_know_an_error_of_the_field_no_better_than_it_is():
    """An unknown offset, after as many steps as the field's error lasts."""
    outlook, estimate = linear([[0.01**2]], np.ones((1, GRID.size)), now=0.0)
    estimate.field_sd = 0.5
    assert outlook.sd_after(estimate, TARGET, np.array([20.0]))[0] == pytest.approx(0.5, rel=0.01)


@given(
    miss=st.floats(-30.0, 30.0), now=st.floats(-25.0, 39.0), variance=st.floats(1e-6, 1.0),
    sds=st.tuples(st.floats(1e-3, 3.0), st.floats(1e-3, 3.0)), guided=st.booleans(),
)  # fmt: skip
def test_it_is_never_below_the_unexplained_part_and_grows_with_a_miss_that_stays(
    miss, now, variance, sds, guided
):
    """It grows by the miss, and at most by the present uncertainty. A guide that corrects makes it smaller."""
    _, curves = two_parameters()
    outlook, estimate = linear(np.diag(np.array(sds) ** -2.0), curves, now, variance)
    least, sd = (outlook.sd(estimate, TARGET, one, guided=guided) for one in (0.0, miss))
    factor = 0.7 if guided else 1.0
    assert factor * floor(estimate) <= least == factor * outlook.sd_to_come(estimate, TARGET) <= sd
    end = curves[:, GRID == TARGET].ravel()
    uncertain = np.sqrt(end**2 @ np.array(sds) ** 2)
    grown = np.sqrt(max(sd**2 - least**2, 0.0))
    assert grown == pytest.approx(min(abs(miss), uncertain), rel=1e-6, abs=1e-6)
    assert outlook.sd(estimate, TARGET, -miss, guided=guided) == sd


# ---- its derivatives


def ahead_of(estimate, steps=12):
    """Controls (m, 9) with a roll on the way, and the tips (m, 5) of the estimated needle."""
    rows = [Control(db_x=2.0, dg_y=0.05, flip=k == 5) for k in range(steps)]
    state, tips = estimate.state, []
    for row in rows:
        state = estimate.simulator.replay(state, [row])[0]
        tips.append(state.tip)
    return np.array(rows), np.array(tips)


def test_derivatives_just_perturbed_are_renewed_along_the_path_ahead():
    """Each is the difference of two needles moved on, one with another value; the other derivatives are kept."""
    estimate, _ = fitted("all", 50)
    controls, tips = ahead_of(estimate)
    old = Outlook.of(estimate)
    new = old.renew(estimate, predict_ends(estimate, controls[None]))
    passed = (new.grid > tips[0, X]) & (new.grid < tips[-1, X])
    renewed = {one.parameter for one in estimate.perturbed} | {AT.run_out}
    for one in estimate.perturbed:
        simulator = estimate.nominal.with_model(one.model)
        moved, axis = one.state, estimate.state
        expected = []
        for row in controls:
            moved = simulator.replay(moved, [row])[0]
            axis = estimate.simulator.replay(axis, [row])[0]
            expected.append((moved.tip[Y] - axis.tip[Y]) / one.step)
        by_hand = np.interp(new.grid[passed], tips[:, X], expected)
        scale = np.abs(by_hand).max()
        np.testing.assert_allclose(new.curves[one.parameter][passed], by_hand, atol=0.01 * scale + 2e-3)
    for k in set(range(estimate.parameters.size)) - renewed:
        np.testing.assert_array_equal(new.curves[k], old.curves[k])


def test_the_run_out_is_on_the_bevels_side():
    estimate, _ = fitted("run-out", 30)
    controls, tips = ahead_of(estimate)
    curve = Outlook.of(estimate).renew(estimate, predict_ends(estimate, controls[None])).curves[AT.run_out]
    side = estimate.state.bevel.real
    assert np.interp(tips[3, X], estimate.grid, curve) == side
    assert np.interp(tips[9, X], estimate.grid, curve) == -side
