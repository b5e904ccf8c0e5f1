"""Jobs over a real worker's process: what replaces what, and what happens when the worker does not do as it should."""

import json
from dataclasses import replace
from threading import Event
from time import monotonic

import pytest

from page_clients import PATIENCE_S, QUICK, STUB, Client, served
from page_worker import CRASHES, HANGS, SLOW, WORKS_ON


@pytest.fixture
def planned(client):
    """A client whose server has nothing to do any more."""
    client.job("plan", "done")
    return client


def start(client, seed, work="plan"):
    """Start work with a seed, which the worker carries out or not."""
    client.do("options", seed=seed)
    client.do("start", work=work)
    return client.wait(lambda: running_number(client, work))


def running_number(client, kind):
    job = client.newest.get(f"job {kind}", {"state": ""})
    return job["job"] if job["state"] == "running" else None


def test_a_newer_plan_replaces_the_one_that_runs(planned):
    older = start(planned, WORKS_ON)
    planned.do("start", work="plan")
    newer = planned.wait(
        lambda: (running_number(planned, "plan") or 0) > older and running_number(planned, "plan")
    )
    assert newer == older + 1


def test_a_comparison_replaces_a_plan(planned):
    start(planned, WORKS_ON)
    planned.do("start", work="compare")
    planned.job("plan", "cancelled")
    compared = planned.job("compare", "running")
    assert planned.newest["job plan"]["job"] < compared["job"]


def test_an_edit_cancels_what_is_searched_for_the_old_scenario(planned):
    start(planned, WORKS_ON)
    planned.do("edit", values={"target.depth_mm": 35.0})
    planned.job("plan", "cancelled")
    planned.wait(lambda: planned.newest["estimate"]["revision"] == 3)
    assert planned.newest["session"]["values"]["target.depth_mm"] == 35.0


def test_a_reach_goes_on_while_the_target_is_moved_and_is_cancelled_by_another_edit(planned):
    planned.do("start", work="reach")
    reach = planned.job("reach", "running")["job"]
    planned.do("edit", values={"target.depth_mm": 35.0})
    planned.wait(lambda: planned.newest["estimate"]["revision"] == 2)
    assert planned.job("reach", "running")["job"] == reach
    planned.do("edit", values={"tissue.0.alpha": 9.0})
    assert planned.job("reach", "cancelled")["job"] == reach


def test_a_plan_sets_the_reach_back_which_is_then_done(planned):
    planned.do("start", work="reach")
    reach = planned.job("reach", "running")["job"]
    planned.do("start", work="plan")
    planned.job("plan", "done")
    assert planned.job("reach", "running")["job"] == reach


def test_a_worker_that_does_not_cancel_is_ended_and_the_next_order_carried_out(planned):
    number = start(planned, HANGS)
    planned.do("cancel", job=number)
    assert planned.job("plan", "cancelled")["job"] == number
    start_again(planned)


def test_a_worker_that_has_ended_is_started_again(planned):
    planned.do("options", seed=CRASHES)
    planned.do("start", work="plan")
    text = planned.job("plan", "failed")["text"]
    assert text == "the worker has ended (exit status 3) and is started again"
    start_again(planned)


def start_again(client):
    client.do("options", seed=0)
    client.do("start", work="plan")
    client.job("plan", "done")


def test_an_insertion_whose_worker_ends_has_failed(tmp_path):
    """Without an end of the insertion from its worker, the server reports it; plans are not affected."""
    with served(tmp_path) as server, Client(server) as client:
        client.steer().do("insert", paused=True)
        client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "paused")
        server.handler._insertions.worker.kill()
        client.wait(lambda: client.newest["insertion live"]["state"] == "failed")
        assert "has ended" in client.newest["insertion live"]["summary"]
        client.job("insertion", "failed")
        client.do("start", work="plan")
        client.do("insert", paused=True)
        client.wait(lambda: client.newest["insertion live"]["state"] == "paused")


def broken(script):
    return ("page_script_worker", script)


def test_until_the_worker_is_ready_its_first_job_says_so(tmp_path):
    """The others do not repeat it; after an edit the first is the needle again."""
    with (
        served(tmp_path, workers=(broken("channel.receive(None)"), STUB)) as server,
        Client(server) as client,
    ):
        needle, estimate, plan = (client.job(kind, "waiting") for kind in ("needle", "estimate", "plan"))
        assert "the first time after installation this takes about a minute" in needle["text"]
        assert estimate["text"] == plan["text"] == ""
        client.steer().do("edit", values={"target.depth_mm": 35.0})
        client.wait(lambda: client.newest["job needle"]["job"] > needle["job"])
        assert client.newest["job needle"]["text"] == needle["text"]


def test_the_scene_is_shown_before_a_worker_is_ready_and_follows_edits(tmp_path):
    with (
        served(tmp_path, workers=(broken("channel.receive(None)"), STUB)) as server,
        Client(server) as client,
    ):
        depth = client.newest["session"]["values"]["target.depth_mm"]
        assert client.wait(lambda: client.newest.get("scene"))["target"][0] == depth != 31.0
        client.steer().do("edit", values={"target.depth_mm": 31.0})
        client.wait(lambda: client.newest["scene"]["target"][0] == 31.0)
        assert client.newest["job needle"]["state"] == "waiting"


def test_what_waits_for_another_job_does_not_say_that_its_worker_starts(planned):
    start(planned, WORKS_ON)
    planned.do("start", work="reach")
    assert planned.job("reach", "waiting")["text"] == ""


@pytest.mark.parametrize(
    "script",
    [
        "import sys; sys.exit(7)",
        "channel.send('no message'); channel.receive(None)",
        "import os; os.write(channel.fileno(), b'\\2\\0\\0\\0no'); channel.receive(None)",
    ],
)
def test_a_broken_worker_fails_its_jobs_and_the_server_stays(tmp_path, script):
    with served(tmp_path, workers=(broken(script), STUB)) as server, Client(server) as client:
        client.wait(lambda: client.newest.get("job needle", {}).get("state") == "failed")
        client.steer().do("edit", values={"target.depth_mm": 35.0})
        assert client.newest["session"]["values"]["target.depth_mm"] == 35.0


def test_work_is_cancelled_when_nobody_is_connected_and_done_again(server):
    with Client(server) as client:
        client.job("plan", "done")
        client.steer().do("start", work="reach")
        client.job("reach", "running")
        client.do("insert", paused=True)
        client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "paused")
        client.do("edit", values={"target.depth_mm": 35.0})
        client.do("start", work="reach")
        client.job("reach", "running")
    wait_until_alone(server)
    with Client(server) as client:
        client.job("reach", "cancelled")
        client.job("insertion", "done")  # it was stopped, with the reason
        ended = client.newest["insertion live"]
        assert ended["state"] == "interrupted"
        assert json.loads(ended["summary"])["stop"] == "nobody was connected"
        client.job("needle", "done")


def test_a_plan_that_is_missing_is_made_when_somebody_comes_again(server):
    with Client(server) as client:
        client.job("plan", "done")
        first = client.newest["job plan"]["job"]
    wait_until_idle(server)
    with Client(server) as client:
        client.job("estimate", "done")
        assert client.newest["job plan"]["job"] == first
        client.steer().do("edit", values={"target.depth_mm": 35.0})
    wait_until_idle(server)
    with Client(server) as client:
        client.wait(lambda: client.newest.get("plan manipulation", {}).get("revision") == 2)


def wait_until_idle(server):
    end = monotonic() + PATIENCE_S
    while not server.handler._idle and monotonic() < end:
        Event().wait(0.01)


def test_a_run_that_is_closed_before_it_is_read_is_not_shown(server, client, tmp_path):
    (tmp_path / "runs" / SLOW).mkdir(parents=True)
    (tmp_path / "runs" / SLOW / "run.json").write_text("{}")
    client.do("open", name=SLOW, second=True)
    client.job("recording", "running")
    client.do("open", name=None)  # the other one
    client.do("open", name=None, second=True)
    client.job("recording", "cancelled")
    with Client(server) as other:
        other.do("rows_from", index=0)
        assert not {"insertion second", "frame 3 4"} & set(other.newest)


def wait_until_alone(server):
    """Wait for the timer that cancels; the server's thread has no other event to wait for."""
    end = monotonic() + PATIENCE_S
    while (server.handler._plans.orders or server.handler._insertions.orders) and monotonic() < end:
        Event().wait(0.01)


def test_a_page_that_is_loaded_again_keeps_the_work(tmp_path):
    with served(tmp_path, limits=replace(QUICK, alone_s=60.0)) as server:
        with Client(server) as client:
            client.job("plan", "done")
            client.steer().do("start", work="reach")
            job = client.job("reach", "running")["job"]
        with Client(server) as client:
            assert client.job("reach", "running")["job"] == job


@pytest.fixture
def with_study(planned, tmp_path):
    """A client of a server with a study and a run."""
    for name, file in (("many", "study.json"), ("one", "run.json")):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / file).write_text("{}")
    return planned


def open_row(client, **values):
    """Begin with a row that is worked on until it is cancelled."""
    client.do("open", name="many", row=WORKS_ON, **values)
    return client.wait(lambda: running_number(client, "row"))


def test_a_plan_sets_a_row_back_which_is_then_begun_again(with_study):
    row = open_row(with_study)
    with_study.do("start", work="plan")
    with_study.job("plan", "done")
    assert with_study.job("row", "running")["job"] == row


def test_a_row_does_not_set_another_back(server, with_study):
    first = open_row(with_study)
    with_study.do("open", name="many", row=3, second=True)
    running = server.handler._plans._running
    assert (running.order.job, running.cancelled) == (first, False)
    with_study.do("cancel", job=first)
    with_study.job("row", "done")
    assert "insertion second" in with_study.newest


def test_a_recording_replaces_a_row_in_its_place(with_study):
    open_row(with_study)
    with_study.do("open", name="one")
    with_study.job("row", "cancelled")
    with_study.job("recording", "done")
    assert with_study.newest["insertion first"]["row"] is None


def test_a_row_that_waits_is_replaced_too(with_study):
    start(with_study, WORKS_ON)
    with_study.do("open", name="many", row=3)
    with_study.job("row", "waiting")
    with_study.do("open", name="one")
    with_study.job("row", "cancelled")
    assert "insertion first" not in with_study.newest  # it had not begun


def test_closing_a_recording_cancels_the_row_that_would_replace_it(with_study):
    open_row(with_study)
    with_study.do("open", name=None)
    with_study.job("row", "cancelled")
    with_study.do("start", work="plan")
    with_study.job("plan", "done")
    assert "insertion first" not in with_study.newest
