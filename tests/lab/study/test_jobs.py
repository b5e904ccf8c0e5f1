"""Results of a worker: one row per insertion, also for a failure; plans and the journal."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.lab.study import jobs
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.jobs import InsertionJob, make_plan, run_job
from flexneedle.lab.study.journal import StudyJournal
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs
from flexneedle.record.results import RESULT_COLUMNS
from flexneedle.types import DG_Y, ROLL, Verdict, VerdictKind


@pytest.fixture(scope="module")
def point(quick):
    return load_study(quick).points[0]


@pytest.fixture(scope="module")
def plan(point):
    return flexneedle.plan(point.scenario)


def only_row(job):
    (row,) = run_job(job)
    return row


def test_a_row_has_the_results_of_the_insertion(point, plan):
    insertion = flexneedle.insert(
        point.scenario,
        plan,
        11,
        controller=point.controller,
        rig=flexneedle.VirtualRig(point.plant),
        threads=1,
    )
    row = only_row(InsertionJob(point, plan, "", ((3, 11),)))
    last = insertion.periods[-1]
    applied = np.array([period.applied for period in insertion.periods])
    assert row["index"] == 3
    assert row["true_error_mm"] == insertion.true_error_mm == math.dist(last.true_tip[:3], plan.target)
    assert row["residual_mm"] == insertion.residual_mm
    assert (row["tip_x_mm"], row["tip_y_mm"]) == last.true_tip[:2]
    assert row["flips"] == np.count_nonzero(applied[:, ROLL])
    assert row["strain_energy_mj"] == last.true_strain_energy
    inside = np.array([period.true_tip.x for period in insertion.periods]) > 0.0
    assert row["guide_travel_mm"] == pytest.approx(np.abs(applied[inside, DG_Y]).sum(), rel=1e-12)
    assert row["peak_energy_uj"] == 1e3 * max(period.true_strain_energy for period in insertion.periods)
    assert row["planned_mean_energy_uj"] == plan.invasiveness.mean_energy_uj
    assert row["least_stretch"] == min(period.true_stretch for period in insertion.periods) < 1.0
    assert (row["periods"], row["planned_periods"]) == (len(applied), len(plan.controls))
    assert (row["planned_flips"], row["planned_error_mm"]) == (plan.flips, plan.error_mm)
    assert row["planned_strain_energy_mj"] == plan.strain_energy[-1]
    assert (row["unconverged_periods"], row["outcome"], row["reason"]) == (0, "done", insertion.reason)
    assert row["total_s"] > row["control_s"] + row["plant_s"] > 0.0


def test_a_plan_that_misses_is_refused_in_a_row_without_results(point, plan):
    tips = plan.tips + np.array([0.0, 1.5, 0.0, 0.0, 0.0])
    point = replace(point, controller="open-loop")
    row = only_row(InsertionJob(point, replace(plan, tips=tips, limit="some limit"), "", ((0, 11),)))
    assert row["outcome"] == "refused"
    assert row["reason"].startswith("plan misses the target by 1.")
    assert row["true_error_mm"] is row["periods"] is row["flips"] is None
    assert row["planned_error_mm"] == pytest.approx(1.5, abs=0.1)


def test_an_error_in_one_insertion_is_recorded_and_the_others_continue(point, plan, monkeypatch):
    def insert(scenario, made, seed, **options):
        if seed == 11:
            raise ZeroDivisionError("no\nwhere to go")
        return flexneedle.insert(scenario, made, seed, **options)

    monkeypatch.setattr(jobs, "insert", insert)
    broken, fine = run_job(InsertionJob(point, plan, "", ((0, 11), (1, 12))))
    assert (broken["outcome"], broken["reason"]) == ("error", "ZeroDivisionError: no where to go")
    assert broken["true_error_mm"] is None
    assert broken["planned_periods"] == len(plan.controls)
    assert fine["outcome"] == "done"


def test_a_planner_failure_is_recorded_in_each_row(point, monkeypatch):
    def fail(*_args, **_options):
        raise FloatingPointError("overflow")

    monkeypatch.setattr(jobs, "plan", fail)
    refusal = make_plan(point).refusal
    row = only_row(InsertionJob(point, None, refusal, ((0, 11),)))
    assert (row["outcome"], row["reason"]) == ("error", "no plan: FloatingPointError: overflow")
    assert row["planned_periods"] is None


def test_nan_is_null(point, plan, monkeypatch):
    def insert(*args, **options):
        insertion = flexneedle.insert(*args, **options)
        return replace(
            insertion,
            periods=tuple(replace(p, verdict=Verdict(VerdictKind.MISSING)) for p in insertion.periods),
        )

    monkeypatch.setattr(jobs, "insert", insert)
    row = only_row(InsertionJob(point, plan, "", ((0, 11),)))
    assert row["residual_mm"] is None
    assert row["true_error_mm"] is not None


@pytest.mark.parametrize(
    ("keys", "same"),
    [
        (("phantom.run_out_mm", "control.ce_mpc.samples", "tracker.jitter_mm"), True),
        (("target.depth_mm", "plan.samples", "setup.max_guide_travel_mm"), False),
        (("needle.bevel.offset_mm", "tissue.1.alpha", "contact.spacing_mm"), False),
    ],
)
def test_points_with_the_same_planner_inputs_share_a_plan(point, keys, same):
    own = digest_plan_inputs(point)
    for key in keys:
        scenario = point.scenario.with_values({key: 9})
        other = replace(point, scenario=scenario, controller="x", plant="y", case="z")
        assert (digest_plan_inputs(other) == own) is same, key
    for separate in (replace(point, strategy="steering"), replace(point, plan_seed=1)):
        assert digest_plan_inputs(separate) != own


def test_a_plan_is_read_from_disk_unchanged(point, tmp_path):
    planned = make_plan(point)
    StudyPlans(tmp_path).keep("a", planned)
    kept = StudyPlans(tmp_path)
    made = flexneedle.plan(point.scenario)
    for name in ("controls", "tips", "shapes", "strain_energy", "guide"):
        np.testing.assert_array_equal(getattr(kept.plan("a"), name), getattr(made, name))
    assert kept.seconds("a") == planned.seconds > 0.0
    assert kept.plan("b") is None


def test_a_damaged_plan_is_an_error_with_its_path(tmp_path):
    (tmp_path / "a.json").write_text('{"seconds": 1}')
    (tmp_path / "b.json").mkdir()
    for key, reason in (("a", "damaged: KeyError: 'plan'"), ("b", "cannot be read: Is a directory")):
        with pytest.raises(InputError, match=rf"{key}\.json: {reason}: remove it to plan again"):
            StudyPlans(tmp_path).plan(key)
    with pytest.raises(InputError, match=r"a\.json: not a folder, needed for the plans"):
        StudyPlans(tmp_path / "a.json")


UNKNOWN = dict.fromkeys(RESULT_COLUMNS) | {"warning": "", "outcome": "held", "reason": ""}
ROWS = [
    UNKNOWN | {"index": 4, "true_error_mm": 0.1 + 0.2, "tip_x_mm": 5e-324, "total_s": 1.5},
    UNKNOWN | {"index": 1, "tip_y_mm": -0.0, "tip_x_mm": 1e308, "flips": 3, "reason": "µ\n"},
]


def test_rows_are_read_from_the_journal_with_all_digits(tmp_path):
    with StudyJournal(tmp_path / "j", 5) as journal:
        journal.add(ROWS)
    with StudyJournal(tmp_path / "j", 5) as journal:
        assert [json.dumps(journal.rows[row["index"]]) for row in ROWS] == [json.dumps(row) for row in ROWS]


@pytest.mark.parametrize("kept", [1, 20, -1])
def test_an_incomplete_last_line_is_dropped_and_the_journal_continues(tmp_path, kept):
    path = tmp_path / "j"
    with StudyJournal(path, 5) as journal:
        journal.add(ROWS)
    first, second = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + second[:kept])
    with StudyJournal(path, 5) as journal:
        assert list(journal.rows) == [4]
        journal.add([ROWS[1]])
    assert path.read_bytes() == first + second


def line(**changed):
    return json.dumps(ROWS[0] | changed)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"index": ', "not a row in JSON"),
        ("[3]", "not a row in JSON"),
        ('{"index": 3}', "true_error_mm: missing"),
        ("{}", "index: must be a whole number from 0 to 4"),
        *(
            (line(index=index), f"index = {json.dumps(index)}: must be a whole number from 0 to 4")
            for index in (5, -1, True, 1.0)
        ),
    ],
)
def test_a_damaged_journal_is_rejected_with_the_line_and_not_modified(tmp_path, text, message):
    path = tmp_path / "j"
    path.write_text(f"{line()}\n{text}\n{line(index=3)}\n")
    before = path.read_bytes()
    with pytest.raises(InputError) as caught:
        StudyJournal(path, 5)
    assert str(caught.value) == f"{path}: damaged at line 2: {message}"
    assert path.read_bytes() == before


def test_only_one_process_writes_a_journal(tmp_path):
    with (
        StudyJournal(tmp_path / "j", 5),
        pytest.raises(InputError, match="another process is writing to this study"),
    ):
        StudyJournal(tmp_path / "j", 5)
    with StudyJournal(tmp_path / "j", 5) as again:
        assert again.rows == {}


def test_a_stored_plan_keeps_the_entry_that_it_has_chosen(point, tmp_path):
    """And points that differ in their zones have separate plans."""
    free = replace(point, scenario=point.scenario.with_values({"entry.free_slope_mrad": 100.0}))
    zone = {"shape": "sphere", "name": "artery", "center_mm": [20.0, 9.0, 0.0], "radius_mm": 1.0}
    zoned = replace(free, scenario=free.scenario.with_values({"zone": [zone]}))
    wide = replace(free, scenario=zoned.scenario.with_values({"zones.margin_mm": 3.0}))
    keys = [digest_plan_inputs(each) for each in (free, zoned, wide)]
    assert len({*keys}) == 3
    StudyPlans(tmp_path).keep(keys[1], make_plan(zoned))
    stored = StudyPlans(tmp_path).plan_for(keys[1], zoned)
    assert not stored.scenario.entry.free
    assert stored.tips[0, 1] == pytest.approx(stored.scenario.entry.lateral(stored.tips[0, 0]).real)
