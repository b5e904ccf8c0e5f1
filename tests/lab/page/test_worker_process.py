"""The page's worker as a process, and behind the server over a web socket."""

import os

import pytest

import page_clients
from flexneedle.lab.page.job_orders import JobChange, WorkerReady, WorkOrder
from flexneedle.lab.page.protocol import IterationMessage, JobMessage
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.process import ChildProcess
from page_clients import Client, served
from page_tasks import short

MODULE = "flexneedle.lab.page.worker"
_LONG = {"plan.samples": 2000, "plan.iterations": 500, "plan.max_iterations": 500}
"""A search of a minute, which is cancelled in the first iterations."""


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """A worker starts slowly beside other processes."""
    monkeypatch.setattr(page_clients, "PATIENCE_S", 100.0)


def until(child, wanted):
    """Wait for a report."""
    while not child.channel.ended:
        for report in child.channel.receive(100.0):
            if wanted(report):
                return
    raise AssertionError("the worker has ended")


def priority_of(child):
    return os.getpriority(os.PRIO_PROCESS, child.pid)


def test_beside_a_rig_it_has_a_lower_priority_cancels_within_a_plan_and_ends_with_its_channel():
    child = ChildProcess(MODULE, "plans-beside-a-rig")
    try:
        until(child, lambda report: isinstance(report, WorkerReady))
        assert priority_of(child) == min(os.nice(0) + 10, 19)
        for job in (1, 2):
            child.channel.send(WorkOrder("plan", "plan", job, scenario=short(**_LONG).values()))
            until(child, lambda report: isinstance(report, IterationMessage))
            if job == 1:
                child.channel.send(JobChange(1, cancel=True))
                until(child, lambda report: isinstance(report, JobMessage) and report.state == "cancelled")
        assert child.end(60.0) == 0
    finally:
        child.end(0.0)
        child.close()


@pytest.mark.slow
def test_plan_insert_save_and_read_over_a_web_socket(tmp_path):
    workers = ((MODULE, "plans"), (MODULE, "insertion"))
    with served(tmp_path / "runs", limits=PageLimits(), workers=workers) as server, Client(server) as client:
        client.steer()
        client.do("edit", values={key: short().flat()[key] for key in _CHANGED})
        revision = client.newest["session"]["revision"]
        client.has("estimate", revision=revision)
        client.do("start", work="plan")
        client.has("plan manipulation", revision=revision)
        client.inserts("paused", paused=True)
        client.do("disturb", what="push", size=0.02)
        client.do("advance")
        client.got_rows(1)
        client.do("pace", pace=50.0)
        client.job("insertion", "done")
        live = client.newest["insertion live"]
        assert live["state"] == "done"
        assert live["periods"] == len(client.rows["live"])
        assert client.newest["disturbances"]["active"] == ["push of 0.02 N at 0°"]
        client.do("save", name="first")
        client.job("save", "done")
        client.do("open", name="first")
        client.job("recording", "done")
        client.got_rows(live["periods"], "first")
        assert priority_of(server.handler._insertions.worker._child) == os.nice(0)


_CHANGED = (
    "setup.tip_to_skin_mm",
    "target.depth_mm",
    "target.lateral_mm",
    "plan.samples",
    "plan.iterations",
    "plan.max_iterations",
)
