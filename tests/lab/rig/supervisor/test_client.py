"""The client waits for what its requests have changed, and takes no earlier report for it."""

import socket
import threading
from threading import Thread

import pytest

from flexneedle.errors import RefusedError
from flexneedle.geometry.registration import identity
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.supervisor import client, protocol
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from stages import rig_file


class Scripted:
    """The supervisor's process in a thread. The rig was stopped long ago; another stop is acted on, and motors
    rest, heartbeats of a waiting client later.
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

    def _report(self, requests, *, rests):
        self._line.send(
            protocol.TickReport(0.0, SupervisorState.STOPPED, "the test", requests=requests, at_rest=rests)
        )

    def _take(self):
        request = self._line.receive_first()
        self._requests += 1
        return request

    def _serve(self):
        self._line.receive_first()
        self._report(0, rests=True)
        while not isinstance(request := self._take(), protocol.CloseCommand):
            self._answer(request)
        self._line.send(protocol.SupervisorEnded())
        self._line.close()

    def _answer(self, request):
        match request:
            case protocol.StopCommand():
                self._report(self._requests - 1, rests=True)  # an earlier one, that was under way
                self._next = [(self._requests, rests) for rests in (False, False, True)]
            case protocol.Heartbeat() if self._next:
                requests, rests = self._next.pop(0)
                self._report(requests, rests=rests)
            case protocol.ResetCommand() if self._next:
                self._line.send(
                    protocol.RequestRefused(0, "motors have not come to rest yet", SupervisorState.STOPPED)
                )
                self._report(self._requests, rests=False)
                # As the supervisor's own, its number of requests never falls, also if a late client sends heartbeats.
                self._next = [(self._requests, rests) for _, rests in self._next]
            case protocol.ResetCommand():
                self._line.send(protocol.TickReport(0.0, SupervisorState.IDLE, requests=self._requests))


@pytest.fixture
def scripted(monkeypatch):
    monkeypatch.setattr(client, "ChildProcess", Scripted)
    monkeypatch.setattr(client, "_SILENT_S", 60.0)  # it reports only when it is asked


@pytest.fixture
def supervisor(scripted):  # noqa: ARG001  it has to be there first
    with SupervisorClient.of_operator(rig_file()) as made:
        yield made


@pytest.mark.usefixtures("scripted")
@pytest.mark.parametrize("error", [OSError("no space left"), ValueError("a bug")])
def test_what_a_follower_raises_is_raised_where_the_client_waits_and_the_rig_can_still_be_stopped(error):
    seen = []

    def fails(report):
        seen.append(report)
        raise error

    task = protocol.SupervisorTask(
        rig_file(), 0.0, 2, MonitorSettings(enabled=False), identity(), 0.0, 1.0, tracked=False
    )
    with SupervisorClient(task, fails) as made:
        with pytest.raises(type(error), match=str(error)):
            made.wait(5.0)
        assert made.ended is None
        made.stop()
        sent = made._sent
        for move in (made.arm, lambda: made.move_to("insertion", 1.0)):
            with pytest.raises(type(error), match=str(error)):
                move()
        assert made._sent == sent  # nothing was asked for
        made.stop()
    assert len(seen) > 1  # it goes on getting reports, as the others do
    assert made.ended == ""


@pytest.mark.usefixtures("scripted")
@pytest.mark.parametrize("waits", [True, False])
def test_what_a_follower_raises_after_the_last_wait_is_printed(monkeypatch, waits):
    """By the hook for errors of threads; once, also if it was raised before."""
    printed, fails = [], []
    monkeypatch.setattr(threading, "excepthook", printed.append)

    def follower(_report):
        if fails:
            raise OSError("no space left")

    task = protocol.SupervisorTask(
        rig_file(), 0.0, 2, MonitorSettings(enabled=False), identity(), 0.0, 1.0, tracked=False
    )
    with SupervisorClient(task, follower) as made:
        fails.append(True)
        made.stop()
        if waits:
            with pytest.raises(OSError, match="no space left"):
                made.wait(5.0)
    assert [str(one.exc_value) for one in printed] == ([] if waits else ["no space left"])


def test_after_a_stop_a_reset_is_accepted(supervisor):
    supervisor.stop()
    supervisor.reset()
    assert supervisor.report.state is SupervisorState.IDLE


def test_a_request_that_is_refused_has_the_reason(supervisor):
    supervisor.request_stop("another thread")
    with pytest.raises(RefusedError, match="motors have not come to rest yet"):
        supervisor.reset()
