"""Orders and changes that a worker receives, and the pace of its insertion."""

import socket

import pytest

from flexneedle.errors import StoppedError
from flexneedle.lab.page.job_orders import JobChange, WorkOrder
from flexneedle.lab.page.protocol import ClientsMessage
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.page.worker.insertion_jobs import Pacer
from flexneedle.lab.page.worker.task import Cancelled, JobControl, TaskQueue
from flexneedle.lab.process import MessageChannel
from page_clients import PATIENCE_S


@pytest.fixture
def server():
    """The server's end of a worker's channel; `tasks` of the worker."""
    ours, theirs = map(MessageChannel, socket.socketpair())
    ours.tasks = TaskQueue(theirs)
    yield ours
    ours.end_sending()
    while ours.tasks.next() is not None:
        pass
    for end in (ours, theirs):
        end.close()


def test_changes_find_their_job_before_it_has_begun(server):
    for one in (WorkOrder("plan", "plan", 1), WorkOrder("plan", "plan", 2)):
        server.send(one)
    for change in (JobChange(9, stop="x"), JobChange(2, pace=3.0), JobChange(1, stop="y")):
        server.send(change)
    server.end_sending()
    first, second = server.tasks.next(), server.tasks.next()
    assert server.tasks.next() is None
    server.tasks._tasks.put(None)
    assert (first.order.job, second.order.job) == (1, 2)
    assert (first.control.stopped, second.control.pace) == ("y", 3.0)
    assert second.control.stopped == "the server of the page has ended"
    with pytest.raises(Cancelled):
        second.control.check()


def test_reports_reach_the_server_when_the_task_is_closed(server):
    server.send(WorkOrder("plan", "plan", 1))
    task = server.tasks.next()
    for count in range(3):
        task.report(ClientsMessage(clients=count, steering=None))
    server.tasks.close(task)
    assert [message.clients for message in server.receive(PATIENCE_S)] == [0, 1, 2]


def test_a_rig_is_held_until_go_and_again_on_request(server):
    server.send(WorkOrder("insert", "insertion", 1, rig="rig.toml"))
    control, held, stops = server.tasks.next().control, [], []
    control.on_stop = stops.append
    for change in ({}, {"go": True}, {"hold": "nobody is in control"}, {}, {"stop": "person 2"}):
        held.append(control.held)
        control.take(JobChange(1, **change))
    assert [*held, control.held] == ["not armed", "not armed", "", *(["nobody is in control"] * 3)]
    assert stops == ["person 2"]  # at once, in the thread that receives


class Clock:
    """Time that passes only in waits; then: changes by the number of the wait."""

    def __init__(self, control, then=()):
        self.now, self.waits, self._control, self._then = 0.0, [], control, dict(then)

    def wait(self, seconds):
        self.waits.append(seconds)
        change = self._then.get(len(self.waits))
        if change is not None:
            self.now += 0.25 * (seconds or 4.0)
            self._control.take(JobChange(1, **change))
        else:
            assert seconds is not None, "it waits for a change that does not come"
            self.now += seconds


def paced(pace, then=()):
    control, states = JobControl(pace), []
    clock = Clock(control, then)
    control.wait = clock.wait
    pacer = Pacer(control, control.take_disturbs, states.append, lambda: clock.now)
    pacer.start()
    return pacer, clock, states


def test_a_period_takes_its_time_by_the_pace_less_the_time_to_compute_it():
    pacer, clock, states = paced(4.0)
    pacer.wait_for(0.2)
    assert clock.now == pytest.approx(0.05)
    assert states == [False]
    pacer, clock, _ = paced(1.0)
    clock.now += 0.15
    pacer.wait_for(0.2)
    assert clock.waits == [pytest.approx(0.05)]
    clock.now += 5.0  # a long computation delays all later periods
    pacer.wait_for(0.2)
    pacer.wait_for(0.2)
    assert clock.now == pytest.approx(5.4)


def test_the_pace_changes_within_a_period():
    pacer, clock, _ = paced(1.0, {1: {"pace": 10.0}})
    pacer.wait_for(0.4)
    assert clock.now == pytest.approx(0.1 + 0.3 / 10.0)


def test_a_paused_insertion_waits_for_an_advance_or_a_pace():
    pacer, clock, states = paced(1.0, {1: {"pace": 0.0}, 2: {"advance": True}, 3: {"pace": 1.0}})
    pacer.wait_for(0.4)
    assert clock.waits == [pytest.approx(0.4), None]
    assert states == [False, True]
    pacer.wait_for(0.4)
    assert states == [False, True, False]


@pytest.mark.parametrize(
    ("change", "error"), [({"stop": "person 2"}, StoppedError), ({"cancel": True}, Cancelled)]
)
def test_a_stop_ends_a_pause(change, error):
    pacer, clock, _ = paced(1.0, {1: {"pace": 0.0}, 2: change})
    with pytest.raises(error):
        pacer.wait_for(0.4)
    assert len(clock.waits) == 2


def test_waits_end_with_a_change():
    control = JobControl()
    control.take(JobChange(1, disturb=DisturbRequest(type="disturb", what="push", size=1.0)))
    control.wait(None)
    assert [one.what for one in control.take_disturbs()] == ["push"]
    assert control.take_disturbs() == []
