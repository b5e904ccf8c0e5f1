"""Jobs of a worker: replacement, cancellation, interruption, and workers that end or do not answer."""

import json
from dataclasses import replace
from threading import Event
from time import monotonic

import pytest

from page_clients import PATIENCE_S, QUICK, STUB, Client, served
from page_worker import CRASHES, HANGS, SLOW, WORKS_ON

DEEPER = {"target.depth_mm": 35.0}


@pytest.fixture
def planned(client):
    """A client whose server has nothing left to do."""
    client.job("plan", "done")
    return client


def start(client, seed, work="plan"):
    """Start work with a seed, which chooses a failure; return its number."""
    client.do("options", seed=seed)
    client.do("start", work=work)
    return client.job(work, "running")["job"]


def test_a_newer_plan_or_comparison_replaces_the_one_that_runs(planned):
    older = start(planned, WORKS_ON)
    planned.do("start", work="plan")
    newer = planned.wait(lambda: (job := planned.job("plan", "running")["job"]) > older and job)
    planned.do("start", work="compare")
    assert planned.job("plan", "cancelled")["job"] == newer
    assert planned.job("compare", "running")["job"] > newer


def test_an_edit_cancels_the_plan_of_the_old_scenario(planned):
    start(planned, WORKS_ON)
    planned.do("edit", values=DEEPER)
    planned.job("plan", "cancelled")
    planned.has("estimate", revision=3)


def test_a_reach_continues_while_the_target_is_moved_and_after_a_plan(planned):
    planned.do("start", work="reach")
    reach = planned.job("reach", "running")["job"]
    planned.do("edit", values=DEEPER)
    planned.has("estimate", revision=2)
    assert planned.job("reach", "running")["job"] == reach
    planned.do("start", work="plan")
    planned.has("plan manipulation", revision=2)
    assert planned.job("reach", "running")["job"] == reach
    planned.do("edit", values={"tissue.0.alpha": 9.0})
    assert planned.job("reach", "cancelled")["job"] == reach


@pytest.mark.parametrize("seed", [HANGS, CRASHES])
def test_a_worker_that_does_not_cancel_or_has_ended_is_started_again(tmp_path, seed):
    with served(tmp_path, limits=replace(QUICK, cancel_s=0.1)) as server, Client(server) as client:
        client.job("plan", "done")
        client.steer().do("options", seed=seed)
        client.do("start", work="plan")
        if seed == HANGS:
            client.do("cancel", job=client.job("plan", "running")["job"])
            client.job("plan", "cancelled")
        else:
            assert "exit status 3" in client.job("plan", "failed")["text"]
        client.do("options", seed=0)
        client.do("start", work="plan")
        client.job("plan", "done")


def test_an_insertion_whose_worker_ends_has_failed(server, client):
    """The server reports the end in place of the worker; plans are not affected."""
    client.inserts("paused", paused=True)
    server.handler._insertions.worker.kill()
    assert "has ended" in client.has("insertion live", state="failed")["summary"]
    client.job("insertion", "failed")
    client.do("start", work="plan")
    client.job("plan", "done")
    client.inserts("paused", paused=True)


def broken(script):
    return ("page_script_worker", script)


def test_before_a_worker_is_ready_the_scene_is_shown_and_its_first_job_gives_the_reason(tmp_path):
    """The other jobs do not repeat the reason; after an edit the first is the needle again."""
    workers = (broken("channel.receive(None)"), STUB)
    with served(tmp_path, workers=workers) as server, Client(server) as client:
        needle, estimate, plan = (client.job(kind, "waiting") for kind in ("needle", "estimate", "plan"))
        assert "about a minute" in needle["text"]
        assert estimate["text"] == plan["text"] == ""
        client.steer().do("edit", values=DEEPER)
        assert client.has("scene", revision=2)["target"][0] == 35.0
        client.wait(lambda: client.newest["job needle"]["job"] > needle["job"])
        assert client.newest["job needle"]["text"] == needle["text"]


def test_a_job_that_waits_for_another_does_not_report_a_start(planned):
    start(planned, WORKS_ON)
    planned.do("start", work="reach")
    assert planned.job("reach", "waiting")["text"] == ""


@pytest.mark.parametrize(
    "script",
    [
        "import sys; sys.exit(7)",
        "import os; os.write(channel.fileno(), b'\\2\\0\\0\\0no'); channel.receive(None)",
    ],
)
def test_a_broken_worker_fails_its_jobs_and_the_server_continues(tmp_path, script):
    with served(tmp_path, workers=(broken(script), STUB)) as server, Client(server) as client:
        client.job("needle", "failed")
        client.steer().do("edit", values=DEEPER)
        client.has("session", revision=2)


def wait_for(condition):
    """Wait for the server's thread, which has no event to wait for; fail at the deadline."""
    end = monotonic() + PATIENCE_S
    while not condition():
        assert monotonic() < end, "the condition did not hold in time"
        Event().wait(0.01)


def test_work_is_cancelled_when_nobody_is_connected_and_its_results_are_computed_again(tmp_path):
    with served(tmp_path, limits=replace(QUICK, alone_s=0.1)) as server:
        check_unattended(server)


def check_unattended(server):
    with Client(server) as client:
        client.job("plan", "done")
        client.steer().inserts("paused", paused=True)
        client.do("edit", values=DEEPER)
        client.do("start", work="reach")
        client.job("reach", "running")
    wait_for(lambda: not (server.handler._plans.orders or server.handler._insertions.orders))
    with Client(server) as client:
        client.job("reach", "cancelled")
        client.job("insertion", "done")
        ended = client.has("insertion live", state="interrupted")
        assert json.loads(ended["summary"])["stop"] == "nobody was connected"
        client.job("needle", "done")
        client.has("plan manipulation", revision=2)
        last = client.job("plan", "done")["job"]
    wait_for(lambda: server.handler._idle)
    with Client(server) as client:
        client.job("estimate", "done")
        assert client.newest["job plan"]["job"] == last  # it was not missing


def test_a_page_that_is_loaded_again_keeps_the_work(server):
    with Client(server) as client:
        client.job("plan", "done")
        client.steer().do("start", work="reach")
        job = client.job("reach", "running")["job"]
    with Client(server) as client:
        assert client.job("reach", "running")["job"] == job


@pytest.fixture
def recorded(planned, tmp_path):
    """A client of a server with a study and two runs, one of which is read until it is cancelled."""
    for name, file in (("many", "study.json"), ("one", "run.json"), (SLOW, "run.json")):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / file).write_text("{}")
    return planned


def test_a_run_that_is_closed_before_it_is_read_is_not_shown(server, recorded):
    recorded.do("open", name=SLOW, second=True)
    recorded.job("recording", "running")
    recorded.do("open", name=None)  # the other one
    recorded.do("open", name=None, second=True)
    recorded.job("recording", "cancelled")
    with Client(server) as other:
        other.do("ping")
        assert not {"insertion second", "frame 3 4"} & set(other.newest)


def open_row(client, **values):
    """Compute a row that ends only when it is cancelled; return the number of its job."""
    client.do("open", name="many", row=WORKS_ON, **values)
    return client.job("row", "running")["job"]


def test_a_row_is_interrupted_by_a_plan_and_not_by_another_row(server, recorded):
    first = open_row(recorded)
    recorded.do("start", work="plan")
    recorded.job("plan", "done")
    assert recorded.job("row", "running")["job"] == first
    recorded.do("open", name="many", row=3, second=True)
    running = server.handler._plans._running
    assert (running.order.job, running.cancelled) == (first, False)
    recorded.do("cancel", job=first)
    recorded.job("row", "done")
    assert "insertion second" in recorded.newest


@pytest.mark.parametrize("name", ["one", None])
def test_a_recording_in_its_place_or_its_end_cancels_a_row(recorded, name):
    open_row(recorded)
    recorded.do("open", name=name)
    recorded.job("row", "cancelled")
    if name:
        recorded.job("recording", "done")
    recorded.do("start", work="plan")
    recorded.job("plan", "done")
    shown = recorded.newest.get("insertion first")
    assert shown["row"] is None if name else shown is None


def test_a_recording_replaces_a_row_that_waits(recorded):
    start(recorded, WORKS_ON)
    recorded.do("open", name="many", row=3)
    recorded.job("row", "waiting")
    recorded.do("open", name="one")
    recorded.job("row", "cancelled")
    assert "insertion first" not in recorded.newest  # its worker still plans
