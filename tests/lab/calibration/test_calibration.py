"""Calibrations of insertions that the model itself has made: parameters, intervals, and what is not identified."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.lab.calibration.calibration import calibrate
from flexneedle.lab.calibration.criteria import Likelihood, PredictionErrors
from flexneedle.lab.calibration.files import read_record, write_calibration
from flexneedle.lab.calibration.fit import Problem, fit, residuals_at
from flexneedle.lab.calibration.intervals import jackknife
from flexneedle.lab.calibration.parameters import at_same_curvature, make_needle, parameters_of, trial_of
from flexneedle.lab.calibration.prediction import STEEP, Replay, fitting_scenario, shallow
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.files import load_scenario
from flexneedle.types import DB_X, DG_Y
from simulated_session import AXIS, blank, simulate, without_slopes

STIFF = {"tissue.0.shear_modulus_kpa": 660.0, "needle.bevel.offset_mm": 0.4, "setup.guide_to_skin_mm": 18.0}


@pytest.fixture(scope="module")
def guided():
    return simulate(5, resting=1, seed=3, **STIFF)


@pytest.fixture(scope="module")
def fitted(guided):
    return calibrate("gel", guided, ("stiffness", "bevel", "guide"))


def problem_of(session, names=("stiffness", "bevel", "guide")):
    scenario = fitting_scenario(load_scenario("gel"), session)
    return Problem(scenario, parameters_of(scenario, names, 60.0), Replay.of(session))


def test_the_values_of_the_recordings_are_found(fitted):
    trial = fitted.trial
    assert np.log(trial.stiffness[0]) == pytest.approx(np.log(2.0), abs=0.1)
    np.testing.assert_allclose(trial.bevel, 0.4 * np.array([np.cos(0.6), np.sin(0.6)]), atol=0.05)
    assert trial.guide_mm == pytest.approx(18.0, rel=0.03)
    assert fitted.unidentified == {}
    assert fitted.problems == ()
    assert fitted.direction == pytest.approx(0.6, abs=0.15)


def test_intervals_contain_the_values(fitted):
    found = fitted.intervals
    assert found["stiffness of gel"].low <= np.log(2.0) <= found["stiffness of gel"].high
    assert found["guide to skin"].low <= np.log(18.0) <= found["guide to skin"].high


def test_the_axis_of_the_sensor_is_found(fitted):
    place = fitted.fitted.problem.nuisances(0)
    np.testing.assert_allclose(fitted.fitted.point[place][:2], AXIS, atol=3e-3)


def test_errors_of_readings_are_taken_as_such(fitted):
    assert fitted.fitted.criterion is Likelihood


def test_a_model_that_lacks_something_is_fitted_by_its_predictions():
    """The recorded tissue tears, and the fitted one does not."""
    session = simulate(
        4, resting=1, noise=0.002, seed=4, **{"tissue.0.law": "tearing", "tissue.0.yield_mm": 0.1}
    )
    found = calibrate("gel", session, ("stiffness", "bevel"))
    assert found.fitted.criterion is PredictionErrors
    assert found.notes[-1] == "the tissue seems to tear: fit yield, too"


def test_the_scenario_has_the_values_and_priors(fitted):
    scenario = fitted.scenario
    assert scenario.tissue[0].shear_modulus_kpa == pytest.approx(330.0 * fitted.trial.stiffness[0])
    assert scenario.needle.bevel.offset_mm == pytest.approx(np.linalg.norm(fitted.trial.bevel))
    assert scenario.control.adaptive_mpc["modulus_log_sd"] < 0.3


def test_open_loop_insertions_do_not_identify_the_stiffness():
    session = without_slopes(simulate(5, resting=5, seed=5, noise=0.1))
    found = calibrate("gel", session, ("stiffness", "bevel"))
    assert "stiffness of gel" in found.unidentified
    assert "move the guide" in found.unidentified["stiffness of gel"]
    assert found.trial.stiffness[0] == pytest.approx(1.0, abs=1e-3)


def test_the_bevel_is_fitted_at_the_scenarios_stiffness_if_that_is_unknown():
    session = simulate(5, resting=5, seed=5, noise=0.1)
    found = calibrate("gel", session, ("stiffness", "bevel"))
    assert "stiffness of gel" in found.unidentified
    bevel = load_scenario("gel").needle.bevel.offset_mm
    assert np.linalg.norm(found.trial.bevel) == pytest.approx(bevel, rel=0.08)


def test_a_yield_that_is_not_identified_is_none_where_the_scenario_has_none(guided, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.calibration.intervals._NORMAL", 1e3)
    found = calibrate("gel", guided, ("bevel", "yield"))
    assert found.trial.yield_mm is None
    assert found.scenario.tissue[0].law == "ogden"


def test_a_fitted_guide_is_no_farther_than_the_needle_allows(guided):
    """The stroke of the scenario is shortened for it."""
    scenario = load_scenario("gel").with_values({"setup.guide_to_skin_mm": 17.0})
    room = scenario.needle.length_mm - 17.0 + scenario.setup.tip_to_skin_mm
    tight = scenario.with_values({"setup.stroke_mm": room - 0.5})
    found = calibrate(tight, guided, ("stiffness", "bevel", "guide"))
    assert found.trial.guide_mm == pytest.approx(18.0, rel=0.03)
    assert found.scenario.setup.stroke_mm < room - 0.5
    (guide,) = (each for each in found.parameters if each.name == "guide")
    assert guide.value(guide.high) + 60.0 < scenario.needle.length_mm


def test_without_motion_of_the_guide_only_the_bevel_is_identified():
    """However precisely the entry is measured; the bevel has no prior, since it belongs to the stiffness."""
    found = calibrate(
        "gel", simulate(4, resting=4, seed=5, noise=1e-3), ("stiffness", "bevel", "guide", "yield")
    )
    assert set(found.unidentified) == {"stiffness of gel", "guide to skin", "displacement that tears"}
    assert found.trial.stiffness[0] == pytest.approx(1.0, abs=1e-3)
    assert not any("contradict" in note for note in found.notes)
    assert any("holds for the scenario's stiffness only" in note for note in found.notes)
    assert dict(found._priors()) == {}


def test_two_insertions_are_too_few_for_an_interval(guided):
    found = calibrate("gel", guided.select([n in (1, 2) for n in range(5)]), ("stiffness",))
    assert "intervals are too narrow: from fewer than 3 insertions" in found.notes


@pytest.fixture
def stopped(fitted):
    """Return a function that gives the problems of the calibration with changes of its fits."""

    def problems(**changes):
        fits = {name: replace(fitted.fitted, **changes) for name in ("fitted", "final")}
        return replace(fitted, **fits).problems

    return problems


def test_a_fit_that_has_stopped_early_is_reported(fitted, stopped):
    point, sd = fitted.fitted.point, np.sqrt(np.diag(np.linalg.inv(fitted.fitted.information)))
    assert stopped() == ()
    assert stopped(settled=False) == ("the fit did not settle",)
    far = fitted.fitted.errors + fitted.fitted.slopes @ (3.0 * sd * (np.arange(len(sd)) == 0))
    assert stopped(errors=far) == ("the fit did not settle",)
    assert stopped(residuals=replace(fitted.fitted.residuals, converged=False)) == (
        "some steps of the model did not converge",
    )
    start = fitted.fitted.problem.start
    assert "the fit did not move from its start" in stopped(point=start)
    other = replace(fitted.fitted, point=point + 5.0 * sd * (np.arange(len(sd)) == 0))
    (line,) = replace(fitted, others=(other,)).problems
    assert line.startswith("two minima fit alike: stiffness of gel = ")
    assert replace(fitted, others=(replace(other, cost=other.cost + 10.0),)).problems == ()


def test_a_bound_is_reported():
    session = simulate(3, resting=1, seed=3, **STIFF)
    far = load_scenario("gel").with_values({"tissue.0.shear_modulus_kpa": 660.0 / 3e3})
    found = calibrate(far, session, ("stiffness", "bevel"))
    assert any(line.startswith("stiffness of gel is at its upper bound, 1000") for line in found.problems)


def test_the_prior_is_that_of_the_layer_that_is_known_least(guided):
    """One parameter of the controller holds for all layers."""
    (gel,) = load_scenario("gel").values()["tissue"]
    layers = [gel | {"name": "skin", "thickness_mm": 10.0}, gel]
    found = calibrate(load_scenario("gel").with_values({"tissue": layers}), guided, ("stiffness",))
    skin = found.intervals["stiffness of skin"]
    wide = replace(skin, low=skin.value - 1.0, high=skin.value + 1.0, identified=True)
    known = replace(found, intervals=found.intervals | {"stiffness of skin": wide})
    assert dict(known._priors())["control.adaptive_mpc.modulus_log_sd"] == pytest.approx(1.0 / 1.96, rel=0.1)
    unknown = replace(
        found, intervals=found.intervals | {"stiffness of skin": replace(wide, identified=False)}
    )
    assert dict(unknown._priors()) == {}


def turning(slope):
    """Return a recording with these slopes (k,) along y, and a path to match."""
    slope = np.array(slope)
    guide = np.zeros((len(slope), 1))
    return replace(
        blank("a", "0", guide, 5.0 * np.arange(len(slope))),
        slope=slope[:, None],
        position=np.append(0.0, np.cumsum(5.0 * slope[1:]))[:, None],
    )


def test_steps_of_a_needle_that_has_turned_far_are_not_fitted():
    rising = np.linspace(0.0, 2.0 * STEEP, 13)
    (cut,) = shallow(Session((turning(rising),))).recordings
    assert len(cut.depth) == len(cut.slope) == len(cut.guide) == 7
    (unmeasured,) = shallow(without_slopes(Session((turning(rising),)))).recordings
    assert len(unmeasured.depth) == pytest.approx(7, abs=1)
    single = np.where(np.arange(13) == 5, 3.0 * STEEP, 0.0)
    (kept,) = shallow(Session((turning(single),))).recordings
    assert len(kept.depth) == 13
    (shortest,) = shallow(Session((turning(1.0 + rising - (np.arange(13) == 0)),))).recordings
    assert len(shortest.depth) == 2


def test_it_says_that_steps_are_not_used(guided):
    first, *others = guided.recordings
    bent = replace(first, slope=first.slope + np.where(np.arange(len(first.depth)) > 8, 1.0, 0.0)[:, None])
    found = calibrate("gel", replace(guided, recordings=(bent, *others)), ("bevel",))
    assert found.notes[0].startswith("4 of 65 steps are not used: the needle has turned by more than 29°")


def test_a_value_that_the_recordings_contradict_is_not_kept(guided, monkeypatch):
    """Even if they do not determine it."""
    monkeypatch.setattr("flexneedle.lab.calibration.intervals._NORMAL", 1e3)
    far = load_scenario("gel").with_values({"tissue.0.shear_modulus_kpa": 66.0})
    found = calibrate(far, guided, ("stiffness", "bevel"))
    assert "stiffness of gel" in found.unidentified
    assert np.log(found.trial.stiffness[0]) == pytest.approx(np.log(10.0), abs=0.3)
    assert found.notes[0].startswith("stiffness of gel: the recordings do not determine it, but contradict")


def mirrored(session):
    flip = np.array([1.0, -1.0])
    return Session(
        tuple(
            replace(one, position=flip * one.position, slope=flip * one.slope, guide=flip * one.guide)
            for one in session.recordings
        ),
        session.guide_order,
    )


def test_a_mirrored_session_has_the_mirrored_bevel(guided, fitted):
    again = calibrate("gel", mirrored(guided), ("stiffness", "bevel", "guide"))
    np.testing.assert_allclose(again.trial.bevel * [1.0, -1.0], fitted.trial.bevel, atol=2e-3)
    np.testing.assert_allclose(again.trial.stiffness, fitted.trial.stiffness, rtol=5e-3)


def test_drift_from_insertion_to_insertion_is_found():
    session = simulate(5, resting=1, seed=6)
    scenario = fitting_scenario(load_scenario("gel").with_values({"setup.axes": 2}), session)
    parameters = parameters_of(scenario, ("drift",), 60.0)
    trial = trial_of(scenario, parameters, np.array([-0.2]))
    tips, _ = Replay.of(session).predict([make_needle(scenario, trial)])
    drifting = Session(
        tuple(
            replace(one, depth=tip[:, 0], position=tip[:, 1:3], slope=tip[:, 3:5])
            for one, tip in zip(session.recordings, tips[0], strict=True)
        )
    )
    point = fit(Problem(scenario, parameters, Replay.of(drifting)), Likelihood).point
    assert point[0] == pytest.approx(-0.2, abs=0.03)


def test_derivatives_of_residuals_are_those_of_finite_differences(guided):
    problem = problem_of(guided)
    rng = np.random.default_rng(1)
    point = problem.start + 0.3 * rng.standard_normal(len(problem.start)) * np.minimum(problem.sd, 0.1)
    found = residuals_at(problem, point)
    for k in range(len(point)):
        h = 0.02 if k < len(problem.parameters) else 1e-3
        up, down = (
            residuals_at(problem, point + s * h * np.eye(len(point))[k], derivatives=False) for s in (1, -1)
        )
        expected = np.concatenate([a - b for a, b in zip(down.values, up.values, strict=True)]) / (2 * h)
        given = np.concatenate(found.slopes)[:, k]
        assert np.abs(given - expected).max() < 0.1 * np.abs(expected).max() + 1e-6, k


def test_a_point_without_a_recording_is_that_of_a_fit_without_it(guided, fitted):
    found, sd = fitted.fitted, np.sqrt(np.diag(np.linalg.inv(fitted.fitted.information)))[:4]
    for n in (1, 3):
        left = problem_of(guided.select([k != n for k in range(5)]))
        again = fit(left, Likelihood, found.point, found.noise, rounds=1)
        assert (np.abs(again.point - found.without[n])[:4] < 0.6 * sd).all()
        assert (np.abs(again.point - found.point)[:4] > 0.05 * sd).any()


def test_the_variance_of_a_mean_by_jackknife():
    """Without one of n numbers each, the mean has the variance s²/n of the numbers themselves."""
    numbers = np.array([1.0, 4.0, -2.0, 7.0, 0.5])
    without = (numbers.sum() - numbers) / 4.0
    covariance = jackknife(SimpleNamespace(without=without[:, None]))
    assert covariance[0, 0] == pytest.approx(numbers.var(ddof=1) / 5.0)


def test_starts_of_another_stiffness_have_the_same_curvature():
    session = Session((blank("a", "0", np.zeros((25, 1)), 5.0 * np.arange(25)),))
    scenario = fitting_scenario(load_scenario("gel"), session)
    parameters = parameters_of(scenario, ("stiffness", "bevel"), 120.0)
    start = np.array([each.start for each in parameters])
    stiffer = np.add(at_same_curvature(parameters, start, np.log(10.0)), [np.log(10.0), 0.0])
    assert stiffer[1] < 0.5 * start[1]
    needles = [make_needle(scenario, trial_of(scenario, parameters, each)) for each in (start, stiffer)]
    tips, _ = Replay.of(session).predict(needles)
    turns = tips[:, 0, -1, 3] - tips[:, 0, 12, 3]
    assert turns[1] == pytest.approx(turns[0], rel=0.1)


def test_a_roll_during_the_insertion_is_carried_out():
    guide = np.zeros((13, 1))
    one = blank("a", "0", guide, 5.0 * np.arange(13))
    rolled = replace(one, roll=np.where(np.arange(13) > 6, np.pi, 0.0))
    session = Session((one, rolled))
    scenario = fitting_scenario(load_scenario("gel"), session)
    tips, good = Replay.of(session).predict([make_needle(scenario, trial_of(scenario, (), np.array([])))])
    assert good.all()
    bends = tips[0, :, -1, 3] - tips[0, :, 6, 3]
    assert bends[0] > 1e-3
    assert bends[1] < -1e-3


@pytest.mark.parametrize("order", ["before", "with", "after"])
def test_the_guide_moves_before_with_or_after_the_advance(order):
    """By 2 mm between 10 and 15 mm, as commanded one motion after another; orders differ by 9 µm at 15 mm."""
    guide = np.where(np.arange(13) >= 3, 2.0, 0.0)[:, None]
    session = Session((blank("a", "0", guide, 5.0 * np.arange(13)),), order)
    scenario = fitting_scenario(load_scenario("gel"), session)
    needle = make_needle(scenario, trial_of(scenario, (), np.array([])))
    tips, _ = Replay.of(session).predict([needle])

    advance, move = [(1.0, 0.0)] * 5, [(0.0, 2.0)]
    moves = {"before": move + advance, "with": [(1.0, 0.4)] * 5, "after": advance + move}
    steps = [(1.0, 0.0), *2 * advance, *moves[order], *9 * advance]  # from 1 mm before the skin
    commands = np.zeros((1, len(steps), 9))
    commands[0][:, [DB_X, DG_Y]] = steps
    state = needle.simulator.start(needle.roll, (-1.0, 0.0), (0.0,))
    by_hand = needle.simulator.rollout(state, commands, limits=False).tips[0, [-46, -41]]
    np.testing.assert_allclose(tips[0, 0, [3, 4]], by_hand, atol=1e-6)


def test_parameters_that_cannot_be_fitted_are_refused(guided):
    with pytest.raises(InputError, match=r"fit = colour: must be one of stiffness, bevel, guide"):
        calibrate("gel", guided, ("colour",))
    free = load_scenario("gel").with_values({"setup.guide_to_skin_mm": None})
    with pytest.raises(InputError, match=r"fit = guide: the scenario has no guide"):
        calibrate(free, simulate(2, resting=2), ("guide",))
    with pytest.raises(
        InputError, match=r"setup\.guide_to_skin_mm: missing: the guide moves in the recordings"
    ):
        calibrate(free, guided, ("bevel",))
    short = load_scenario("gel").with_values(
        {"needle.length_mm": 80.0, "setup.stroke_mm": 50.0, "target.depth_mm": 30.0}
    )
    with pytest.raises(
        InputError, match=r"needle\.length_mm = 80: too short for recordings to 60\.0 mm and 20 mm"
    ):
        calibrate(short, guided, ("bevel",))
    with pytest.raises(InputError, match="session: has no recordings"):
        calibrate("gel", Session(()), ("bevel",))


def test_the_files_of_a_calibration_are_read_again(fitted, tmp_path):
    path = tmp_path / "calibrated.toml"
    write_calibration(fitted, path, "gel")
    assert load_scenario(path).tissue == fitted.scenario.tissue
    assert path.read_text().startswith("# Calibrated from gel with 5 recorded insertions of a.")
    record = read_record(path)
    assert record["fit"] == ["stiffness", "bevel", "guide"]
    assert record["insertions"] == [list(one.key) for one in fitted.session.recordings]


def test_a_profile_has_its_minimum_at_the_fit(fitted):
    profile = fitted.profile("guide", 3)
    assert profile.values[1] == pytest.approx(fitted.trial.guide_mm, rel=1e-6)
    assert profile.rise[0] > 1.0
    assert profile.rise[2] > 1.0
    assert profile.rise[1] == pytest.approx(0.0, abs=1.0)
    with pytest.raises(InputError, match="profile = colour: must be one of stiffness of gel"):
        fitted.profile("colour")


def test_names_of_the_package():
    assert flexneedle.calibrate is calibrate
