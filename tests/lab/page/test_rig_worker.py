"""Insertions on a rig in the page's worker: those of the command, which wait, are held and stopped when signalled."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import tomli_w

import fake_engine
from bench_rig import rig, values
from commands import run
from flexneedle.errors import DriverError, InputError, RigError
from flexneedle.lab.page.job_orders import SILENT_S, JobChange
from flexneedle.lab.page.rigs import usable_rig
from flexneedle.lab.page.worker.insertion_jobs import InsertionJobs
from flexneedle.lab.page.worker.rig_insertion import RigGate, check
from flexneedle.lab.page.worker.task import Cancelled, JobControl
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.loop.events import Stream
from flexneedle.record import recording
from flexneedle.scenario.files import load_scenario
from page_tasks import Reported, task

pytestmark = pytest.mark.usefixtures("in_tmp", "empty_figures")

KINDS = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}
POSITIONS = {"insertion": 30.0, "rotation": 0.0, "guide_y": -1.5}
MOVES = [
    "Bench: the needle will be inserted from where it is, to a target 40 mm deep, 5 mm to the side.",
    "insertion: at 30 mm, moves at most at 10 mm/s",
    "rotation: at 0 deg, moves at most at 360 deg/s",
    "guide_y: at -1.5 mm, moves at most at 5 mm/s",
]


class SupervisorClient:
    """A supervisor of a rig that rests. on_wait: called each time that its client waits."""

    rig, positions = rig(), POSITIONS

    def __init__(self):
        self.waits, self.stops, self.on_wait = 0, [], lambda: None

    def wait(self, _seconds):
        self.waits += 1
        assert self.waits < 1000, "it waits for what does not come"
        self.on_wait()

    def request_stop(self, who):
        self.stops.append(who)

    def take_signals(self):
        """As for a command."""


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(values(KINDS)))
    return tmp_path


@pytest.fixture
def calls(monkeypatch):
    """What `flexneedle.loop.insert.insert` was called with: plan and loop are made up, the rig is `supervisor`."""
    found = []
    fake_engine.install(monkeypatch.setattr)

    def inserted(scenario, plan, choices, stream):
        found.append((scenario, choices))

        def wait_while_held(_event):
            while stream.gate.hold():
                supervisor.wait(0.0)

        stream.gate.confirm(supervisor)
        held = Stream((wait_while_held, *stream.listeners))
        return fake_engine.carry_out(scenario, plan, choices, held)

    supervisor = inserted.supervisor = SupervisorClient()
    monkeypatch.setattr(recording, "carry_out", inserted)
    return SimpleNamespace(found=found, supervisor=supervisor)


def order(tmp_path, reported=None, **more):
    one = task(
        "insert",
        "insertion",
        load_scenario("phantom"),
        reported=reported,
        rig="rig.toml",
        folder=str(tmp_path),
        **more,
    )
    return replace(one, control=JobControl(held="not armed"))


def going(one, calls):
    """The order goes when it waits for the third time."""

    def signalled():
        if calls.supervisor.waits % 3 == 0:
            one.control.take(JobChange(job=1, go=True))

    calls.supervisor.on_wait = signalled
    return one


def states(one):
    return [news.state for news in one.report.of("insertion")]


def reports(one):
    return [(news.state, news.waits, len(news.moves)) for news in one.report.rig]


def run_file(folder):
    return json.loads((folder / "run.json").read_text())


def test_it_waits_with_what_will_move_until_it_may_go(calls, in_tmp):
    one = going(order(in_tmp), calls)
    InsertionJobs().insert(one)
    assert states(one) == ["planning", "ready", "running", "done"]
    assert calls.supervisor.waits == 3
    waiting, goes = one.report.rig
    assert list(waiting.moves[:-1]) == MOVES
    assert waiting.moves[-1].startswith("The motors of all axes are switched on first.")
    assert (waiting.waits, goes.waits, goes.moves) == (1, 0, ())
    assert len(one.report.rows) == one.report.of("insertion")[-1].periods > 10


def test_it_is_recorded_as_by_the_command(calls, in_tmp, capsys):
    one = going(order(in_tmp / "runs", seed=3, controller="ce-mpc"), calls)
    InsertionJobs().insert(one)
    arguments = ("--seed", "3", "--controller", "ce-mpc", "--out", "command", "--yes")
    assert run(capsys, "insert", "phantom", "--rig", "rig.toml", *arguments)[0] == 0
    last = one.report.of("insertion")[-1]
    assert last.rig == "Bench"
    ours, theirs = run_file(in_tmp / "runs" / last.folder), run_file(in_tmp / "command")
    timed = ("timing",)
    assert {k: v for k, v in ours.items() if k not in timed} == {
        k: v for k, v in theirs.items() if k not in timed
    }
    assert sorted(file.name for file in (in_tmp / "command").iterdir()) == sorted(
        file.name for file in (in_tmp / "runs" / last.folder).iterdir()
    )
    (ours, our_choices), (theirs, their_choices) = calls.found
    assert our_choices.parts == their_choices.parts
    assert our_choices.parts["rig"] == "Bench"
    assert ours.values() == theirs.values()
    assert our_choices.seed == their_choices.seed == 3


def test_it_is_held_between_two_periods_and_goes_on_when_it_may(calls, in_tmp):
    def then(news):
        if getattr(news, "type", "") == "rows" and news.first == 4:
            one.control.take(JobChange(job=1, hold="nobody is in control"))

    one = going(order(in_tmp, Reported(then)), calls)
    InsertionJobs().insert(one)
    assert states(one) == ["planning", "ready", "running", "holding", "running", "done"]
    assert one.report.of("insertion")[3].summary == "nobody is in control"
    assert one.report.of("insertion")[3].periods == 5
    assert reports(one) == [("idle", 1, 5), ("idle", 0, 0), ("idle", 2, 4), ("idle", 0, 0)]
    assert list(one.report.rig[2].moves) == MOVES


@pytest.mark.parametrize("signal", [{"stop": "person 2"}, {"cancel": True, "stop": "the server has ended"}])
def test_a_stop_goes_to_the_supervisor_in_the_thread_that_reads_orders(calls, in_tmp, signal):
    one = order(in_tmp)
    calls.supervisor.on_wait = lambda: (one.control.take(JobChange(job=1, **signal)), ended())

    def ended():
        raise DriverError("stopped")

    with pytest.raises(DriverError):
        InsertionJobs().insert(one)
    assert calls.supervisor.stops == [signal["stop"]]


def test_one_that_is_stopped_before_its_rig_is_open_moves_nothing_and_has_a_record(calls, in_tmp):
    one = order(in_tmp)
    one.control.take(JobChange(job=1, stop="person 2"))
    with pytest.raises(Cancelled):
        InsertionJobs().insert(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.summary) == ("interrupted", "stopped: person 2")
    assert calls.found == []
    stored = run_file(in_tmp / last.folder)
    assert (stored["status"], stored["reason"]) == ("interrupted", "stopped: person 2")


def test_one_that_is_stopped_while_the_rig_opens_is_not_armed(calls, in_tmp):
    one = order(
        in_tmp, Reported(lambda news: getattr(news, "type", "") == "job" and "5 of 5" in news.text and stop())
    )

    def stop():
        one.control.take(JobChange(job=1, stop="person 2"))

    InsertionJobs().insert(one)
    assert states(one)[-1] == "interrupted"
    assert calls.supervisor.waits == 0


LEFT_IN = "the needle stays where it is: withdraw it by flexneedle rig retract rig.toml"


def test_a_needle_that_is_left_in_is_said_to_be(calls, in_tmp):
    def then(news):
        if getattr(news, "type", "") == "rows" and news.first == 4:
            raise DriverError("the motor is off")

    one = going(order(in_tmp, Reported(then)), calls)
    with pytest.raises(DriverError):
        InsertionJobs().insert(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.summary) == ("failed", f"the motor is off; {LEFT_IN}")


def test_a_needle_at_its_target_is_left_in_too(calls, in_tmp):
    one = going(order(in_tmp), calls)
    InsertionJobs().insert(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.summary[-len(LEFT_IN) :]) == ("done", LEFT_IN)


def follower(**more):
    one = order("", **more)
    made = RigGate(SimpleNamespace(task=one, announce=lambda *_: None), None)
    made._supervisor = SupervisorClient()
    return made, one


def test_states_of_the_supervisor_are_reported_when_they_change():
    made, one = follower()
    for state, why in [
        ("armed", ""), ("armed", ""), ("inserting", ""), ("holding", "missing"), ("stopped", "the controller"),
    ]:  # fmt: skip
        made.take(TickReport(0.0, SupervisorState(state), why))
    found = [(news.state, news.why) for news in one.report.rig]
    assert found == [("armed", ""), ("inserting", ""), ("holding", "missing"), ("ended", "")]
    made.take(TickReport(0.0, SupervisorState.STOPPED, "person 2"))
    assert one.report.rig[-1].state == "stopped"


def test_a_rig_is_stopped_once_when_the_server_is_silent():
    made, one = follower()
    made.take(TickReport(0.0, SupervisorState.INSERTING))
    assert made._supervisor.stops == []
    one.control.heard -= SILENT_S + 0.1
    for _ in range(2):
        made.take(TickReport(0.0, SupervisorState.INSERTING))
    (why,) = made._supervisor.stops
    assert why.startswith("no signal of the page's server for 1.")


def test_a_beat_is_a_signal():
    made, one = follower()
    one.control.heard -= SILENT_S + 0.1
    one.control.take(JobChange(1))
    made.take(TickReport(0.0, SupervisorState.INSERTING))
    assert made._supervisor.stops == []


def test_a_check_is_that_of_the_command(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.page.worker.rig_insertion._CHECKED_S", 0.0)
    one = task("check", "check", load_scenario("phantom"), rig="rig.toml")
    check(one)
    (found,) = one.report.of("check")
    assert found.revision == 7
    items = {(line["part"], line["item"]): line for line in found.findings}
    assert items["scenario", "fit"]["found"] == load_scenario("phantom").name
    assert items["insertion", "position"]["problem"] == ""
    assert items["tracker", "frames"]["problem"].startswith("no frame")


@pytest.mark.parametrize("key", ["arm", "target"])
def test_a_rig_that_ros_arms_or_gives_its_target_is_refused(in_tmp, key):
    (in_tmp / "rig.toml").write_text(tomli_w.dumps(values(KINDS | {f"ros.{key}": True})))
    with pytest.raises(RigError) as caught:
        usable_rig("rig.toml")
    rule = "must be false for the page, which arms the rig and has the target: use flexneedle insert"
    assert str(caught.value) == f"ros.{key} = true: {rule}"


def test_an_insertion_on_a_rig_is_not_saved_again(calls, in_tmp):
    one, worker = going(order(in_tmp), calls), InsertionJobs()
    worker.insert(one)
    with pytest.raises(InputError, match="no insertion to save"):
        worker.save(task("save", folder=str(in_tmp / "again")))
