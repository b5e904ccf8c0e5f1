"""Retractions on a rig in the page's worker: the motion of the command, after "go", stopped on request."""

from dataclasses import replace

import pytest
import tomli_w

import bench_rig
from bench_rig import Motors, values
from commands import run
from flexneedle.errors import DriverError, InputError, RefusedError, StoppedError
from flexneedle.lab.commands import rig as command
from flexneedle.lab.page.job_orders import SILENT_S, JobChange
from flexneedle.lab.page.worker import rig_retraction
from flexneedle.lab.page.worker.rig_retraction import retract
from flexneedle.lab.page.worker.task import Cancelled, JobControl
from flexneedle.lab.rig.notices import SWITCHED_ON
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import AxisState, TickReport
from flexneedle.ports import MotorState
from page_tasks import Reported, short, task

KINDS = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}


class RecordingSupervisor:
    """A supervisor that records its calls, with a tick in each motion. on_retract: called in the motion."""

    def __init__(self):
        self.calls, self.positions, self.on_retract = [], {"insertion": 30.0}, lambda: None
        self.tick = lambda _report: None

    def open(self, _rig, on_report=None):
        self.tick = on_report or self.tick
        self.calls.append(("open",))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_exception):
        self.calls.append(("closed",))
        self.tick(TickReport(0.0, SupervisorState.STOPPED, "closed"))

    def arm(self):
        self.calls.append(("arm",))
        self.tick(TickReport(0.0, SupervisorState.ARMED, ""))

    def retract(self, position, speed):
        self.calls.append(("retract", position, speed))
        halfway = {"insertion": AxisState(16.2, MotorState(0.0, 0.0))}
        self.tick(TickReport(0.0, SupervisorState.RETRACTING, "", halfway))
        self.on_retract()

    def request_stop(self, who):
        self.calls.append(("stop", who))
        self.tick(TickReport(0.0, SupervisorState.STOPPED, who))


@pytest.fixture
def motors(monkeypatch, tmp_path):
    """Motors of a rig, with the insertion at 30 mm."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(values(KINDS)))
    found = Motors()
    found.set("A", position=30_000.0, commanded=30_000.0)
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: found)
    return found


@pytest.fixture
def supervisor(monkeypatch, motors):  # noqa: ARG001  the motors are read before they move
    found = RecordingSupervisor()
    monkeypatch.setattr(rig_retraction.SupervisorClient, "of_operator", found.open)
    return found


def order(on_wait=lambda _control: None):
    """A task that waits for "go". on_wait: called with its control when it waits."""
    control = JobControl(held="not armed")

    def then(message):
        if getattr(message, "waits", 0):
            on_wait(control)

    one = task("retract", "retraction", scenario=short(), rig="rig.toml", reported=Reported(then))
    return replace(one, control=control)


def go(control):
    control.take(JobChange(job=1, go=True))


def states(one):
    return [(report.state, report.why, report.waits) for report in one.report.rig]


def test_the_motion_is_that_of_the_command(monkeypatch, capsys, supervisor):
    one = order(go)
    retract(one)
    ours, supervisor.calls = supervisor.calls, []
    monkeypatch.setattr(command, "open_supervisor", supervisor.open)
    status, _, err = run(capsys, "rig", "retract", "rig.toml", "--yes")
    assert (status, ours) == (0, supervisor.calls)
    assert ours == [("open",), ("arm",), ("retract", pytest.approx(2.4), pytest.approx(2.0)), ("closed",)]
    (moves,) = (report.moves for report in one.report.rig if report.waits)
    assert moves == (err.splitlines()[0], SWITCHED_ON)
    assert states(one) == [
        ("idle", "", 1),
        ("idle", "", 0),
        ("armed", "", 0),
        ("retracting", "14 mm left", 0),
        ("ended", "the needle was withdrawn to 2.4 mm", 0),
    ]


@pytest.mark.usefixtures("supervisor")
def test_a_retraction_that_begins_is_not_called_withdrawn():
    one = order(go)
    retract(one)
    jobs = [(job.text, job.share) for job in one.report.of("job") if job.state == "running"]
    assert jobs[-2:] == [("motors are switched on", None), ("withdrawing, 14 mm left", pytest.approx(0.5))]


def test_nothing_is_opened_or_moved_before_go(supervisor, motors):
    one = order(lambda control: control.take(JobChange(job=1, stop="person 2")))
    with pytest.raises(Cancelled):
        retract(one)
    assert supervisor.calls == []
    assert [call for call in motors.calls if call[0] not in ("read", "close")] == []
    assert states(one) == [("idle", "", 1), ("stopped", "person 2", 0)]


def test_a_stop_while_it_moves_stops_the_motors(supervisor):
    one = order(go)

    def stopped():
        one.control.take(JobChange(job=1, stop="person 2"))
        raise StoppedError("stopped: person 2")

    supervisor.on_retract = stopped
    with pytest.raises(Cancelled):
        retract(one)
    assert ("stop", "person 2") in supervisor.calls
    assert states(one)[-1] == ("stopped", "person 2", 0)


def test_a_stop_while_the_rig_opens_moves_nothing(monkeypatch, supervisor):
    one = order(go)

    def opened(rig, on_report):
        one.control.take(JobChange(job=1, stop="person 2"))
        return supervisor.open(rig, on_report)

    monkeypatch.setattr(rig_retraction.SupervisorClient, "of_operator", opened)
    with pytest.raises(Cancelled):
        retract(one)
    assert supervisor.calls == [("open",), ("closed",)]
    assert states(one)[-1] == ("stopped", "person 2", 0)


def silence(control):
    control.heard -= SILENT_S + 0.1


def test_a_silent_server_ends_the_wait_and_stops_the_motors_once(supervisor):
    waiting = order(silence)
    with pytest.raises(Cancelled):
        retract(waiting)
    assert supervisor.calls == []
    moving = order(go)

    def silent():
        silence(moving.control)
        for _ in range(2):
            supervisor.tick(TickReport(0.0, SupervisorState.RETRACTING, ""))
        raise StoppedError(f"stopped: {moving.control.stopped}")

    supervisor.on_retract = silent
    with pytest.raises(Cancelled):
        retract(moving)
    (why,) = (call[1] for call in supervisor.calls if call[0] == "stop")
    for text in (why, states(waiting)[-1][1], states(moving)[-1][1]):
        assert text.startswith("no signal of the page's server for 1.")


def test_an_axis_that_has_moved_a_fault_and_a_withdrawn_base_are_errors(supervisor, motors):
    supervisor.positions["insertion"] = 31.0
    with pytest.raises(RefusedError, match="is at 31 mm, no longer at 30 mm: nothing was moved"):
        retract(order(go))
    assert supervisor.calls == [("open",), ("closed",)]
    supervisor.positions["insertion"] = 30.0

    def fault():
        supervisor.tick(TickReport(0.0, SupervisorState.FAULT, "the motor is off"))
        raise DriverError("the motor is off")

    supervisor.on_retract, one = fault, order(go)
    with pytest.raises(DriverError):
        retract(one)
    assert ("fault", "the motor is off", 0) in states(one)
    motors.set("A", position=2_400.0)
    with pytest.raises(InputError, match=r"a retraction ends at .* mm: nothing to retract"):
        retract(order(go))
