"""The connected rig of the server alone: its changes of the insertion, by requests and reports."""

import asyncio

import pytest

from flexneedle.lab.page.job_orders import RigReport, WorkOrder
from flexneedle.lab.page.server.clients import PageLimits, Refusal
from flexneedle.lab.page.server.connected_rig import ConnectedRig, RigReference
from flexneedle.lab.page.server.hub import Hub

JOB = 4


class Jobs:
    """The jobs of a worker that runs each at once: its changes without beats, and deadlines of its end."""

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


@pytest.fixture
def on_loop():
    """Return a function that calls another with a prepared rig, within an event loop."""

    def call(test):
        async def run():
            bench = Bench()
            test(bench)
            bench.end("done", "")

        asyncio.run(run())

    return call


def test_one_arm_is_for_one_start(on_loop):
    def test(bench):
        bench.starts()
        with pytest.raises(Refusal, match="Bench is not armed"):
            bench.go()
        assert bench.jobs.changes == [{"go": True}]

    on_loop(test)


def test_a_report_from_before_the_start_is_no_new_wait(on_loop):
    def test(bench):
        bench.starts()
        bench.reports("idle", why="late", waits=1)
        assert bench.shown == "starting"
        with pytest.raises(Refusal, match="not ready"):
            bench.arm(JOB)
        bench.reports("holding", waits=2)
        bench.arm(JOB)

    on_loop(test)


@pytest.mark.parametrize("state", ["idle", "armed", "jogging"])
def test_nobody_steers_before_it_has_begun(on_loop, state):
    def test(bench):
        bench.starts()
        bench.reports(state)
        assert bench.shown == "starting"
        bench.lose_control("nobody is in control")
        assert bench.jobs.changes[1:] == [{"stop": "nobody is in control"}]

    on_loop(test)


@pytest.mark.parametrize(("state", "signals"), [("inserting", 1), ("holding", 1), ("ended", 0), ("fault", 0)])
def test_nobody_steers_after_it_has_begun(on_loop, state, signals):
    def test(bench):
        bench.starts()
        bench.reports(state)
        bench.lose_control("nobody is in control")
        assert bench.jobs.changes[1:] == [{"hold": "nobody is in control"}] * signals

    on_loop(test)


@pytest.mark.parametrize("times", [1, 2])
def test_nobody_steers_before_the_insertion_has_gone_on(on_loop, times):
    """Its loop has not looked since it may go, so that it still rests, and reports no new wait."""

    def test(bench):
        bench.starts()
        bench.reports("holding", why="nobody is in control", waits=2)
        bench.arm(JOB)
        bench.go()
        assert bench.shown == "holding"
        for _ in range(times):
            bench.lose_control("person 2 is gone")
        bench.reports("holding", why="person 2 is gone", waits=2)
        bench.arm(JOB)
        assert bench.shown == "armed"
        bench.go()
        assert bench.jobs.changes[-1] == {"go": True}

    on_loop(test)


def test_nobody_steers_just_after_the_insertion_has_gone_on(on_loop):
    def test(bench):
        bench.starts()
        bench.reports("inserting")
        bench.lose_control("nobody is in control")
        with pytest.raises(Refusal, match="not ready"):
            bench.arm(JOB)
        bench.reports("holding", waits=2)
        bench.arm(JOB)

    on_loop(test)


@pytest.mark.parametrize("state", ["stopped", "fault", "ended"])
@pytest.mark.parametrize("waits", [0, 1, 2])
def test_a_rig_that_was_stopped_is_not_armed_any_more(on_loop, waits, state):
    """Also one that reports on, for what it waited."""

    def test(bench):
        bench.reports("idle", waits=1)
        if waits == 2:
            bench.arm(JOB)
            bench.go()
            bench.reports("holding", waits=2)
        bench.arm(JOB)
        bench.reports(state, why="no reply", waits=waits)
        assert bench.shown == state
        with pytest.raises(Refusal, match="Bench is not armed"):
            bench.go()
        with pytest.raises(Refusal, match="Bench is not ready"):
            bench.arm(JOB)

    on_loop(test)


@pytest.mark.parametrize("state", ["ended", "stopped", "fault"])
def test_a_worker_may_take_its_time_for_the_record_once_the_motors_are_stopped(on_loop, state):
    def test(bench):
        bench.starts()
        bench.stop("person 2")
        assert bench.jobs.deadlines == [PageLimits().stop_s]
        bench.reports(state)
        assert bench.jobs.deadlines[-1] is None
        with pytest.raises(Refusal, match="its record is being written"):
            bench.stop("person 3")

    on_loop(test)


@pytest.mark.parametrize(
    ("state", "shown"), [("ended", "idle"), ("stopped", "stopped"), ("inserting", "fault")]
)
def test_how_it_has_ended_is_shown(state, shown):
    async def run():
        bench = Bench()
        bench.starts()
        bench.reports(state, why="person 2")
        bench.end("done", "the supervisor has ended")
        assert (bench.shown, bench.active) == (shown, False)

    asyncio.run(run())
