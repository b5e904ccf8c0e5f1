"""The client waits for the effect of its requests, and does not take an earlier report for it."""

import math
import socket
import threading
from threading import Thread
from types import SimpleNamespace

import pytest

from flexneedle.errors import DriverError, RefusedError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.supervisor import connection, protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.ports import MotorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, Measurement, SensorReading
from stages import rig_file


class ScriptedProcess:
    """The supervisor's process in a thread, with a rig that was stopped before the start.

    Another stop is reported, and then that motors rest, only after heartbeats of a waiting client. Arming ends in a
    fault, and a motor cannot be switched off.
    """

    pid = 0

    def __init__(self, _module, **_options):
        ours, theirs = socket.socketpair()
        self.channel, self._line = MessageChannel(theirs), MessageChannel(ours)
        self._requests, self._next = 0, []
        self._thread = Thread(target=self._serve)
        self._thread.start()

    def end(self, _seconds):
        self._thread.join()

    def close(self):
        self.channel.close()

    def _report(self, requests, state=SupervisorState.STOPPED, why="the test", **options):
        self._line.send(protocol.TickReport(0.0, state, why, requests=requests, **options))

    def _serve(self):
        self._line.receive_first()
        self._report(0)
        while not isinstance(request := self._line.receive_first(), protocol.CloseCommand):
            self._requests += 1
            self._answer(request)
        self._line.send(protocol.SupervisorEnded())
        self._line.close()

    def _refuse(self, why, state):
        self._line.send(protocol.RequestRefused(0, why, state))

    def _answer(self, request):
        match request:
            case protocol.StopCommand():
                self._report(self._requests - 1)  # an earlier report, that was under way
                self._next = [(self._requests, rests) for rests in (False, False, True)]
            case protocol.Heartbeat() if self._next:
                requests, rests = self._next.pop(0)
                self._report(requests, at_rest=rests)
            case protocol.ResetCommand() if self._next:
                self._refuse("motors have not come to rest yet", SupervisorState.STOPPED)
                self._report(self._requests, at_rest=False)
                self._next = []  # heartbeats of a late client are not answered
            case protocol.ResetCommand():
                lost = [
                    Measurement(0.0, x, 0.0, 0.0, Frame(0.0, n, {})) for n, x in enumerate((None, math.nan))
                ]
                self._report(self._requests, SupervisorState.IDLE, "", measurements=tuple(lost))
            case protocol.OffCommand():
                on = {"insertion": protocol.AxisState(0.0, MotorState(0.0, 0.0, on=True))}
                self._report(self._requests, why="A is in motion", axes=on)
            case protocol.ArmCommand(deepest) if deepest < 0.0:
                self._refuse("guide_y is beyond its range", SupervisorState.IDLE)
                self._report(self._requests, SupervisorState.IDLE, "")
            case protocol.ArmCommand():
                self._report(self._requests, SupervisorState.FAULT, "the motor does not follow")


@pytest.fixture(autouse=True)
def scripted(monkeypatch):
    monkeypatch.setattr(connection, "ChildProcess", ScriptedProcess)
    monkeypatch.setattr(connection, "_SILENT_S", 600.0)  # it reports only upon requests


@pytest.fixture
def supervisor():
    with SupervisorClient.of_operator(rig_file()) as made:
        yield made


def followed_by(listener):
    task = protocol.SupervisorTask(
        rig_file(), 0.0, 2, MonitorSettings(enabled=False), identity(), 0.0, 1.0, tracked=False
    )
    return SupervisorClient(task, listener)


@pytest.mark.parametrize("error", [OSError("no space left"), ValueError("a bug")])
def test_the_error_of_a_listener_is_raised_where_the_client_waits_and_the_rig_can_still_be_stopped(error):
    seen = []

    def fail(report):
        seen.append(report)
        raise error

    with followed_by(fail) as made:
        with pytest.raises(type(error), match=str(error)):
            made.wait(60.0)
        assert made.ended is None
        made.stop()
        sent = made._sent
        for move in (made.arm, lambda: made.move_to("insertion", 1.0)):
            with pytest.raises(type(error), match=str(error)):
                move()
        assert made._sent == sent  # nothing was requested
        made.stop()
    assert len(seen) > 1  # it still receives reports
    assert made.ended == ""


@pytest.mark.parametrize("waits", [True, False])
def test_the_error_of_a_listener_after_the_last_wait_is_printed_once(monkeypatch, waits):
    """The hook for errors of threads prints it, unless it was raised."""
    printed, fails = [], []
    monkeypatch.setattr(threading, "excepthook", printed.append)

    def listen(_report):
        if fails:
            raise OSError("no space left")

    with followed_by(listen) as made:
        fails.append(True)
        made.stop()
        if waits:
            with pytest.raises(OSError, match="no space left"):
                made.wait(60.0)
    assert [str(one.exc_value) for one in printed] == ([] if waits else ["no space left"])


def test_after_a_stop_a_reset_is_accepted_and_a_tip_without_measured_positions_is_none(supervisor):
    supervisor.stop()
    supervisor.reset()
    assert supervisor.report.state is SupervisorState.IDLE
    assert supervisor.tip(0.0) is None
    assert len(supervisor.read()) == 2


@pytest.mark.parametrize(
    ("readings", "problem"),
    [
        ({"ref1": SensorReading((1.0, 2.0, 3.0))}, "the tracker has no sensor tip, only ref1"),
        ({"tip": SensorReading(None, status="port 1 is worn")}, "port 1 is worn"),
        ({"tip": SensorReading((1.0, 2.0, 3.0))}, "its position or orientation is not known"),
        ({}, "the tracker has no sensor tip, only none"),
        (None, "the tracker's status is ok"),
    ],
)
def test_the_reason_why_the_tip_is_not_measured_is_its_sensors(readings, problem):
    frame = None if readings is None else Frame(0.0, 1, readings)
    client = SimpleNamespace(status="ok", _measurements=[Measurement(0.0, None, None, None, frame)])
    assert SupervisorClient.tip_problem.fget(client) == problem


def test_a_refused_request_has_its_reason(supervisor):
    supervisor.request_stop("another thread")
    with pytest.raises(RefusedError, match="motors have not come to rest yet"):
        supervisor.reset()
    with pytest.raises(RefusedError, match="guide_y is beyond its range"):
        supervisor.arm(-1.0)


def test_arming_that_ends_in_a_fault_and_a_motor_that_stays_on_are_errors_with_their_reason(supervisor):
    with pytest.raises(DriverError, match="A is in motion"):
        supervisor.off()
    with pytest.raises(DriverError, match="the motor does not follow"):
        supervisor.arm()
