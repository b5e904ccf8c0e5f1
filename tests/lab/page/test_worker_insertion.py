"""Insertions of the page's worker: the same as those of `flexneedle.insert`, at any pace."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.lab.page.job_orders import JobChange
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.page.server.runs_folder import RunsFolder
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource
from flexneedle.lab.page.worker import recordings
from flexneedle.lab.page.worker.disturbances import DisturbedPlant, Disturber
from flexneedle.lab.page.worker.insertion_jobs import InsertionJobs
from flexneedle.lab.page.worker.recordings import read_run, row_of
from flexneedle.lab.page.worker.task import Cancelled
from flexneedle.phantom.draw import draw
from flexneedle.record.export import mark_columns
from flexneedle.record.saving import save
from page_tasks import NO_WAIT, Reported, done, short, task

TIMED = {"decide_ms"}
REFERENCES = ("ref1", "ref2", "ref3")


def plain(rows):
    """Rows without what the wall clock decides; NaN is None."""
    return [row.model_dump(exclude=TIMED, mode="json") for row in rows]


@pytest.fixture(scope="module")
def by_command():
    """The insertion of `flexneedle.insert`."""
    plan = flexneedle.plan(short(), seed=3)
    return flexneedle.insert(short(), plan, 3)


@pytest.fixture(scope="module")
def inserted():
    """The worker of a finished insertion, and what it has reported."""
    worker, one = InsertionJobs(), task("insert", "insertion", seed=3)
    worker.insert(one)
    return worker, one.report


def advancing(signals, count):
    for _ in range(count):
        signals.take(JobChange(job=1, advance=True))


def test_rows_are_those_of_the_command(inserted, by_command):
    rows = inserted[1].rows
    assert plain(rows) == plain(row_of(period, by_command.plan) for period in by_command.periods)
    assert len(rows) == len(by_command.periods) > 12


def test_the_indicator_is_the_largest_of_the_references(by_command):
    assert {row_of(period, by_command.plan).indicator for period in by_command.periods} == {None}
    scenario = short(**{"tracker.environment": "ideal", "monitor.enabled": False})
    plan = flexneedle.plan(scenario, seed=3)
    for period in flexneedle.insert(scenario, plan, 3).periods:
        frames = [checked.measurement.frame for checked in period.readings]
        by_name = {name: [frame.readings[name].indicator for frame in frames] for name in REFERENCES}
        medians = [np.median([one for one in values if one is not None]) for values in by_name.values()]
        assert row_of(period, plan).indicator == pytest.approx(max(medians), rel=1e-12)


def test_the_indicator_of_the_tip_counts_only_without_references():
    """The monitor judges the field by the references, too."""
    plan = flexneedle.plan(scenario := short(**{"tracker.environment": "ideal"}), seed=3)
    period = flexneedle.insert(scenario, plan, 3).periods[3]

    def seen(*names):
        """The period's indicator with these sensors alone, the tip with an indicator of 9."""
        readings = []
        for checked in period.readings:
            frame = checked.measurement.frame
            sensors = {name: frame.readings[name] for name in names}
            if "tip" in sensors:
                sensors["tip"] = replace(sensors["tip"], indicator=9.0)
            measured = replace(checked.measurement, frame=replace(frame, readings=sensors))
            readings.append(replace(checked, measurement=measured))
        return row_of(replace(period, readings=tuple(readings)), plan).indicator

    assert seen("tip", *REFERENCES) == seen(*REFERENCES) == row_of(period, plan).indicator < 1.0
    assert seen("tip") == 9.0
    assert seen() is None


def test_rows_are_the_same_period_by_period(by_command):
    one = task("insert", "insertion", seed=3, pace=0.0)
    advancing(one.control, len(by_command.periods) + 1)
    InsertionJobs().insert(one)
    assert plain(one.report.rows) == plain(row_of(period, by_command.plan) for period in by_command.periods)
    assert "paused" in [news.state for news in one.report.of("insertion")]


def test_states_are_reported_in_order(inserted, by_command):
    news = inserted[1].of("insertion")
    assert [one.state for one in news] == ["planning", "running", "done"]
    assert news[-1].summary == by_command.summary
    assert news[-1].error_mm == by_command.error_mm
    assert news[-1].periods == len(by_command.periods)
    assert news[-1].target == short().target.position


def test_each_period_has_its_frames(inserted, by_command):
    reported, count = inserted[1], len(by_command.periods)
    for kind in (FrameKind.NEEDLE, FrameKind.TRUE, FrameKind.PREDICTED):
        assert [frame.number for frame in reported.shapes(kind, FrameSource.LIVE)] == list(range(count))
    decided = {frame.number for frame in reported.shapes(FrameKind.SAMPLES, FrameSource.LIVE)}
    assert decided == {period.index for period in by_command.periods if not math.isnan(period.cost)}
    channel = reported.shapes(FrameKind.CHANNEL, FrameSource.LIVE)[-1].values[0]
    assert channel[0, 0] < 1.0 < channel[-1, 0]
    assert (channel[:, 3] >= 1.0).all()
    assert channel[:, 3].max() > 1.0


@pytest.mark.parametrize("controller", ["ce-mpc", "open-loop"])
def test_another_controller(controller):
    one = task("insert", "insertion", seed=1, controller=controller)
    InsertionJobs().insert(one)
    assert one.report.of("insertion")[-1].controller == controller
    assert bool(one.report.shapes(FrameKind.SAMPLES, FrameSource.LIVE)) == (controller == "ce-mpc")


def stopping(at, **signal):
    """A task with a signal after the row of this index."""

    def then(news):
        if news.type == "rows" and news.first == at:
            one.control.take(JobChange(job=1, **signal))

    one = task("insert", "insertion", reported=Reported(then))
    return one


def test_a_stop_ends_it_as_interrupted():
    one = stopping(4, stop="person 2")
    InsertionJobs().insert(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.periods) == ("interrupted", 5)
    assert last.summary.endswith("stopped: person 2")


def test_a_cancelled_one_has_no_result():
    one, worker = stopping(4, cancel=True), InsertionJobs()
    with pytest.raises(Cancelled):
        worker.insert(one)
    assert len(one.report.rows) == 5
    with pytest.raises(InputError, match="no insertion to save"):
        worker.save(task("save", folder="nowhere"))


def test_one_that_is_refused_is_reported():
    scenario = short(**{"target.lateral_mm": 12.0})
    reported = done(InsertionJobs().insert, task("insert", "insertion", scenario, controller="ce-mpc"))
    assert reported.of("insertion")[-1].state == "refused"
    assert "misses the target" in reported.of("insertion")[-1].summary


def test_an_insertion_is_listed_once_it_is_saved_as_a_whole(inserted, tmp_path, monkeypatch):
    runs, while_saving = RunsFolder(tmp_path), []

    def watched(insertion, folder):
        save(insertion, folder)
        while_saving.append((runs.listed(), list(tmp_path.glob("*/run.json"))))

    monkeypatch.setattr(recordings, "save", watched)
    (tmp_path / ".saved").mkdir()  # of somebody else
    inserted[0].save(task("save", folder=str(tmp_path / "saved")))
    ((listed, (written,)),) = while_saving
    assert listed == []
    assert not written.exists()  # it has moved
    assert [run["name"] for run in runs.listed()] == ["saved"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".saved", "saved"]


def test_a_saved_insertion_is_read_as_it_was(inserted, tmp_path):
    worker, reported = inserted
    folder = tmp_path / "saved"
    worker.save(task("save", folder=str(folder)))
    again = task("read", "recording", folder=str(folder), of="second")
    read_run(again)
    rows = again.report.rows
    assert [news.of for news in again.report.of("rows")] == ["second"]
    assert len(rows) == len(reported.rows)
    for row, live in zip(rows, reported.rows, strict=True):
        assert row.true == pytest.approx(live.true, abs=1e-6)
        assert row.error_mm == pytest.approx(live.error_mm, abs=1e-6)
        assert (row.action, row.verdict, row.decision) == (live.action, live.verdict, live.decision)
    (needles,) = again.report.shapes(FrameKind.NEEDLE, FrameSource.SECOND)
    assert needles.values.shape[0] == len(rows)
    assert needles.values[-1] == pytest.approx(reported.shapes(FrameKind.NEEDLE)[-1].values[0], abs=1e-4)


def test_a_folder_without_an_insertion_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"run\.json is missing"):
        read_run(task("read", "recording", folder=str(tmp_path)))


def disturbed(*disturbs, scenario=None, seed=3):
    """What an insertion reports that is disturbed from its start."""
    one = task("insert", "insertion", scenario, seed=seed, pace=NO_WAIT)
    for disturb in disturbs:
        one.control.take(JobChange(job=1, disturb=DisturbRequest(type="disturb", **disturb)))
    InsertionJobs().insert(one)
    return one.report


def test_a_push_moves_the_true_tip_in_its_direction(by_command):
    pushed = disturbed({"what": "push", "size": 0.05, "angle_deg": 0.0}).rows[1].true[1]
    back = disturbed({"what": "push", "size": 0.05, "angle_deg": 180.0}).rows[1].true[1]
    free = by_command.periods[1].true_tip.y
    assert pushed > free + 0.02
    assert back < free - 0.02


def test_no_push_is_no_disturbance(by_command):
    reported = disturbed({"what": "push", "size": 0.0}, {"what": "stiffen", "size": 1.0})
    assert plain(reported.rows) == plain(row_of(period, by_command.plan) for period in by_command.periods)
    assert reported.of("disturbances")[-1].active == []
    assert reported.of("insertion")[-1].summary == by_command.summary


def test_the_record_of_a_disturbed_insertion_says_so(tmp_path, inserted):
    """Its seed alone does not give it again."""
    one, worker = task("insert", "insertion", seed=3, pace=NO_WAIT), InsertionJobs()
    for size in (0.05, 0.0):
        one.control.take(
            JobChange(job=1, disturb=DisturbRequest(type="disturb", what="push", size=size, angle_deg=90.0))
        )
    worker.insert(one)
    disturbed_by = "push of 0.05 N at 90° at 0.0 s, push ended at 0.0 s"
    assert one.report.of("insertion")[-1].summary.endswith(f"; disturbed: {disturbed_by}")
    for folder, ended in (("pushed", worker), ("plain", inserted[0])):
        ended.save(task("save", folder=str(tmp_path / folder)))
    pushed, plain_one = flexneedle.load(tmp_path / "pushed"), flexneedle.load(tmp_path / "plain")
    assert (pushed.disturbed, plain_one.disturbed) == (disturbed_by, "")
    assert pushed.summary == one.report.of("insertion")[-1].summary
    assert mark_columns(pushed) == {"disturbed": True}
    assert mark_columns(plain_one) == {}


def test_a_record_names_the_first_disturbances_and_counts_the_others():
    times = iter(range(100))
    disturber = Disturber(short(), lambda _news: None)
    disturber.now = lambda: next(times)
    disturber.plant(draw(short(), np.random.default_rng(3)), 0.0)
    disturber.watch(None)
    for size in range(1, 14):
        disturber.take(DisturbRequest(type="disturb", what="push", size=0.01 * size))
    assert disturber.summary.startswith("push of 0.01 N at 0° at 0.0 s, push of 0.02 N at 0° at 1.0 s, ")
    assert disturber.summary.endswith("push of 0.1 N at 0° at 9.0 s, 3 more")


def test_a_stiffer_layer_stores_more_energy_for_the_same_needle(by_command):
    rows = disturbed({"what": "stiffen", "size": 3.0, "layer": 0}).rows
    assert rows[-1].true_energy_mj > 1.3 * by_command.periods[-1].true_strain_energy
    deep = disturbed({"what": "stiffen", "size": 3.0, "layer": 1}).rows  # which the needle does not reach
    assert deep[-1].true_energy_mj == by_command.periods[-1].true_strain_energy


def test_a_layer_is_stiffer_where_it_truly_is(monkeypatch):
    """Its boundaries are displaced, and a hidden layer splits those of the scenario."""
    hidden = {"top_mm": 24.0, "thickness_mm": 3.0, "modulus_factor": 4.0}
    scenario = short().with_values(
        {"phantom.layer_shift_sd_mm": 1.5, "phantom.structure.hidden_layer": hidden}
    )
    truth = draw(scenario, np.random.default_rng(3))
    tops = np.cumsum([layer.thickness_mm for layer in truth.scenario.tissue[:-1]])
    assert len(tops) > 1
    assert truth.layer_tops[1] in (0.0, *tops.tolist())
    assert abs(truth.layer_tops[1] - scenario.layer_tops[1]) > 0.1
    given = []
    monkeypatch.setattr(DisturbedPlant, "stiffen", lambda _plant, *how: given.append(how))
    disturber = Disturber(scenario, lambda _news: None)
    disturber.now = lambda: 0.0
    disturber.plant(truth, 0.0)
    disturber.watch(None)
    for layer in (0, 1):
        disturber.take(DisturbRequest(type="disturb", what="stiffen", size=3.0, layer=layer))
    boundary = truth.layer_tops[1]
    assert given == [(0.0, boundary, 3.0), (boundary, math.inf, 3.0)]


def test_a_lost_tip_holds_the_needle_and_comes_back():
    reported = disturbed({"what": "drop", "size": 0.5})
    verdicts = [row.verdict for row in reported.rows]
    assert any(verdict.startswith("missing") for verdict in verdicts)
    assert verdicts[-1] == "ok"
    assert [news.active for news in reported.of("disturbances")] == [["tip not measured for 0.5 s"], []]


@pytest.mark.parametrize("environment", ["ideal", "noisy"])
def test_a_plate_distorts_the_readings_until_it_is_taken_away(environment):
    scenario = short(**{"tracker.environment": environment, "monitor.enabled": False})
    plan = flexneedle.plan(scenario, seed=3)
    by_command = flexneedle.insert(scenario, plan, 3)
    assert plain(disturbed(scenario=scenario).rows) == plain(row_of(one, plan) for one in by_command.periods)
    near = disturbed({"what": "plate", "size": 60.0}, scenario=scenario).rows
    assert near[3].indicator > 1.2 * row_of(by_command.periods[3], plan).indicator
    assert abs(near[3].measured[1] - by_command.periods[3].measurement.y) > 0.1
    away = disturbed({"what": "plate", "size": 60.0}, {"what": "plate", "size": 0.0}, scenario=scenario)
    same = [row.measured for row in away.rows] == [row.measured for row in disturbed(scenario=scenario).rows]
    assert same == (environment == "ideal")
    assert away.of("disturbances")[-1].active == []
