"""The page's worker as a process, and behind the server over a web socket."""

import json
import os
import subprocess
import sys
from time import monotonic

import pytest

import page_clients
from flexneedle.lab.page import channel
from flexneedle.lab.page.orders import Signal, Work
from flexneedle.lab.page.server.limits import Limits
from page_clients import Client, served
from page_tasks import short

COMMAND = (sys.executable, "-m", "flexneedle.lab.page.worker")
_LONG = {"plan.samples": 2000, "plan.iterations": 500, "plan.max_iterations": 500}


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """A worker takes its time to start where many run."""
    monkeypatch.setattr(page_clients, "PATIENCE_S", 100.0)


def until(process, wanted):
    while (message := channel.read(process.stdout)) is not None:
        if isinstance(message, str) and wanted(values := json.loads(message)):
            return values
    raise AssertionError("the worker has ended")


def send(process, order):
    process.stdin.write(channel.packed(order.model_dump_json(exclude_defaults=True)))
    process.stdin.flush()


def test_it_cancels_within_a_plan_and_ends_with_its_stdin():
    with subprocess.Popen((*COMMAND, "plans"), stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        until(process, lambda news: news["type"] == "ready")
        send(process, Work(job=1, do="plan", kind="plan", scenario=short(**_LONG).values()))
        until(process, lambda news: news["type"] == "iteration")
        begun = monotonic()
        send(process, Signal(job=1, cancel=True))
        until(process, lambda news: news["type"] == "job" and news["state"] == "cancelled")
        assert monotonic() - begun < 30.0  # 0.1 s on a machine that is free, where the plan takes a minute
        send(process, Work(job=2, do="plan", kind="plan", scenario=short(**_LONG).values()))
        until(process, lambda news: news["type"] == "iteration")
        process.stdin.close()
        process.stdout.read()
        assert process.wait(60.0) == 0


@pytest.mark.parametrize(("name", "more"), [("plans", 0), ("plans-beside-a-rig", 10)])
def test_beside_a_rig_plans_give_way(name, more):
    with subprocess.Popen((*COMMAND, name), stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        until(process, lambda news: news["type"] == "ready")
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(os.nice(0) + more, 19)
        process.stdin.close()


@pytest.mark.slow
def test_plan_insert_save_and_read_over_a_web_socket(tmp_path):
    workers = ((*COMMAND, "plans"), (*COMMAND, "insertion"))
    with served(tmp_path / "runs", limits=Limits(), workers=workers) as server, Client(server) as client:
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
