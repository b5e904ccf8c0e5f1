"""The page's worker as a process, and behind the server over a web socket."""

import os
from contextlib import contextmanager
from time import monotonic

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


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """A worker takes its time to start where many run."""
    monkeypatch.setattr(page_clients, "PATIENCE_S", 100.0)


@contextmanager
def started(name):
    child = ChildProcess(MODULE, name)
    try:
        until(child, lambda report: isinstance(report, WorkerReady))
        yield child
    finally:
        child.end(0.0)
        child.close()


def until(child, wanted):
    """Wait for a report."""
    while not child.channel.ended:
        for report in child.channel.receive(100.0):
            if wanted(report):
                return
    raise AssertionError("the worker has ended")


def test_it_cancels_within_a_plan_and_ends_with_its_channel():
    with started("plans") as child:
        for job in (1, 2):
            child.channel.send(WorkOrder("plan", "plan", job, scenario=short(**_LONG).values()))
            until(child, lambda report: isinstance(report, IterationMessage))
            if job == 1:
                begun = monotonic()
                child.channel.send(JobChange(1, cancel=True))
                until(child, lambda report: isinstance(report, JobMessage) and report.state == "cancelled")
                assert monotonic() - begun < 30.0  # 0.1 s on an idle machine, where the plan takes a minute
        assert child.end(60.0) == 0


@pytest.mark.parametrize(("name", "more"), [("plans", 0), ("plans-beside-a-rig", 10)])
def test_plans_beside_a_rig_have_a_lower_priority(name, more):
    with started(name) as child:
        assert os.getpriority(os.PRIO_PROCESS, child.pid) == min(os.nice(0) + more, 19)


@pytest.mark.slow
def test_plan_insert_save_and_read_over_a_web_socket(tmp_path):
    workers = ((MODULE, "plans"), (MODULE, "insertion"))
    with served(tmp_path / "runs", limits=PageLimits(), workers=workers) as server, Client(server) as client:
        client.steer()
        client.do("edit", values={key: short().flat()[key] for key in _CHANGED})
        revision = client.newest["session"]["revision"]
        client.wait(lambda: client.newest.get("estimate", {}).get("revision") == revision)
        client.do("start", work="plan")
        client.wait(lambda: client.newest.get("plan manipulation", {}).get("revision") == revision)
        client.do("insert", paused=True)
        client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "paused")
        client.do("disturb", what="push", size=0.02)
        client.do("advance")
        client.wait(lambda: client.rows.get("live"))
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
        assert [row["index"] for row in client.rows["first"]] == [row["index"] for row in client.rows["live"]]


_CHANGED = (
    "setup.tip_to_skin_mm",
    "target.depth_mm",
    "target.lateral_mm",
    "plan.samples",
    "plan.iterations",
    "plan.max_iterations",
)
