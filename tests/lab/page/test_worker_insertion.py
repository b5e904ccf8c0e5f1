"""Virtual insertions of the page's worker: equal to `flexneedle.insert`, at any pace, with disturbances."""

import math
import socket
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
import recorded_page
from emulated import until
from flexneedle.errors import InputError, RunError
from flexneedle.lab.page.job_orders import JobChange
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.page.server.runs_folder import RunsFolder
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource
from flexneedle.lab.page.worker import recordings
from flexneedle.lab.page.worker.disturbances import DisturbedPlant, Disturber
from flexneedle.lab.page.worker.igtl_link import IgtlLink
from flexneedle.lab.page.worker.insertion_jobs import InsertionJobs
from flexneedle.lab.page.worker.recordings import read_run
from flexneedle.lab.page.worker.task import Cancelled
from flexneedle.phantom.draw import draw
from flexneedle.record.export import mark_columns
from flexneedle.record.fields import page_values
from flexneedle.record.saving import save
from igtl_peers import connected, free_port
from page_tasks import NO_WAIT, Reported, done, plain, short, task

pytestmark = pytest.mark.usefixtures("empty_figures")

REFERENCES = ("ref1", "ref2", "ref3")


def by_command(scenario):
    return flexneedle.insert(scenario, flexneedle.plan(scenario, seed=3), 3)


@pytest.fixture(scope="module")
def expected():
    """The insertion of `flexneedle.insert`."""
    return by_command(short())


@pytest.fixture(scope="module")
def in_field():
    """An insertion with a tracker that has references and an indicator."""
    return by_command(short(**{"tracker.environment": "ideal", "monitor.enabled": False}))


def rows_of(insertion):
    return plain(page_values(period, insertion.plan) for period in insertion.periods)


@pytest.fixture(scope="module")
def inserted():
    """The worker of a finished insertion, and its reports."""
    worker, one = InsertionJobs(), task("insert", "insertion", seed=3)
    worker.insert(one)
    return worker, one.report


def test_rows_are_equal_to_the_command(inserted, expected):
    rows = inserted[1].rows
    assert plain(rows) == rows_of(expected)
    assert len(rows) > 12
    assert rows[0].keys() == recorded_page.row(0).keys()  # of which the browser tests draw pages


def test_states_and_frames_are_reported_in_order(inserted, expected):
    reported, count = inserted[1], len(expected.periods)
    assert [one.state for one in reported.of("insertion")] == ["planning", "running", "done"]
    last = reported.of("insertion")[-1]
    assert (last.summary, last.error_mm, last.periods) == (expected.summary, expected.error_mm, count)
    assert last.target == short().target.position
    assert [one.load for one in reported.of("insertion")] == [{}, {}, expected.invasiveness.rows()]
    for kind in (FrameKind.NEEDLE, FrameKind.TRUE, FrameKind.PREDICTED):
        assert [frame.number for frame in reported.shapes(kind, FrameSource.LIVE)] == list(range(count))
    decided = {frame.number for frame in reported.shapes(FrameKind.SAMPLES, FrameSource.LIVE)}
    assert decided == {period.index for period in expected.periods if not math.isnan(period.cost)}
    channel = reported.shapes(FrameKind.CHANNEL, FrameSource.LIVE)[-1].values[0]
    assert channel[0, 0] < 1.0 < channel[-1, 0]
    assert (channel[:, 3] >= 1.0).all()
    assert channel[:, 3].max() > 1.0


def test_the_indicator_is_the_largest_of_the_references(expected, in_field):
    assert {row["indicator"] for row in rows_of(expected)} == {None}
    for period in in_field.periods:
        frames = [checked.measurement.frame for checked in period.readings]
        by_name = {name: [frame.readings[name].indicator for frame in frames] for name in REFERENCES}
        medians = [np.median([one for one in values if one is not None]) for values in by_name.values()]
        assert page_values(period, in_field.plan)["indicator"] == pytest.approx(max(medians), rel=1e-12)


def test_the_indicator_of_the_tip_counts_only_without_references(in_field):
    """As for the monitor, which judges the field by the references."""
    period = in_field.periods[3]

    def indicator(*names):
        """Return the period's indicator with these sensors alone; the tip has an indicator of 9."""
        readings = []
        for checked in period.readings:
            frame = checked.measurement.frame
            sensors = {name: frame.readings[name] for name in names}
            if "tip" in sensors:
                sensors["tip"] = replace(sensors["tip"], indicator=9.0)
            measured = replace(checked.measurement, frame=replace(frame, readings=sensors))
            readings.append(replace(checked, measurement=measured))
        return page_values(replace(period, readings=tuple(readings)), in_field.plan)["indicator"]

    assert indicator("tip", *REFERENCES) == indicator(*REFERENCES) < 1.0
    assert (indicator("tip"), indicator()) == (9.0, None)


def test_rows_are_the_same_in_single_periods(expected):
    one = task("insert", "insertion", seed=3, pace=0.0)
    for _ in range(len(expected.periods) + 1):
        one.control.take(JobChange(job=1, advance=True))
    InsertionJobs().insert(one)
    assert plain(one.report.rows) == rows_of(expected)
    assert "paused" in [message.state for message in one.report.of("insertion")]


def test_another_controller():
    one = task("insert", "insertion", seed=1, controller="open-loop")
    InsertionJobs().insert(one)
    assert one.report.of("insertion")[-1].controller == "open-loop"
    assert not one.report.shapes(FrameKind.SAMPLES, FrameSource.LIVE)


def test_a_peer_of_openigtlink_follows_each_insertion_and_stops_a_paused_one():
    link = IgtlLink((f"127.0.0.1:{(port := free_port())}", "ImageToNeedle"))
    worker, one = InsertionJobs(link), task("insert", "insertion", seed=3)
    with connected(port) as peer:
        worker.insert(one)
        summary = one.report.of("insertion")[-1].summary
        until(lambda: peer.last("NeedleError") and peer.last("NeedleError").string in summary)
        assert peer.last("NeedlePoints") is not None
        paused = Reported(lambda message: getattr(message, "state", "") == "paused" and peer.send_stop())
        two = task("insert", "insertion", seed=3, pace=0.0, reported=paused)
        with pytest.raises(Cancelled):
            worker.insert(two)
    link.close()
    assert two.report.of("insertion")[-1].summary.startswith("stopped: OpenIGTLink 127.0.0.1:")


def test_a_port_that_is_taken_fails_each_insertion(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        worker = InsertionJobs(IgtlLink((f"127.0.0.1:{port}", "ImageToNeedle")))
        with pytest.raises(RunError, match="cannot listen"):
            worker.insert(task("insert", "insertion", seed=3))
    assert "cannot listen on 127.0.0.1" in capsys.readouterr().err


@pytest.mark.parametrize("change", [{"stop": "person 2"}, {"cancel": True}])
def test_a_stop_ends_it_as_interrupted_and_a_cancel_without_a_result(change):
    def then(message):
        if message.type == "rows" and message.first == 4:
            one.control.take(JobChange(job=1, **change))

    one, worker = task("insert", "insertion", reported=Reported(then)), InsertionJobs()
    if "stop" in change:
        worker.insert(one)
        last = one.report.of("insertion")[-1]
        assert (last.state, last.periods) == ("interrupted", 5)
        assert last.summary.endswith("stopped: person 2")
        return
    with pytest.raises(Cancelled):
        worker.insert(one)
    assert len(one.report.rows) == 5
    with pytest.raises(InputError, match="no insertion to save"):
        worker.save(task("save", folder="nowhere"))


def test_a_refused_insertion_is_reported_without_advice_that_the_page_cannot_follow():
    scenario = short(**{"target.lateral_mm": 12.0})
    reported = done(InsertionJobs().insert, task("insert", "insertion", scenario, controller="ce-mpc"))
    assert reported.of("insertion")[-1].state == "refused"
    summary = reported.of("insertion")[-1].summary
    assert "misses the target" in summary
    assert "--force" not in summary


def test_an_insertion_is_listed_once_it_is_completely_saved_and_is_read_again(
    inserted, tmp_path, monkeypatch
):
    (worker, reported), runs, while_saving = inserted, RunsFolder(tmp_path), []

    def watched(insertion, folder):
        save(insertion, folder)
        while_saving.append((runs.list_runs(), list(tmp_path.glob("*/run.json"))))

    monkeypatch.setattr(recordings, "save", watched)
    worker.save(task("save", folder=str(tmp_path / "saved")))
    ((listed, (written,)),) = while_saving
    assert listed == []
    assert not written.exists()  # it has moved
    assert [run["name"] for run in runs.list_runs()] == ["saved"]
    assert [path.name for path in tmp_path.iterdir()] == ["saved"]
    again = task("read", "recording", folder=str(tmp_path / "saved"), of="second")
    read_run(again)
    assert [message.of for message in again.report.of("rows")] == ["second"]
    for row, live in zip(again.report.rows, reported.rows, strict=True):
        for key in ("true", "error_mm"):
            assert row[key] == pytest.approx(live[key], abs=1e-6)
        for key in ("action", "verdict", "decision"):
            assert row[key] == live[key]
    (needles,) = again.report.shapes(FrameKind.NEEDLE, FrameSource.SECOND)
    assert needles.values.shape[0] == len(reported.rows)
    assert needles.values[-1] == pytest.approx(reported.shapes(FrameKind.NEEDLE)[-1].values[0], abs=1e-4)
    with pytest.raises(InputError, match=r"run\.json"):
        read_run(task("read", "recording", folder=str(tmp_path)))


def disturbed(*disturbs, scenario=None, worker=None, rows=1000):
    """Return the reports of an insertion that is disturbed from its start, and stopped after some rows."""

    def then(message):
        if message.type == "rows" and message.first == rows - 1:
            one.control.take(JobChange(job=1, stop="enough"))

    one = task("insert", "insertion", scenario, seed=3, pace=NO_WAIT, reported=Reported(then))
    for disturb in disturbs:
        one.control.take(JobChange(job=1, disturb=DisturbRequest(type="disturb", **disturb)))
    (worker or InsertionJobs()).insert(one)
    return one.report


def test_a_push_moves_the_true_tip_in_its_direction_and_is_recorded(expected, inserted, tmp_path):
    """The seed of its record alone does not reproduce it."""
    worker, free = InsertionJobs(), expected.periods[1].true_tip.y
    pushed = disturbed({"what": "push", "size": 0.05, "angle_deg": 0.0}, worker=worker)
    back = disturbed({"what": "push", "size": 0.05, "angle_deg": 180.0}, rows=2)
    assert pushed.rows[1]["true"][1] > free + 0.02
    assert back.rows[1]["true"][1] < free - 0.02
    summary = pushed.of("insertion")[-1].summary
    assert summary.endswith("; disturbed: push of 0.05 N at 0° at 0.0 s")
    for name, ended in (("pushed", worker), ("plain", inserted[0])):
        ended.save(task("save", folder=str(tmp_path / name)))
    saved, plain_one = flexneedle.load(tmp_path / "pushed"), flexneedle.load(tmp_path / "plain")
    assert (saved.disturbed, plain_one.disturbed) == ("push of 0.05 N at 0° at 0.0 s", "")
    assert saved.summary == summary
    assert (mark_columns(saved), mark_columns(plain_one)) == ({"disturbed": True}, {})


def test_an_ended_push_and_none_at_all_are_no_disturbance(expected):
    reported = disturbed({"what": "push", "size": 0.0}, {"what": "stiffen", "size": 1.0})
    assert plain(reported.rows) == rows_of(expected)
    assert reported.of("disturbances")[-1].active == []
    assert reported.of("insertion")[-1].summary == expected.summary


def disturber_of(scenario, truth=None):
    """Return a disturber with a clock that counts its calls, and a true needle."""
    made, times = Disturber(scenario, lambda _message: None), iter(range(100))
    made.now = lambda: next(times)
    made.plant(truth or draw(scenario, np.random.default_rng(3)), 0.0)
    made.watch(None)
    return made


def test_a_record_has_the_first_disturbances_with_their_times_and_counts_the_others():
    disturber = disturber_of(short())
    for size in (0.1, 0.0, *(0.01 * size for size in range(3, 14))):
        disturber.take(DisturbRequest(type="disturb", what="push", size=size))
    assert disturber.summary.startswith("push of 0.1 N at 0° at 0.0 s, push ended at 1.0 s, ")
    assert disturber.summary.endswith("push of 0.1 N at 0° at 9.0 s, 3 more")


def test_a_stiffer_layer_stores_more_energy_for_the_same_needle(expected):
    energy = 1e3 * expected.periods[-1].true_strain_energy
    rows = disturbed({"what": "stiffen", "size": 3.0, "layer": 0}).rows
    assert rows[-1]["true_energy_uj"] > 1.3 * energy
    deep = disturbed({"what": "stiffen", "size": 3.0, "layer": 1}).rows  # which the needle does not reach
    assert deep[-1]["true_energy_uj"] == energy


def test_a_layer_is_stiffened_between_its_true_boundaries(monkeypatch):
    """Its boundaries are displaced, and a hidden layer splits the scenario's layers."""
    hidden = {"top_mm": 24.0, "thickness_mm": 3.0, "modulus_factor": 4.0}
    scenario = short().with_values(
        {"phantom.layer_shift_sd_mm": 1.5, "phantom.structure.hidden_layer": hidden}
    )
    truth = draw(scenario, np.random.default_rng(3))
    tops = np.cumsum([layer.thickness_mm for layer in truth.scenario.tissue[:-1]])
    assert len(tops) > 1
    boundary = truth.layer_tops[1]
    assert boundary in (0.0, *tops.tolist())
    assert abs(boundary - scenario.layer_tops[1]) > 0.1
    given = []
    monkeypatch.setattr(DisturbedPlant, "stiffen", lambda _plant, *how: given.append(how))
    disturber = disturber_of(scenario, truth)
    for layer in (0, 1):
        disturber.take(DisturbRequest(type="disturb", what="stiffen", size=3.0, layer=layer))
    assert given == [(0.0, boundary, 3.0), (boundary, math.inf, 3.0)]


def test_a_lost_tip_holds_the_needle_and_returns():
    reported = disturbed({"what": "drop", "size": 0.5})
    verdicts = [row["verdict"] for row in reported.rows]
    assert any(verdict.startswith("missing") for verdict in verdicts)
    assert verdicts[-1] == "ok"
    assert [message.active for message in reported.of("disturbances")] == [["tip not measured for 0.5 s"], []]


@pytest.mark.parametrize("environment", ["ideal", "noisy"])
def test_a_plate_distorts_the_readings_until_it_is_removed(environment, in_field):
    scenario = short(**{"tracker.environment": environment, "monitor.enabled": False})
    free_rows = plain(disturbed(scenario=scenario, rows=6).rows)
    assert environment != "ideal" or free_rows == rows_of(in_field)[:6]
    near = plain(disturbed({"what": "plate", "size": 60.0}, scenario=scenario, rows=6).rows)
    assert near[3]["indicator"] > 1.2 * free_rows[3]["indicator"]
    assert math.dist(near[3]["measured"], free_rows[3]["measured"]) > 0.1
    brought, removed = ({"what": "plate", "size": size} for size in (60.0, 0.0))
    away = disturbed(brought, removed, scenario=scenario, rows=6)
    without = [
        row["measured"] for row in plain(away.rows)
    ]  # in "noisy" also without the plate of the scenario
    assert (without == [row["measured"] for row in free_rows]) == (environment == "ideal")
    assert away.of("disturbances")[-1].active == []
