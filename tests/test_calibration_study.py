"""studies/calibration.py: the sets and loops, what is counted, and that a second run continues the first."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import calibration
import calibration_sensors
from calibration import Choice
from flexneedle.errors import InputError
from flexneedle.lab.calibration.intervals import Interval
from flexneedle.lab.calibration.parameters import Trial
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule, SensorErrors
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ModelPlant


@pytest.mark.parametrize(("number", "kind"), [(0, None), (1, None), (0, "wide")])
def test_worlds_have_a_guide_and_one_layer(number, kind):
    scenario = calibration.guided_world(number, kind)
    assert scenario.setup.has_guide
    assert len(scenario.tissue) == 1
    assert scenario.name.startswith("Wide") == (number == 1 or kind == "wide")


def test_true_values_are_factors_of_the_scenario():
    scenario = calibration.guided_world(0, "world")
    true = calibration.with_true_values(scenario, 4.0, 0.5, 0.07)
    assert true.tissue[0].shear_modulus_kpa == 4.0 * scenario.tissue[0].shear_modulus_kpa
    assert true.needle.bevel.offset_mm == 0.5 * scenario.needle.bevel.offset_mm
    assert true.phantom.guide_clearance_mm == 0.07


def end_error(recorded, predicted):
    """The end error of a prediction with factors on stiffness and bevel, of an insertion with others."""
    scenario, plan = (
        calibration.guided_world(0, "world"),
        Schedule(np.linspace(0.0, 50.0, 11), np.zeros((11, 1))),
    )
    truth = Truth(calibration.with_true_values(scenario, *recorded, 0.0))
    session = Rehearsal(truth, np.random.default_rng(1), SensorErrors(0.0, 0.0), ModelPlant).record([plan])
    bevel = np.array([predicted[1] * scenario.needle.bevel.offset_mm])
    guide = scenario.setup.guide_to_skin_mm
    return calibration.end_error(
        scenario, session, Trial(np.array(predicted[:1]), bevel, guide, 0.0, None, 0.0)
    )


def test_the_true_values_predict_the_end_and_wrong_ones_do_not():
    assert end_error((2.0, 1.0), (2.0, 1.0)) < 1e-3
    assert end_error((2.0, 1.0), (1.0, 1.0)) > 0.2
    assert end_error((2.0, 1.0), (2.0, 1.3)) > 0.2


def test_ends_are_compared_at_the_same_depth():
    """A strongly bent needle is shorter than its advance."""
    assert end_error((20.0, 1.0), (20.0, 1.0)) < 1e-3


def fitted(stiffness, bevel):
    """A calibration with these intervals."""
    intervals = {"stiffness of gel": Interval(*stiffness, True), "bevel": Interval(*bevel, False)}
    return SimpleNamespace(intervals=intervals, problems=("stuck",), unidentified={"bevel": "advice"})


@pytest.mark.parametrize(("true", "covered"), [(1.0, True), (0.79, False), (1.41, False)])
def test_a_fit_is_judged_by_its_errors_and_intervals(true, covered):
    row = calibration.judge(fitted((1.1, 0.8, 1.4), (2.0, 1.0, 3.0)), {"stiffness": true, "bevel": 2.5})
    assert row["stiffness_error"] == pytest.approx(1.1 - true)
    assert (row["stiffness_covered"], row["stiffness_identified"]) == (covered, True)
    assert (row["bevel_error"], row["bevel_covered"], row["bevel_identified"]) == (-0.5, True, False)
    assert (row["problems"], row["unidentified"]) == (["stuck"], ["bevel"])


def set_row(error, covered, identified, ends, problems=()):
    return {
        "stiffness_error": error, "stiffness_covered": covered, "stiffness_identified": identified,
        "bevel_covered": True, "end_error_mm": ends, "problems": list(problems),
    }  # fmt: skip


def test_the_summary_of_sets_counts_identified_stiffnesses_only():
    rows = [
        set_row(0.3, True, True, [0.2, 0.1]),
        set_row(-0.4, False, True, [0.4, 0.3], ["stuck"]),
        set_row(9.0, True, False, [0.3, 0.2]),
    ]
    text = calibration.summarize_sets(rows)
    assert "|sets|3|" in text
    assert "|stiffness identified|2|" in text
    assert "stiffness|0.354|" in text
    assert "stiffness that cover the true value|50 %|" in text
    assert "bevel that cover the true value|100 %|" in text
    assert "|0.300, 0.200, ratio 1.50|" in text
    assert "|fits with problems|1|" in text


def loop_row(before, after, identified=True):
    ends = [{"error_mm": each, "peak_energy_uj": 100.0 * each, "outcome": "done"} for each in (before, after)]
    ends[1]["outcome"] = "done" if after < 1.0 else "held"
    return {"as_is": ends[0], "calibrated": ends[1], "stiffness_identified": identified, "problems": []}


def test_the_summary_of_loops_compares_both_errors():
    text = calibration.summarize_loops([loop_row(0.5, 0.1), loop_row(0.3, 0.2), loop_row(0.4, 2.1, False)])
    assert "|0.400, 0.800, ratio 2.00|" in text
    assert "|median error (mm)|0.400, 0.200|" in text
    assert "|median peak energy (µJ)|40, 20|" in text
    assert "|insertions that ended as planned|3, 2|" in text
    assert "|worlds with a smaller error after calibration|2|" in text
    assert "|stiffness not identified|1|" in text


def test_a_second_run_skips_the_numbers_in_the_file(tmp_path, monkeypatch, capsys):
    asked = []

    def run_all(part, numbers, choice, jobs):
        asked.append((part, list(numbers), choice, jobs))
        return [{"number": number, **set_row(0.1, True, True, [0.2, 0.1])} for number in asked[-1][1]]

    monkeypatch.setattr(calibration, "run_all", run_all)
    out = ["--out", str(tmp_path / "rows.jsonl")]
    assert calibration.main(["sets", "--count", "2", *out]) == 0
    assert (
        calibration.main(["sets", "--count", "4", "--fit", "bevel", "--kind", "wide", "--jobs", "2", *out])
        == 0
    )
    assert calibration.main(["sets", "--first", "5", "--count", "1", *out]) == 0
    assert [each[1] for each in asked] == [[0, 1], [2, 3], [5]]
    assert (asked[1][2], asked[1][3]) == (Choice(("bevel",), "wide"), 2)
    rows = [json.loads(line)["number"] for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert rows == [0, 1, 2, 3, 5]
    assert capsys.readouterr().out.count("|sets|4|") == 1


def test_a_failure_is_a_row_and_the_exit_status(monkeypatch, capsys):
    def fail(_number, _choice):
        raise InputError("no recordings")

    _, *others = calibration.PARTS["sets"]
    monkeypatch.setitem(calibration.PARTS, "sets", (fail, *others))
    row = calibration.run_one("sets", 7, Choice(("bevel",)))
    assert (row["number"], "no recordings" in row["error"]) == (7, True)
    monkeypatch.setattr(
        calibration, "run_all", lambda *_: [row, {"number": 1, **set_row(0.1, True, True, [1, 1])}]
    )
    assert calibration.main(["sets", "--count", "2"]) == 1
    assert "1 of 2 failed" in capsys.readouterr().out


def test_a_set_is_fitted():
    row = calibration.fit_set(0, Choice(calibration.FIT))
    assert row["stiffness_covered"]
    assert abs(row["stiffness_error"]) < 0.1
    assert max(row["end_error_mm"]) < 0.1
    assert row["end_error_mm"][0] != row["end_error_mm"][1]


@pytest.mark.parametrize("same_bevel", [False, True])
def test_both_loops_are_on_the_stiffer_phantom_and_have_its_curvature_unless_asked(monkeypatch, same_bevel):
    found = fitted((4.0, 3.0, 5.0), (1.0, 0.5, 1.5))
    found.scenario = "calibrated"
    monkeypatch.setattr(calibration, "calibrate", lambda *_: found)
    monkeypatch.setattr(calibration, "steer", lambda scenario, phantom, seed: (scenario, phantom, seed))
    row = calibration.close_loop(0, Choice(calibration.FIT, "world", same_bevel))
    scenario = calibration.guided_world(0, "world")
    (first, phantom, seed), (second, other, again) = row["as_is"], row["calibrated"]
    assert (first, second, seed, again) == (scenario, "calibrated", 0, 0)
    assert phantom is other
    factor = row["true"]["stiffness"]
    assert 10.0 < factor < 100.0
    layers = [each.tissue[0].shear_modulus_kpa for each in (phantom.scenario, scenario)]
    assert layers[0] == pytest.approx(factor * layers[1])
    offset = scenario.needle.bevel.offset_mm * (1.0 if same_bevel else factor**-0.75)
    low, high = scenario.phantom.bevel_factor
    assert low * offset <= row["true"]["bevel"] <= high * offset


@pytest.mark.long
def test_a_calibrated_loop_is_more_accurate_on_the_same_phantom():
    row = calibration.close_loop(0, Choice(calibration.FIT, "world"))
    assert row["true"]["stiffness"] > 10.0
    assert row["calibrated"]["error_mm"] < 0.5 * row["as_is"]["error_mm"]


def test_sensors_are_placed_for_the_depth_of_the_insertions():
    scenario = calibration.guided_world(0, "world")
    sensors = [
        calibration_sensors.with_sensor(scenario, kind, 50.0).sensor for kind in calibration_sensors.SENSORS
    ]
    assert [[each.kind for each in one] for one in sensors] == [[], ["fbg"], ["points"], ["slice"]]
    assert (sensors[2][0].to_mm, sensors[3][0].plane_mm) == (50.0, 20.0)


def test_the_table_of_sensors_counts_identified_stiffness_only():
    row = {"spread": [0.4, 0.2, 0.1], "bevel_covered": True, "problems": [], "bent": 0.6}
    known = row | {"stiffness_identified": True, "stiffness_error": 0.3, "stiffness_covered": True}
    other = known | {"stiffness_identified": False, "stiffness_error": 9.0, "stiffness_covered": False}
    rows = [
        {"guide": guide, "kind": kind, **each}
        for guide in calibration_sensors.GUIDES
        for kind in calibration_sensors.SENSORS
        for each in (known, other)
    ]
    lines = calibration_sensors.summarize(rows).splitlines()
    assert lines[11] == "Fibre at rest, curvature from 0.5 1/m: 1 of 2 identified, rms error 0.300"
    assert lines[2] == "|at rest|tip alone|2|1|0.300|100 %|100 %|0.40, 0.20, 0.10|0|"
