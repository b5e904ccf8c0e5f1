"""Validation of sessions that the model has made: who wins, tables, verdict, figures, page and command."""

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest
import tomli_w

from commands import names
from flexneedle.cli.main import _report_errors
from flexneedle.errors import InputError
from flexneedle.lab.calibration.calibration import calibrate
from flexneedle.lab.calibration.comparison import (
    MODEL,
    Errors,
    errors_ahead,
    fit_nuisances,
    guide_motion,
    predict_fold,
)
from flexneedle.lab.calibration.files import write_calibration
from flexneedle.lab.calibration.folds import Fold
from flexneedle.lab.calibration.prediction import fitting_scenario
from flexneedle.lab.calibration.session import Session
from flexneedle.lab.calibration.validation import Validation, validate
from flexneedle.lab.calibration.validation_report.figures import draw_paths, draw_response
from flexneedle.lab.calibration.validation_report.response import responses
from flexneedle.lab.calibration.verdicts import (
    END,
    PREDICTORS,
    Comparison,
    depth_limits,
    groups_of,
    headline,
    judge,
    judge_coverage,
)
from flexneedle.lab.commands.validate import add_parser
from flexneedle.scenario.files import load_scenario
from report_page import Page, save_nothing
from simulated_session import AXIS, keys, simulate, without_slopes

GEL = load_scenario("gel").with_values({"setup.axes": 2})
AHEAD = (10.0, 20.0)


@pytest.fixture(scope="module")
def session():
    return simulate(8)


@pytest.fixture(scope="module")
def found(session):
    return validate(GEL, session, AHEAD)


def run(capsys, *argv):
    """Return exit status, stdout and stderr of `flexneedle validate`."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["validate", *map(str, argv)])
    status = _report_errors(lambda: args.handler(args))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_the_model_that_made_the_recordings_wins(found):
    assert [one.simple.word for one in found.verdicts[:2]] == ["better"] * 2
    assert [one.regression.word for one in found.verdicts[:2]] == ["better"] * 2
    assert found.verdicts[1].row.median[MODEL] < 0.05
    assert found.verdict[0].startswith(
        "Against predictors that do not know the guide's motion, the model wins 10 and 20 mm"
    )
    for row in found.rows[:2]:
        assert row.group == "all"
        assert row.coverage == pytest.approx(0.95, abs=0.05)


def test_a_model_of_much_softer_tissue_loses_and_says_it(session):
    changes = {"tissue.0.shear_modulus_kpa": 10.0, "setup.guide_to_skin_mm": 11.0}
    soft = validate(GEL.with_values(changes), session, (5.0, 10.0))
    assert [one.simple.word for one in soft.verdicts[:2]] == ["worse"] * 2
    assert "the model loses 5 and 10 mm ahead, guided" in soft.verdict[0]


@pytest.mark.parametrize("angle", [0.6, -2.4])
def test_direction_and_axis_follow_from_the_training_insertions(angle):
    session = simulate(4, angle=angle)
    fitted = fit_nuisances(fitting_scenario(GEL, session), session, 0.0)
    assert np.hypot(*fitted.point[:2]) == pytest.approx(GEL.needle.bevel.offset_mm, rel=1e-3)
    assert np.angle(complex(*fitted.point[:2])) == pytest.approx(angle, abs=0.1)
    np.testing.assert_allclose(fitted.point[2:4], AXIS, atol=1.5e-3)


def test_in_the_plane_the_direction_is_a_sign():
    for angle, sign in ((0.0, 1.0), (np.pi, -1.0)):
        session = simulate(4, axes=1, angle=angle)
        fitted = fit_nuisances(fitting_scenario(GEL, session), session, 0.0)
        assert fitted.point[0] == pytest.approx(sign * GEL.needle.bevel.offset_mm, rel=1e-3)


def test_a_needle_without_a_bevel_has_no_direction():
    session = simulate(4, moves=2.0, **{"needle.bevel.offset_mm": 0.0})
    scenario = fitting_scenario(GEL.with_values({"needle.bevel.offset_mm": 0.0}), session)
    np.testing.assert_allclose(fit_nuisances(scenario, session, 0.0).point[:2], AXIS, atol=1.5e-3)


def test_mirrored_recordings_have_the_same_errors():
    session = simulate(5)
    mirrored = replace(session, recordings=tuple(map(mirror, session.recordings)))
    sizes = [
        errors_ahead(list(predict_fold(Fold(GEL, each.even, each.odd), AHEAD)), 20.0).size
        for each in (session, mirrored)
    ]
    for name in PREDICTORS:
        # The noise of the model is the end of an optimization.
        atol = 0.05 if name == MODEL else 1e-9
        np.testing.assert_allclose(sizes[0][name], sizes[1][name], atol=atol, err_msg=name)


def mirror(one):
    flip = np.array([-1.0, 1.0])
    return replace(one, position=one.position * flip, slope=one.slope * flip, guide=one.guide * flip)


def test_each_session_has_its_own_axis():
    first, second = simulate(4, names=("a",)), simulate(4, names=("b",), seed=1)
    turned = tuple(replace(one, slope=one.slope + 0.05) for one in second.recordings)
    both = Session((*first.recordings, *turned))
    found = validate(GEL, both, AHEAD)
    assert {one.recording.session for one in found.tested} == {"a", "b"}
    for name in ("a", "b"):
        errors = found.errors[20.0]
        assert np.median(errors.size[MODEL][errors.session == name]) < 0.1, name
    groups = [row.group for row in found.rows]
    assert "session a" in groups
    assert "session b" in groups


def test_drift_is_part_of_the_prediction():
    drift = -0.4
    soft = [
        simulate(
            6, seed=3, **{"tissue.0.shear_modulus_kpa": GEL.tissue[0].shear_modulus_kpa * np.exp(drift * n)}
        )
        for n in range(6)
    ]
    session = Session(tuple(each.recordings[n] for n, each in enumerate(soft)))
    errors = [
        np.median(
            errors_ahead(list(predict_fold(Fold(GEL, session.even, session.odd, each), AHEAD)), 20.0).size[
                MODEL
            ]
        )
        for each in (drift, 0.0)
    ]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("axes", [1, 2])
def test_recordings_without_slopes_are_predicted(axes):
    found = validate(GEL, without_slopes(simulate(6, axes=axes)), AHEAD)
    for errors in found.errors.values():
        assert all(np.isfinite(size).all() for size in errors.size.values())
    assert found.rows[0].coverage > 0.85
    assert found.verdicts[1].simple.word == "better"


def test_all_insertions_are_tested_once_by_others(session, found):
    assert sorted((one.recording.session, one.recording.name) for one in found.tested) == sorted(
        keys(session)
    )
    assert [one.place for one in found.tested] == [k / 7 for k in (1, 3, 5, 7, 0, 2, 4, 6)]


def test_a_calibration_and_its_file_have_the_same_validation(session, tmp_path):
    fitted = calibrate(GEL.with_values({"needle.bevel.offset_mm": 0.3}), session.even, ("bevel",))
    write_calibration(fitted, tmp_path / "a.toml", "gel")
    whole, written = (validate(given, session, AHEAD) for given in (fitted, tmp_path / "a.toml"))
    assert whole.sentence == written.sentence == "4 insertions of the fit train, 4 others test"
    assert {one.recording.name for one in whole.tested} == {"a1", "a3", "a5", "a7"}
    assert whole.verdicts[1].simple.word == "better"
    for name in PREDICTORS:
        np.testing.assert_allclose(whole.errors[20.0].size[name], written.errors[20.0].size[name], atol=0.02)


def test_insertions_to_other_depths_are_predicted():
    session = simulate(5)
    short = replace_steps(session.recordings[3], 4)
    found = validate(
        GEL, replace(session, recordings=(*session.recordings[:3], short, session.recordings[4])), AHEAD
    )
    counts = {n: int(np.sum(found.errors[20.0].insertion == n)) for n in range(5)}
    assert sorted(counts.values()) == [1, 10, 10, 10, 10]


def replace_steps(one, count):
    arrays = ("time", "depth", "position", "slope", "guide", "base", "roll")
    return replace(one, **{name: getattr(one, name)[:count] for name in arrays})


def made_errors(model, simple, insertions=8):
    """Return errors of 20 predictions in each insertion, of the model and of all simple predictors."""
    random, size = np.random.default_rng(0), 20 * insertions
    spread = random.uniform(0.9, 1.1, size)
    return Errors(
        np.repeat(np.arange(insertions), 20),
        np.full(size, "a"),
        np.repeat(np.linspace(0.0, 1.0, insertions), 20),
        np.tile(np.arange(20.0) * 5.0, insertions),
        np.arange(size) % 2 == 0,
        {name: (model if name == MODEL else simple + 0.01 * k) * spread for k, name in enumerate(PREDICTORS)},
        np.arange(size)[:, None] % 20 > 0,
    )


def test_the_verdict_names_the_best_simple_predictor_and_the_ratio():
    verdict = judge("all", 20.0, made_errors(0.5, 1.0))
    assert (verdict.simple.against, verdict.regression.against) == ("straight", "regression")
    assert verdict.simple.word == "better"
    assert verdict.simple.low < 0.5 / 1.01 < verdict.simple.high < 0.52
    words = [judge("all", 20.0, made_errors(model, 1.0)).simple.word for model in (1.01, 2.0)]
    assert words == ["not separable", "worse"]
    assert judge("all", 20.0, made_errors(0.5, 1.0, insertions=2)).simple.word == "too few insertions"


def test_a_ratio_whose_interval_has_1_in_it_is_no_win_and_no_loss():
    ends = {
        (0.8, 0.9): "better",
        (0.8, 1.1): "not separable",
        (1.1, 1.3): "worse",
        (0.0, np.inf): "too few insertions",
    }
    assert {each: Comparison("stays", 1.0, 1.0, *each).word for each in ends} == ends


def test_the_regression_is_never_the_best_without_guide_motion():
    errors = made_errors(0.5, 1.0)
    errors.size["regression"][:] = 0.1
    verdict = judge("all", 20.0, errors)
    assert verdict.simple.against == "straight"
    assert (verdict.simple.word, verdict.regression.word) == ("better", "worse")


def test_the_headline_states_wins_and_losses():
    verdicts = [
        judge("guided", ahead, made_errors(model, 1.0))
        for ahead, model in ((5.0, 0.5), (10.0, 0.5), (40.0, 3.0))
    ]
    assert headline(verdicts) == (
        "Against predictors that do not know the guide's motion, the model wins 5 and 10 mm ahead, guided; "
        "it loses 40 mm ahead, guided."
    )


def test_coverage_is_judged(found):
    row = found.rows[0]
    for share, word in ((0.85, "too narrow"), (0.95, "right"), (0.99, "wider than needed")):
        assert judge_coverage([replace(row, coverage=share)]).endswith(
            f"{100 * share:.0f} % of the readings: {word}."
        )


def test_rows_are_medians_and_quantiles_of_their_group(found):
    errors = found.errors[20.0]
    row = next(row for row in found.rows if row.group == "guided, to 25 mm" and row.ahead == 20.0)
    chosen = errors.guided & (errors.depth <= 25.0)
    assert row.count == chosen.sum() > 20
    assert row.median["stays"] == np.median(errors.size["stays"][chosen])
    assert row.most[MODEL] == np.quantile(errors.size[MODEL][chosen], 0.95)
    assert row.coverage == errors.inside[chosen].mean()


def test_groups_by_depth_and_by_order_are_parts_of_all(found):
    errors = found.errors[10.0]
    groups = groups_of(errors, found.deepest)
    for words in ("depth ", " half of a session"):
        parts = np.array([chosen for name, chosen in groups.items() if words in name])
        np.testing.assert_array_equal(parts.sum(axis=0), 1)
    assert depth_limits(101.7) == (20.0, 45.0)
    assert depth_limits(30.0) == (6.0, 14.0)


def test_ends_are_of_insertions_in_which_the_guide_rests(found):
    assert {found.tested[n].recording.name for n in found.ends.insertion} == {"a0", "a1"}
    assert found.rows[-1].group == END
    assert found.ends.size[MODEL].max() < 0.3
    np.testing.assert_array_equal(
        found.ends.depth, [one.recording.depth[0] for one in found.tested if one.to_end]
    )


def test_guide_motion_is_the_largest_after_the_start(session):
    one = replace(session.recordings[0], guide=np.array([[0.0, 0], [3, 0], [3, 4], [0, 0], [0, 1]]))
    moved = guide_motion(one)
    assert moved[0].tolist() == [0.0, 3.0, 5.0, 5.0, 5.0]
    assert moved[1, 2:].tolist() == [4.0, 4.0, 4.0]
    assert moved[3, 4] == 1.0


def test_the_response_to_the_guide_is_the_model_s(found):
    shown = list(responses(found.tested, found.deepest))
    assert len(shown) >= 4
    for one in shown:
        assert one.model == pytest.approx(one.recorded, abs=1.5e-3)
        assert one.low <= one.recorded <= one.high
    assert shown[0].model < -0.01
    doubled = [
        replace(one, recording=replace(one.recording, slope=2.0 * one.recording.slope))
        for one in found.tested
    ]
    for one, twice in zip(shown, responses(doubled, found.deepest), strict=True):
        assert (twice.recorded, twice.low) == pytest.approx((2.0 * one.recorded, 2.0 * one.low))
        assert twice.model == one.model
    assert abs(shown[-1].model) < abs(shown[0].model)


def test_few_motions_of_the_guide_share_few_bins(found):
    tested = [one for one in found.tested if one.recording.guide_moves > 0.0]
    for insertions, bins in ((1, 2), (2, 5)):
        few = Validation(tuple(tested[:insertions]), AHEAD, "")
        assert len(list(responses(few.tested, few.deepest))) == bins
        assert all(one.moves >= 8 for one in responses(few.tested, few.deepest))
        figure = draw_response(few)
        assert (figure is None) == (bins < 3)
    model = next(line for line in figure.axes[0].get_lines() if line.get_label().startswith("model"))
    assert model.get_marker() == "s"


def test_paths_are_labelled_with_the_depth_of_their_step_and_the_guide_moves_in_its_order(found):
    figure = draw_paths(found)
    tip, guide = figure.axes[0], figure.axes[-1]
    starts = [line for line in tip.get_lines() if "predicted from" in line.get_label()]
    for line in starts:
        assert f"predicted from {line.get_xdata()[0]:.0f} mm" in line.get_label()
    assert "predicted from 5 mm, with 95 %" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert guide.get_lines()[0].get_drawstyle() == "steps-pre"
    after = replace(found, tested=tuple(replace(one, guide_order="after") for one in found.tested))
    assert draw_paths(after).axes[-1].get_lines()[0].get_drawstyle() == "steps-post"


def test_wrong_inputs_are_one_line(session):
    with pytest.raises(InputError, match=r"^ahead = 500: no insertion has steps that far apart$"):
        validate(GEL, session, (500.0,))
    for ahead in ((-5.0,), (), (np.nan,)):
        with pytest.raises(InputError, match="must be distances in mm above 0"):
            validate(GEL, session, ahead)
    with pytest.raises(InputError, match="no insertion is left to test"):
        validate(GEL, session.select([True] + [False] * 7))
    with pytest.raises(InputError, match="has no recordings"):
        validate(GEL, session.select([False] * 8))
    assert validate(GEL, session, (500.0, 20.0)).ahead == (20.0,)


def test_the_command_prints_tables_and_verdict_and_writes_the_page(session, tmp_path, capsys):
    session.save(tmp_path / "session")
    status, shown, notes = run(capsys, tmp_path / "session", "gel", "--ahead", "20", "--width", "90mm")
    assert (status, notes) == (0, "")
    assert "each half trains the rest of the model for the other" in shown
    assert "the model wins 20 mm ahead, guided" in shown
    assert f"Page: {tmp_path / 'session' / 'validation' / 'validation.html'}" in shown
    assert "guided, to 25 mm" in shown
    written = [
        "errors.png",
        "errors.svg",
        "paths.png",
        "paths.svg",
        "response.png",
        "response.svg",
        "validation.html",
    ]
    assert names(tmp_path / "session" / "validation") == written


def test_the_page_is_one_file_with_verdict_figures_and_tables(found, tmp_path):
    page = Page(found.write(tmp_path))
    assert found.verdict[0] in page.text
    assert "In closed-loop recordings the guide's motion answers the needle's deviations" in page.text
    assert len(page.all("img")) == 3
    assert all(image["src"].startswith("data:image/") for image in page.all("img"))
    assert not page.all("script") + page.all("link")
    assert len(page.tables) == 4
    for table in page.tables.values():
        assert all(row == table.headings for row in table.labels)


def test_json_has_all_rows(session, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.calibration.validation_report.page.save", save_nothing)
    both = Session((*session.recordings, *(replace(one, session="b") for one in session.recordings)))
    both.save(tmp_path)
    out = tmp_path / "out"
    status, shown, _ = run(capsys, tmp_path, "gel", "--ahead", "20", "--session", "b", "--out", out, "--json")
    values = json.loads(shown)
    assert status == 0
    assert values["insertions"] == 8
    assert {row["group"] for row in values["rows"]} >= {"all", "guided", END}
    assert values["comparisons"][0]["simple"]["word"] == "better"
    assert values["page"] == str(out / "validation.html")


def test_wrong_arguments_of_the_command_are_one_line(session, tmp_path, capsys):
    session.save(tmp_path)
    status, shown, notes = run(capsys, tmp_path, "gel", "--session", "c")
    assert (status, shown, notes) == (2, "", "flexneedle: session = c: must be one of a\n")
    status, _, notes = run(capsys, tmp_path / "none", "gel")
    assert (status, notes.count("\n")) == (2, 1)
    (tmp_path / "bad.toml").write_text(tomli_w.dumps({"name": "x"}))
    assert run(capsys, tmp_path, tmp_path / "bad.toml")[0] == 2


def test_figures_of_a_session_in_which_the_guide_rests(tmp_path):
    found = validate(GEL, simulate(6, axes=1, resting=6), AHEAD)
    page = Page(found.write(tmp_path))
    assert len(page.all("img")) == 2
    assert [one.where for one in found.verdicts] == ["10 mm ahead, all", "20 mm ahead, all", END]
    assert found.plot().get_suptitle() == "Errors of predictions ahead: all predictions"
