"""The connected rig of the server alone: requests and reports, and its changes of the insertion."""

import asyncio
from unittest.mock import Mock

import pytest

from flexneedle.lab.page.job_orders import RigReport, WorkOrder
from flexneedle.lab.page.protocol import RigCheckMessage
from flexneedle.lab.page.server.clients import PageLimits, Refusal
from flexneedle.lab.page.server.connected_rig import ConnectedRig, RigReference
from flexneedle.lab.page.server.hub import Hub
from recorded_page import insertion

JOB, NOBODY = 4, "nobody is in control"


class Jobs:
    """The jobs of a worker that starts each at once: its changes without beats, and deadlines of its end."""

    def __init__(self):
        self.changes, self.deadlines = [], []

    def add(self, _work):
        return JOB

    def change(self, number, **change):
        assert number == JOB
        if change:
            self.changes.append(change)
        return True

    def expect_end(self, seconds):
        self.deadlines.append(seconds)


class Bench(ConnectedRig):
    """A rig whose insertion is prepared."""

    def __init__(self):
        self.jobs, self.hub = Jobs(), Hub()
        super().__init__(self.hub, lambda: self.jobs, PageLimits(), RigReference("Bench", "rig.toml"))
        self.prepare(WorkOrder("insert", "insertion", rig="rig.toml"))

    def reports(self, state, why="", waits=0):
        self.take(RigReport(state, why, waits, ("a",) if waits else ()))

    def starts(self):
        self.reports("idle", waits=1)
        self.arm(JOB)
        self.go()

    @property
    def shown(self):
        return self.hub.newest("rig").state

    def refuses_to_go(self):
        with pytest.raises(Refusal, match="not armed"):
            self.go()

    def refuses_to_arm(self):
        with pytest.raises(Refusal, match="not ready"):
            self.arm(JOB)


@pytest.fixture
def bench(monkeypatch):
    """A rig on an event loop whose timers never expire."""
    monkeypatch.setattr(asyncio, "get_running_loop", Mock)
    return Bench()


def test_it_is_armed_for_one_start(bench):
    bench.starts()
    bench.refuses_to_go()
    assert bench.jobs.changes == [{"go": True}]


def test_a_report_from_before_the_start_is_no_new_wait(bench):
    bench.starts()
    bench.reports("idle", why="late", waits=1)
    assert bench.shown == "starting"
    bench.refuses_to_arm()
    bench.reports("holding", waits=2)
    bench.arm(JOB)


@pytest.mark.parametrize(
    ("state", "change"),
    [
        *((state, "stop") for state in ("idle", "armed", "jogging")),
        *((state, "hold") for state in ("inserting", "holding")),
        *((state, None) for state in ("ended", "fault")),
    ],
)
def test_without_control_it_is_stopped_before_it_begins_and_then_held(bench, state, change):
    bench.starts()
    bench.reports(state)
    assert change != "stop" or bench.shown == "starting"
    bench.lose_control(NOBODY)
    assert bench.jobs.changes[1:] == ([{change: NOBODY}] if change else [])


@pytest.mark.parametrize("times", [1, 2])
def test_control_is_lost_before_the_insertion_has_continued(bench, times):
    """Its loop has not noticed that it may continue, and reports no new wait."""
    bench.starts()
    bench.reports("holding", why=NOBODY, waits=2)
    bench.arm(JOB)
    bench.go()
    assert bench.shown == "holding"
    for _ in range(times):
        bench.lose_control(NOBODY)
    bench.reports("holding", why=NOBODY, waits=2)
    bench.arm(JOB)
    assert bench.shown == "armed"
    bench.go()
    assert bench.jobs.changes[-1] == {"go": True}


def test_control_is_lost_just_after_the_insertion_has_continued(bench):
    bench.starts()
    bench.reports("inserting")
    bench.lose_control(NOBODY)
    bench.refuses_to_arm()
    bench.reports("holding", waits=2)
    bench.arm(JOB)
    assert bench.shown == "armed"


@pytest.mark.parametrize("state", ["stopped", "fault", "ended"])
@pytest.mark.parametrize("waits", [0, 1, 2])
def test_a_stopped_rig_is_not_armed_again(bench, waits, state):
    """Even if a later report still contains its wait."""
    bench.reports("idle", waits=1)
    if waits == 2:
        bench.arm(JOB)
        bench.go()
        bench.reports("holding", waits=2)
    bench.arm(JOB)
    bench.reports(state, why="no reply", waits=waits)
    assert bench.shown == state
    bench.refuses_to_go()
    bench.refuses_to_arm()


@pytest.mark.parametrize(
    ("state", "shown"),
    [("ended", "idle"), ("stopped", "stopped"), ("fault", "fault"), ("inserting", "fault")],
)
def test_the_deadline_is_for_the_motors_and_the_end_is_shown(bench, state, shown):
    """The record may take longer; a worker that ends while the rig moves leaves a fault."""
    bench.starts()
    bench.stop("person 2")
    assert bench.jobs.deadlines == [PageLimits().stop_s]
    bench.reports(state, why="person 2")
    if state != "inserting":
        assert bench.jobs.deadlines[-1] is None
        with pytest.raises(Refusal, match="record is being written"):
            bench.stop("person 3")
    bench.end("done", "the supervisor has ended")
    assert (bench.shown, bench.active) == (shown, False)


@pytest.mark.parametrize(
    ("motion", "marked"),
    [("insertion", ["check"]), ("retraction", ["check", "insertion live"])],
)
def test_a_check_and_a_drawn_needle_are_outdated_once_the_rig_moves(bench, motion, marked):
    keys = ("check", "insertion live")
    bench.hub.publish(RigCheckMessage(revision=1, findings=[]))
    bench.hub.publish(insertion("held", rig="Bench"))
    bench.motion = motion
    bench.reports("idle", waits=1)
    bench.arm(JOB)
    assert not any(bench.hub.newest(key).moved for key in keys)
    bench.go()
    assert [key for key in keys if bench.hub.newest(key).moved] == marked


def test_a_refused_preparation_makes_a_check_outdated(bench):
    bench.hub.publish(RigCheckMessage(revision=1, findings=[]))
    bench.end("failed", "guide_y: at 1.5 mm")
    assert bench.hub.newest("check").moved
