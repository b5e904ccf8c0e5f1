"""The connected rig on the server: prepared, armed, started, held and stopped; with a worker that has no rig."""

import json
from dataclasses import replace

import pytest

from flexneedle.lab.page.server.connected_rig import RigReference
from page_clients import QUICK, Client, get, served
from page_worker import FAULTY, RECORDS, UNSTOPPABLE, WORKS_ON

RIG = RigReference("Bench", "bench.toml")
WITHOUT_ANYBODY = "nobody is in control: the connection was lost"


@pytest.fixture
def server(tmp_path):
    with served(tmp_path / "runs", rig=RIG) as server:
        yield server


@pytest.fixture
def watcher(server):
    """A client that does not steer."""
    with Client(server) as client:
        yield client


def rig_is(client, state, why=None):
    """Wait for a state of the rig."""
    client.wait(lambda: client.newest["rig"]["state"] == state)
    assert why is None or client.newest["rig"]["why"] == why
    return client.newest["rig"]


def prepared(client):
    client.do("prepare")
    rig_is(client, "ready")


def armed(client):
    prepared(client)
    client.do("arm", armed=True, job=client.newest["rig"]["job"])
    rig_is(client, "armed")


def inserting(client):
    armed(client)
    client.do("go")
    rig_is(client, "inserting")


def test_it_is_prepared_armed_and_started(client):
    assert client.newest["welcome"]["rig"] == "Bench"
    assert rig_is(client, "idle")["job"] is None
    assert client.refused("arm", armed=True, job=1) == "Bench is not prepared: prepare it first"
    assert client.refused("go") == "Bench is not armed: arm it first"
    prepared(client)
    assert client.newest["rig"]["moves"] == ["wait 1"]
    assert client.refused("go") == "Bench is not armed: arm it first"
    job = client.newest["rig"]["job"]
    reason = f"job = {job + 1}: must be {job}, the insertion that waits"
    assert client.refused("arm", armed=True, job=job + 1) == reason
    client.do("arm", armed=True, job=job)
    assert not rig_is(client, "armed")["begun"]
    client.do("go")
    assert rig_is(client, "inserting")["begun"]
    assert client.newest["rig"]["moves"] == []


def test_it_gets_the_session_the_rig_file_and_the_folder_of_runs(client, tmp_path):
    client.do("edit", values={"target.depth_mm": 35.0})
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    prepared(client)
    order = summary(client)
    assert order["scenario"]["target"]["depth_mm"] == 35.0
    wanted = {"rig": "bench.toml", "folder": str(tmp_path / "runs"), "seed": 3, "strategy": "steering"}
    assert wanted.items() <= order.items()


def summary(client):
    """What the worker of insertions has got last."""
    return json.loads(client.newest["insertion live"]["summary"])


def test_downloads_that_compute_are_refused_from_its_preparation_on(server, client, tmp_path):
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "run.json").write_text("{}")
    prepared(client)
    for file in ("trace.csv", "replay.html"):
        status, text, _headers = get(server, f"/runs/mine/{file}")
        assert (status, text.startswith("an insertion is on the rig, and this would take")) == (404, True)
    assert get(server, "/runs/mine/run.zip")[0] == 200


def test_it_is_armed_for_one_start(client):
    inserting(client)
    assert client.refused("go") == "Bench is not armed: arm it first"
    reason = "Bench is not ready: it can be armed when its motions are shown"
    assert client.refused("arm", armed=True, job=client.newest["rig"]["job"]) == reason
    client.do("stop")
    rig_is(client, "stopped")
    client.job("insertion", "done")
    assert client.refused("go") == "Bench is not armed: arm it first"
    prepared(client)
    assert client.refused("go") == "Bench is not armed: arm it first"


def test_it_is_disarmed_by_itself(tmp_path):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, armed_s=0.1)) as server, Client(server) as client:
        armed(client.steer())
        rig_is(client, "ready", why="not started within 0.1 s: arm it again")
        assert client.refused("go") == "Bench is not armed: arm it first"


@pytest.mark.parametrize("so_far", [prepared, armed])
@pytest.mark.parametrize(
    ("request_", "values", "why"),
    [
        ("edit", {"values": {"target.depth_mm": 35.0}}, "the scenario or an option was changed"),
        ("preset", {"name": "phantom3d"}, "the scenario or an option was changed"),
        ("options", {"seed": 3}, "the scenario or an option was changed"),
        ("steer", {"take": False}, "nobody is in control: it was released"),
    ],
)
def test_what_is_prepared_ends_when_it_is_not_what_is_shown_or_nobody_steers(
    client, so_far, request_, values, why
):
    so_far(client)
    client.do(request_, **values)
    rig_is(client, "stopped", why=why)
    client.job("insertion", "done")
    assert client.newest["insertion live"]["state"] == "interrupted"
    client.steer()
    assert client.refused("go") == "Bench is not armed: arm it first"


def test_an_insertion_that_runs_keeps_its_scenario(client):
    inserting(client)
    client.do("edit", values={"target.depth_mm": 35.0})
    client.wait(lambda: client.newest.get("scene", {}).get("revision") == 2)
    assert rig_is(client, "inserting")


def test_pauses_periods_paces_and_disturbances_are_refused(client):
    inserting(client)
    why = "is for virtual insertions, and an insertion on the rig has begun: stop ends it"
    assert client.refused("pace", pace=0.0) == f"a pace {why}"
    assert client.refused("pace", pace=1.0) == f"a pace {why}"
    assert client.refused("advance") == f"a single period {why}"
    assert client.refused("disturb", what="push", size=1.0) == f"a disturbance {why}"
    job = client.newest["job insertion"]["job"]
    assert client.refused("cancel", job=job) == "it is an insertion on the rig: stop it instead"
    assert client.refused("insert") == "an insertion runs on the rig: stop it first"
    assert client.refused("prepare") == "an insertion runs: stop it first"
    assert client.refused("check") == "an insertion runs: it uses the devices: stop it first"
    assert client.refused("save", name="mine") == "an insertion runs: it can be saved when it has ended"
    assert rig_is(client, "inserting")


@pytest.mark.parametrize("so_far", [prepared, inserting])
def test_nothing_is_searched_beside_an_insertion(client, so_far):
    so_far(client)
    why = "an insertion is on the rig, and this would take processor time from it: wait for its end"
    for work in ("plan", "compare", "reach"):
        assert client.refused("start", work=work) == why
    assert client.refused("open", name="study", row=1, second=False) == why
    client.do("stop")
    client.wait(lambda: client.newest["rig"]["job"] is None)
    client.do("start", work="reach")


def test_a_search_ends_when_an_insertion_is_prepared(client):
    client.do("options", seed=WORKS_ON)
    for work in ("compare", "reach"):
        client.do("start", work=work)
    client.job("compare", "running")
    prepared(client)
    client.job("compare", "cancelled")
    client.job("reach", "cancelled")


def test_a_scenario_that_was_changed_beside_an_insertion_is_planned_when_that_has_ended(tmp_path):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, rest_s=0.01)) as server, Client(server) as client:
        client.steer().job("plan", "done")
        inserting(client)
        job = client.newest["job plan"]["job"]
        client.do("edit", values={"target.depth_mm": 35.0})
        client.wait(lambda: client.newest["estimate"]["revision"] == 2)
        beats = client.newest["insertion live"]["periods"]
        client.wait(
            lambda: client.newest["insertion live"]["periods"] > beats
        )  # 0.25 s, so that it has rested
        assert client.newest["job plan"]["job"] == job
        client.do("stop")
        client.wait(lambda: client.newest["plan manipulation"]["revision"] == 2)
        assert client.newest["job plan"]["job"] > job


@pytest.mark.parametrize("so_far", [prepared, armed, inserting])
def test_anybody_may_stop(client, watcher, so_far):
    so_far(client)
    watcher.do("stop")
    rig_is(watcher, "stopped", why=f"person {watcher.number} on the page")
    client.job("insertion", "done")
    assert client.refused("go") == "Bench is not armed: arm it first"
    assert client.refused("save", name="mine").startswith("an insertion on a rig is recorded")


def held(server, watcher):
    """The client that steered an insertion is gone."""
    with Client(server) as client:
        inserting(client.steer())
    return rig_is(watcher, "holding", why=WITHOUT_ANYBODY)


def test_it_is_held_when_the_steering_client_is_lost_and_nothing_goes_on_by_itself(server, watcher):
    assert held(server, watcher)["begun"]
    assert watcher.newest["rig"]["moves"] == ["wait 2"]
    watcher.wait(lambda: watcher.newest["people"]["steering"] is None)
    assert watcher.refused("go") == "nobody is in control: take control first"
    watcher.steer()
    assert watcher.refused("go") == "Bench is not armed: arm it first"
    assert rig_is(watcher, "holding")
    watcher.do("arm", armed=True, job=watcher.newest["rig"]["job"])
    assert rig_is(watcher, "armed")["begun"]
    watcher.do("go")
    rig_is(watcher, "inserting")


def test_a_rig_that_is_armed_after_a_hold_is_disarmed_when_steering_ends_again(server, watcher):
    held(server, watcher)
    watcher.steer()
    watcher.do("arm", armed=True, job=watcher.newest["rig"]["job"])
    rig_is(watcher, "armed")
    watcher.do("steer", take=False)
    rig_is(watcher, "holding", why="nobody is in control: it was released")
    watcher.steer()
    assert watcher.refused("go") == "Bench is not armed: arm it first"


def test_one_that_was_changed_during_a_hold_is_disarmed_and_goes_on_with_its_own_scenario(server, watcher):
    held(server, watcher)
    watcher.steer()
    watcher.do("arm", armed=True, job=watcher.newest["rig"]["job"])
    watcher.do("edit", values={"target.depth_mm": 35.0})
    rig_is(watcher, "holding", why="the scenario or an option was changed")


def test_a_prepared_rig_is_released_when_the_steering_client_is_lost(server, watcher):
    with Client(server) as client:
        armed(client.steer())
    rig_is(watcher, "stopped", why=WITHOUT_ANYBODY)


def test_a_fault_is_shown_and_needs_a_new_start(client):
    client.do("options", seed=FAULTY)
    armed(client)
    client.do("go")
    assert rig_is(client, "fault", why="insertion: the motor is off")
    client.wait(lambda: client.newest["rig"]["job"] is None)
    assert rig_is(client, "fault")
    assert client.refused("go") == "Bench is not armed: arm it first"
    client.do("options", seed=0)
    prepared(client)


def test_a_worker_that_ends_leaves_a_fault_and_starts_nothing_again(server, client):
    inserting(client)
    live = ("running", True)
    client.wait(
        lambda: (
            (client.newest["insertion live"]["state"], client.newest["insertion live"]["periods"] > 0) == live
        )
    )
    server.handler._insertions.worker.kill()
    text = "the worker has ended (exit status -9) and is started again"
    rig_is(client, "fault", why=text)
    client.wait(lambda: client.newest["insertion live"]["state"] == "failed")
    line = "the needle stays where it is: withdraw it by flexneedle rig retract bench.toml"
    assert client.newest["insertion live"]["summary"] == f"{text}; {line}"
    assert client.refused("go") == "Bench is not armed: arm it first"
    prepared(client)


def test_a_worker_that_does_not_stop_is_ended(tmp_path):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, stop_s=0.1)) as server, Client(server) as client:
        client.steer().do("options", seed=UNSTOPPABLE)
        inserting(client)
        client.do("stop")
        rig_is(client, "fault")


def test_a_worker_that_writes_the_record_of_a_stopped_rig_is_not_ended(tmp_path):
    """However long it takes: the deadline is that of the motors."""
    with served(tmp_path, rig=RIG, limits=replace(QUICK, stop_s=0.1)) as server, Client(server) as client:
        client.steer().do("options", seed=RECORDS)
        inserting(client)
        client.do("stop")
        rig_is(client, "stopped")
        reason = "the insertion on the rig has ended (stopped): its record is being written"
        assert client.refused("stop") == reason
        client.job("insertion", "done")
        client.wait(lambda: client.newest["rig"]["job"] is None)
        assert rig_is(client, "stopped")


def test_a_virtual_insertion_comes_first(client):
    client.do("insert", paused=True)
    client.job("insertion", "running")
    assert client.refused("prepare") == "an insertion runs: stop it first"
    assert client.refused("check").startswith("an insertion runs")
    client.do("stop")
    client.job("insertion", "done")
    prepared(client)


def test_a_check_is_seen_by_all(client, watcher):
    client.do("check")
    watcher.wait(lambda: "check" in watcher.newest)
    assert watcher.newest["check"]["findings"][0]["found"] == "bench.toml"
    assert watcher.newest["check"]["revision"] == 1
