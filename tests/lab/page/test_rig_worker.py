"""Insertions on a rig in the page's worker: as by the command, and they wait, are held and stopped on request."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import tomli_w

import fake_engine
from bench_rig import rig, values
from commands import names, run
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
    "Bench: the needle will be inserted from its present position to a target 40 mm deep, 5 mm to the side.",
    "insertion: at 30 mm, moves at most at 7.81 mm/s",
    "rotation: at 0 deg, moves at most at 270 deg/s",
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

    def take_signals(self):
        """Do nothing, as for a command without signals."""

    def request_stop(self, who):
        self.stops.append(who)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(values(KINDS)))
    return tmp_path


@pytest.fixture
def calls(monkeypatch):
    """Calls of `loop.insertions.carry_out`: plan and loop are invented, the rig is `supervisor`."""
    found, supervisor = [], SupervisorClient()
    fake_engine.install(monkeypatch.setattr)

    def carry_out(scenario, plan, choices, stream):
        found.append((scenario, choices))

        def wait_while_held(_event):
            while stream.gate.hold():
                supervisor.wait(0.0)

        stream.gate.confirm(supervisor)
        held = Stream((wait_while_held, *stream.listeners))
        return fake_engine.carry_out(scenario, plan, choices, held)

    monkeypatch.setattr(recording, "carry_out", carry_out)
    return SimpleNamespace(found=found, supervisor=supervisor)


def order(tmp_path, reported=None, **more):
    values = {"scenario": load_scenario("phantom"), "rig": "rig.toml", "folder": str(tmp_path), **more}
    one = task("insert", "insertion", reported=reported, **values)
    return replace(one, control=JobControl(held="not armed"))


def going(one, calls):
    """Let the insertion go when it waits for the third time."""

    def signal():
        if calls.supervisor.waits % 3 == 0:
            one.control.take(JobChange(job=1, go=True))

    calls.supervisor.on_wait = signal
    return one


def inserted(one):
    """Insert, and return the last reported state."""
    InsertionJobs().insert(one)
    return one.report.of("insertion")[-1]


def states(one):
    return [message.state for message in one.report.of("insertion")]


def in_row_4(then):
    """Return reports that call a function after the fifth row."""
    return Reported(lambda message: getattr(message, "type", "") == "rows" and message.first == 4 and then())


def run_file(folder):
    return json.loads((folder / "run.json").read_text())


def test_it_waits_with_its_motions_until_it_may_go(calls, in_tmp):
    one = going(order(in_tmp), calls)
    last = inserted(one)
    assert states(one) == ["planning", "ready", "running", "done"]
    assert calls.supervisor.waits == 3
    waiting, goes = one.report.rig
    assert list(waiting.moves[:-1]) == MOVES
    assert "switched on" in waiting.moves[-1]
    assert (waiting.waits, goes.waits, goes.moves) == (1, 0, ())
    assert len(one.report.rows) == last.periods > 10
    assert last.summary.endswith("withdraw it with the button Retract")  # the needle is left in
    with pytest.raises(InputError, match="no insertion to save"):  # it is recorded already
        InsertionJobs().save(task("save", folder=str(in_tmp / "again")))


def test_its_record_is_equal_to_the_command(calls, in_tmp, capsys):
    last = inserted(going(order(in_tmp / "runs", seed=3, controller="ce-mpc"), calls))
    arguments = ("--seed", "3", "--controller", "ce-mpc", "--out", "command", "--yes")
    assert run(capsys, "insert", "phantom", "--rig", "rig.toml", *arguments)[0] == 0
    assert last.rig == "Bench"
    ours, theirs = in_tmp / "runs" / last.folder, in_tmp / "command"
    assert run_file(ours) | {"timing": None} == run_file(theirs) | {"timing": None}
    assert names(ours) == names(theirs)
    (ours, our_choices), (theirs, their_choices) = calls.found
    assert our_choices.parts == their_choices.parts
    assert our_choices.parts["rig"] == "Bench"
    assert ours.values() == theirs.values()
    assert our_choices.seed == their_choices.seed == 3


def test_it_is_held_between_two_periods_and_continues_when_it_may(calls, in_tmp):
    def hold():
        one.control.take(JobChange(job=1, hold="nobody is in control"))

    one = going(order(in_tmp, in_row_4(hold)), calls)
    inserted(one)
    assert states(one) == ["planning", "ready", "running", "holding", "running", "done"]
    held = one.report.of("insertion")[3]
    assert (held.summary, held.periods) == ("nobody is in control", 5)
    reports = [(report.state, report.waits, len(report.moves)) for report in one.report.rig]
    assert reports == [("idle", 1, 5), ("idle", 0, 0), ("idle", 2, 4), ("idle", 0, 0)]
    assert list(one.report.rig[2].moves) == MOVES


@pytest.mark.parametrize("signal", [{"stop": "person 2"}, {"cancel": True, "stop": "the server has ended"}])
def test_a_stop_is_sent_to_the_supervisor_by_the_receiving_thread(calls, in_tmp, signal):
    one = order(in_tmp)

    def stopped():
        one.control.take(JobChange(job=1, **signal))
        raise DriverError("stopped")

    calls.supervisor.on_wait = stopped
    with pytest.raises(DriverError):
        inserted(one)
    assert calls.supervisor.stops == [signal["stop"]]


def test_a_stop_before_or_while_the_rig_opens_moves_nothing_and_is_recorded(calls, in_tmp):
    one = order(in_tmp)
    one.control.take(JobChange(job=1, stop="person 2"))
    with pytest.raises(Cancelled):
        inserted(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.summary) == ("interrupted", "stopped: person 2")
    assert calls.found == []
    stored = run_file(in_tmp / last.folder)
    assert (stored["status"], stored["reason"]) == ("interrupted", "stopped: person 2")

    def stop(message):
        if getattr(message, "type", "") == "job" and "5 of 5" in message.text:  # the plan is ready
            opening.control.take(JobChange(job=1, stop="person 2"))

    opening = order(in_tmp, Reported(stop))
    assert inserted(opening).state == "interrupted"
    assert calls.supervisor.waits == 0


def test_a_failure_reports_that_the_needle_is_left_in(calls, in_tmp):
    def fail():
        raise DriverError("the motor is off")

    one = going(order(in_tmp, in_row_4(fail)), calls)
    with pytest.raises(DriverError):
        inserted(one)
    last = one.report.of("insertion")[-1]
    assert (last.state, last.summary.split("; ")[0]) == ("failed", "the motor is off")
    assert last.summary.endswith("withdraw it with the button Retract")


@pytest.fixture
def gate():
    """The gate of an insertion whose rig is open, with its control and reports."""
    one = order("")
    made = RigGate(SimpleNamespace(task=one, announce=lambda *_: None), None)
    made._supervisor, made.control, made.reports = SupervisorClient(), one.control, one.report.rig
    return made


def tick(gate, state, why=""):
    gate.take(TickReport(0.0, SupervisorState(state), why))


def test_changed_states_of_the_supervisor_are_reported(gate):
    ticks = [
        ("armed", ""),
        ("armed", ""),
        ("inserting", ""),
        ("holding", "missing"),
        ("stopped", "the controller"),
    ]
    for state, why in (*ticks, ("stopped", "person 2")):
        tick(gate, state, why)
    found = [(report.state, report.why) for report in gate.reports]
    shown = [("armed", ""), ("inserting", ""), ("holding", "missing"), ("ended", ""), ("stopped", "person 2")]
    assert found == shown


def test_a_rig_is_stopped_once_when_the_server_is_silent_without_beats(gate):
    gate.control.heard -= SILENT_S + 0.1
    gate.control.take(JobChange(1))  # a beat
    tick(gate, "inserting")
    assert gate._supervisor.stops == []
    gate.control.heard -= SILENT_S + 0.1
    for _ in range(2):
        tick(gate, "inserting")
    (why,) = gate._supervisor.stops
    assert why.startswith("no signal of the page's server for 1.")


def test_a_check_is_equal_to_the_command(monkeypatch):
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
    with pytest.raises(RigError, match=f"^ros.{key} = true: "):
        usable_rig("rig.toml")
