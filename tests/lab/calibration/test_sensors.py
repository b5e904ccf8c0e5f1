"""Calibrations with curvatures of a fibre, which another code has computed from the model's needles."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.calibration.along import AlongPath, Joint, estimate_factors, read_means
from flexneedle.lab.calibration.calibration import calibrate, make_problem
from flexneedle.lab.calibration.criteria import Likelihood
from flexneedle.lab.calibration.fit import fit, paths_along, residuals_at
from flexneedle.lab.calibration.readings import StepReading
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule
from flexneedle.lab.calibration.session import Session
from flexneedle.lab.calibration.validation import validate
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ModelPlant
from flexneedle.scenario.files import load_scenario
from simulated_session import FIBRE, Fibre, measured, simulate, with_curvatures

STIFF = {"tissue.0.shear_modulus_kpa": 1320.0, "needle.bevel.offset_mm": 0.8}
"""Four times the modulus of `gel`, and a needle that bends by up to 3 1/m."""
GEL = load_scenario("gel").with_values({"setup.axes": 2})
TRUE = GEL.with_values(STIFF)
FITTED = GEL.with_values({"sensor": [FIBRE]})
NAMES = ("stiffness", "bevel")


@pytest.fixture(scope="module")
def still():
    """Return insertions with the guide at rest, and the needle rolled by 90° half-way in the last."""
    *others, last = simulate(4, resting=4, seed=3, **STIFF).recordings
    rolled = replace(last, roll=np.where(np.arange(13) > 6, np.pi / 2.0, 0.0))
    session = Session((*others, rolled))
    again = measured(session, TRUE, 0.6, 0.02, np.random.default_rng(8))
    return with_curvatures(Session(tuple(again)), TRUE)


@pytest.fixture(scope="module")
def found(still):
    return calibrate(FITTED, still, NAMES)


def test_curvature_identifies_the_stiffness_with_the_guide_at_rest(still, found):
    alone = calibrate(GEL, still, NAMES)
    assert "stiffness of gel" in alone.unidentified
    assert any("fbg" in note for note in alone.notes)
    assert found.unidentified == {}
    interval = found.intervals["stiffness of gel"]
    assert interval.low <= np.log(4.0) <= interval.high
    assert interval.value == pytest.approx(np.log(4.0), abs=0.35)
    np.testing.assert_allclose(found.trial.bevel, 0.8 * np.array([np.cos(0.6), np.sin(0.6)]), atol=0.12)


def test_both_give_no_wider_intervals_than_each(found):
    rows = slice(found.fitted.tip_errors)
    tip, along, both = (found.fitted.sds_by(part)[:3] for part in (rows, slice(rows.stop, None), slice(None)))
    assert (both <= np.minimum(tip, along) * (1.0 + 1e-9)).all()
    assert along[0] < 0.2
    (label, *widths), *_ = found.by_readings()
    assert label == "stiffness of gel"
    assert widths[2] == f"×÷ {np.exp(1.96 * both[0]):.3g}"


def test_a_roll_turns_the_fibre(still):
    """At the true values the curvatures agree on both sides of the roll."""
    problem = make_problem(FITTED.with_values(STIFF), still, ("bevel",))
    point = problem.start.copy()
    point[:2] = 0.8 * np.cos(0.6), 0.8 * np.sin(0.6)
    for _ in range(2):
        at = residuals_at(problem, point, derivatives=False)
        problem = replace(problem, replay=problem.replay.corrected(at.tips))
    problem = problem.with_means(residuals_at(problem, point, derivatives=False).shapes)
    left = residuals_at(problem, point, derivatives=False).along[3].value
    assert 1e3 * np.abs(left).max() < 0.6  # 1/m: noise, offset, gain and turn of 3 % of 3 1/m
    last, shapes = still.recordings[3], problem.carry_out([point])[2][0, 3]
    unrolled = replace(last, roll=0.0 * last.roll)
    (wrong,) = read_means(3, unrolled, [problem.means[3].fit], shapes, problem.length)
    assert 1e3 * np.abs(wrong.bins.value - problem.means[3].bins.value).max() > 2.0


def test_without_readings_the_fit_is_that_of_the_tip(still):
    bare = replace(still, recordings=tuple(replace(one, readings=()) for one in still.recordings))
    with_sensor, without = (calibrate(scenario, bare, NAMES).fitted.point for scenario in (FITTED, GEL))
    np.testing.assert_array_equal(with_sensor, without)


def test_errors_of_the_fibre_are_found():
    """Of a needle whose stiffness and bevel are known."""
    errors = Fibre(noise=0.01, offset=0.1, gains=(1.0, 1.1, 0.9, 1.05), turn=0.1)
    session = with_curvatures(simulate(4, resting=1, seed=5, angle=0.0, **STIFF), TRUE, 0.0, errors)
    wide = FIBRE | {"gain_sd": 0.2, "turn_sd_deg": 20.0}
    ended = fit(make_problem(TRUE.with_values({"sensor": [wide]}), session, ()), Likelihood)
    slots = ended.problem.means[0].fit.slots
    np.testing.assert_allclose(1.0 + ended.point[slots.gain], errors.gains, atol=0.03)
    assert ended.point[slots.turn] == pytest.approx(0.1, abs=0.02)


def test_derivatives_are_those_of_finite_differences(still):
    rolled = replace(still.recordings[0], roll=np.where(np.arange(13) > 6, 1.0, 0.0))
    problem = make_problem(FITTED, replace(still, recordings=(rolled,)), NAMES)
    drawn = np.random.default_rng(1).standard_normal(len(problem.start))
    point = problem.start + 0.3 * drawn * np.minimum(problem.sd, 0.1)
    problem = problem.with_means(residuals_at(problem, point, derivatives=False).shapes)
    given = residuals_at(problem, point).along[0].slopes
    for k in range(len(point)):
        h = 0.02 if k < len(problem.parameters) else 0.1 * min(problem.sd[k], 0.1)
        up, down = (
            residuals_at(problem, point + s * h * np.eye(len(point))[k], derivatives=False).along[0].value
            for s in (1, -1)
        )
        expected = (down - up) / (2.0 * h)
        assert np.abs(given[:, k] - expected).max() < 0.1 * np.abs(expected).max() + 1e-9, k


def test_residuals_have_the_covariance_of_their_errors(still):
    """Against many draws of noise, offset and drift of an insertion."""
    problem = make_problem(FITTED, still, NAMES)
    problem = problem.with_means(residuals_at(problem, problem.start, derivatives=False).shapes)
    path = paths_along(problem, residuals_at(problem, problem.start))[0]
    rng, fibre, depth = np.random.default_rng(0), FITTED.sensor[0], still.recordings[0].depth
    size, draws = 8, 20000
    noise = rng.normal(0.0, fibre.noise / np.sqrt(2.0), (draws, len(depth), size))
    offset = rng.normal(0.0, fibre.offset_sd, (draws, 1, size))
    grown = np.sqrt(np.diff(np.maximum(depth, 0.0), prepend=0.0) / FITTED.target.depth_mm)
    drift = fibre.drift_sd * np.cumsum(grown[:, None] * rng.normal(size=(draws, len(depth), 2)), axis=1)
    drawn = (noise + offset + np.tile(drift, 4)).reshape(draws, -1)
    given = np.diag(path.white) + path.fixed
    np.testing.assert_allclose(given, np.cov(drawn.T), atol=0.05 * given.max())


def test_the_error_of_a_shape_counts_once_in_a_session():
    """The mean of 12 points in each of 4 insertions has the variance of one; distant sites are independent."""
    points = load_scenario("gel").with_values({"sensor": [{"kind": "points", "to_mm": 60.0}]}).sensor[0]
    path = AlongPath(0, "points", np.ones(12), 0.04 * np.eye(12), np.zeros((12, 12)), 4 * points.alike)
    shown = path.covariance(np.array([0.0, 1.0]), path.alike)
    assert np.mean(shown) / 4 == pytest.approx(0.04)
    fibres = [
        FITTED.sensor[0].model_copy(update={"sites_mm": sites})
        for sites in ((8.0, 20.0, 45.0, 80.0), range(1, 102))
    ]
    assert [fibre.alike for fibre in fibres] == [1, 21]


def test_a_noisier_fibre_counts_less():
    """Factors on the noise follow the residuals."""
    session = simulate(4, resting=4, seed=3, angle=0.0, **STIFF)
    known, factors = TRUE.with_values({"sensor": [FIBRE]}), []
    for noise in (0.05, 0.25):
        again = with_curvatures(session, TRUE, 0.0, Fibre(noise=noise))
        factors.append(fit(make_problem(known, again, ()), Likelihood).factors["fbg"][0])
    np.testing.assert_allclose(factors, [1.0, 5.0], rtol=0.15)
    assert estimate_factors((), (), {}) == {}


def test_outliers_hardly_move_the_fit(still, found):
    one = still.recordings[1]
    far = ((0.05, -0.05),) * 4
    wild = tuple(each._replace(rows=far) if each.step == 6 else each for each in one.readings)
    wrong = replace(one, readings=wild)
    session = replace(still, recordings=(still.recordings[0], wrong, *still.recordings[2:]))
    again = calibrate(FITTED, session, NAMES)
    assert again.fitted.point[0] == pytest.approx(found.fitted.point[0], abs=0.15)


def test_the_loss_of_a_residual_grows_linearly_beyond_a_few_deviations():
    class Squares:
        rows, constant = (), 0.0

        def rho(self, squares):
            return np.stack([squares, np.ones_like(squares), 0.0 * squares])

    joint = Joint(Squares(), [np.eye(2)], 0.0)
    loss, slope, bend = joint.rho(np.array([9.0, 1e-6, 1e6]))
    assert loss[:2] == pytest.approx([9.0, 1e-6])
    assert loss[2] == pytest.approx(4.0 * 1e3, rel=0.01)
    h = 1e-3
    up, down = (joint.rho(np.array([9.0, more, 1e6 + more]))[0][1:] for more in (h, 0.0))
    np.testing.assert_allclose(slope[1:], (up - down) / h, rtol=1e-3)
    assert (bend[1:] < 0.0).all()


def test_a_validation_compares_curvatures_with_the_model_s_needle():
    """Two readings of a step have the noise over √2; a model of softer tissue is further off."""
    session = with_curvatures(simulate(4, resting=1, **STIFF), TRUE, 0.6, Fibre(noise=0.25))
    right, soft = (validate(each.with_values({"sensor": [FIBRE]}), session, (20.0,)) for each in (TRUE, GEL))
    (row,), (wrong,) = right.sensors, soft.sensors
    assert (row.sensor, row.unit, row.insertions, row.values) == ("fbg", "1/m", 4, 4 * 13 * 8)
    assert row.rms == pytest.approx(0.25 / np.sqrt(2.0), rel=0.1)
    assert row.expected == pytest.approx(
        np.hypot(0.05 / np.sqrt(2.0), 0.1), rel=0.5
    )  # and 5 % of up to 3 1/m
    assert wrong.rms > 2.0 * row.rms
    assert right.values()["sensors"][0]["rms"] == row.rms
    assert not list(right.notes)
    bare = validate(TRUE, session, (20.0,))
    assert "sensors" not in bare.values()
    assert next(iter(bare.notes)).startswith("readings of fbg are not compared")


def test_rows_of_another_shape_are_refused_in_one_line(still):
    one = replace(still.recordings[0], readings=(StepReading("fbg", 3, ((0.1, 0.2),)),))
    with pytest.raises(InputError, match="a/a0: readings of fbg: 1 rows of 2 numbers"):
        calibrate(FITTED, replace(still, recordings=(one,)), NAMES)


def test_a_rehearsal_measures_with_the_sensors_of_its_scenario():
    sensors = [FIBRE, {"kind": "slice", "plane_mm": 20.0}]
    scenario = load_scenario("gel").with_values({"sensor": sensors, "target.depth_mm": 60.0})
    schedule = Schedule(np.linspace(0.0, 60.0, 13), np.zeros((13, 1)))
    session = Rehearsal(Truth(scenario), np.random.default_rng(0), plant=ModelPlant).record([schedule] * 2)
    for one in session.recordings:
        counts = {
            name: [each.step for each in one.readings if each.sensor == name and np.isfinite(each.rows).all()]
            for name in ("fbg", "slice")
        }
        assert all(7 <= counts["fbg"].count(step) <= 10 for step in range(13))  # some are missing
        assert min(counts["slice"]) in (4, 5)  # the plane is at 20 mm, the needle bent
        assert {np.shape(each.rows) for each in one.readings if each.sensor == "fbg"} == {(4, 1)}
