"""The connected rig on the server: prepared, armed, started, held and stopped; with a worker that has no rig."""

import json
from dataclasses import replace

import pytest

from flexneedle.lab.page.server.connected_rig import RigReference
from page_clients import QUICK, Client, get, served
from page_worker import FAULTY, RECORDS, UNSTOPPABLE, WORKS_ON

RIG = RigReference("Bench", "bench.toml")
LOST, RELEASED = "nobody is in control: the connection was lost", "nobody is in control: it was released"
CHANGED = "the scenario or an option was changed"
DEEPER = {"values": {"target.depth_mm": 35.0}}


@pytest.fixture
def server(tmp_path):
    with served(tmp_path / "runs", rig=RIG) as server:
        yield server


@pytest.fixture
def watcher(server):
    """A client without control."""
    with Client(server) as client:
        yield client


def prepared(client):
    client.do("prepare")
    client.has("rig", state="ready")


def arm(client):
    client.do("arm", armed=True, job=client.newest["rig"]["job"])
    return client.has("rig", state="armed")


def armed(client):
    prepared(client)
    arm(client)


def inserting(client):
    armed(client)
    client.do("go")
    client.has("rig", state="inserting")


def refuses_to_go(client):
    assert client.refused("go").startswith("Bench is not armed")


def ends(client):
    """Stop the insertion and wait for its end."""
    client.do("stop")
    client.has("rig", job=None)


def test_it_is_prepared_armed_for_one_start_and_started(client, tmp_path):
    assert client.newest["welcome"]["rig"] == "Bench"
    client.has("rig", state="idle", job=None)
    assert client.refused("arm", armed=True, job=1).startswith("Bench is not prepared")
    refuses_to_go(client)
    client.do("edit", **DEEPER)
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    prepared(client)
    order = json.loads(client.newest["insertion live"]["summary"])
    assert order["scenario"]["target"]["depth_mm"] == 35.0
    wanted = {"rig": "bench.toml", "folder": str(tmp_path / "runs"), "seed": 3, "strategy": "steering"}
    assert wanted.items() <= order.items()
    assert client.newest["rig"]["moves"] == ["wait 1"]
    refuses_to_go(client)
    job = client.newest["rig"]["job"]
    assert client.refused("arm", armed=True, job=job + 1).startswith(f"job = {job + 1}: must be {job}")
    assert not arm(client)["begun"]
    client.do("go")
    client.has("rig", state="inserting", begun=True, moves=[])
    refuses_to_go(client)
    assert client.refused("arm", armed=True, job=job).startswith("Bench is not ready")
    ends(client)
    refuses_to_go(client)
    prepared(client)
    refuses_to_go(client)


def test_it_is_disarmed_when_it_is_not_started(tmp_path):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, armed_s=0.1)) as server, Client(server) as client:
        armed(client.steer())
        assert client.has("rig", state="ready")["why"].startswith("not started within 0.1 s")
        refuses_to_go(client)


@pytest.mark.parametrize("until", [prepared, armed])
def test_a_prepared_insertion_ends_when_the_scenario_changes_or_control_is_released(client, until):
    for request, values, why in (
        ("edit", DEEPER, CHANGED),
        ("preset", {"name": "phantom3d"}, CHANGED),
        ("options", {"seed": 3}, CHANGED),
        ("steer", {"take": False}, RELEASED),
    ):
        until(client)
        client.do(request, **values)
        client.has("rig", state="stopped", why=why)
        client.job("insertion", "done")
        client.has("insertion live", state="interrupted")
        client.steer()
        refuses_to_go(client)


REFUSED = [
    ("pace", {"pace": 0.0}, "a pace is for virtual"),
    ("advance", {}, "a single period is for virtual"),
    ("disturb", {"what": "push", "size": 1.0}, "a disturbance is for virtual"),
    ("insert", {}, "an insertion runs on the rig"),
    ("prepare", {}, "an insertion runs"),
    ("check", {}, "an insertion runs"),
    ("save", {"name": "mine"}, "an insertion runs"),
    *(("start", {"work": work}, "an insertion is on the rig") for work in ("plan", "compare", "reach")),
    ("open", {"name": "study", "row": 1}, "an insertion is on the rig"),
]


@pytest.mark.parametrize("until", [prepared, inserting])
def test_long_computations_and_changes_of_virtual_insertions_are_refused(server, client, tmp_path, until):
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "run.json").write_text("{}")
    until(client)
    state, job = client.newest["rig"]["state"], client.newest["job insertion"]["job"]
    for request, values, reason in (*REFUSED, ("cancel", {"job": job}, "it is an insertion on the rig")):
        assert client.refused(request, **values).startswith(reason)
    for file in ("trace.csv", "replay.html"):
        status, text, _headers = get(server, f"/runs/mine/{file}")
        assert (status, text.startswith("an insertion is on the rig")) == (404, True)
    assert get(server, "/runs/mine/run.zip")[0] == 200
    assert client.newest["rig"]["state"] == state
    ends(client)
    client.do("start", work="reach")


def test_searches_end_when_an_insertion_is_prepared(client):
    client.do("options", seed=WORKS_ON)
    for work in ("compare", "reach"):
        client.do("start", work=work)
    client.job("compare", "running")
    prepared(client)
    client.job("compare", "cancelled")
    client.job("reach", "cancelled")


def test_a_running_insertion_keeps_its_scenario_and_the_changed_one_is_planned_after_it(tmp_path):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, rest_s=0.01)) as server, Client(server) as client:
        client.steer().job("plan", "done")
        inserting(client)
        job = client.newest["job plan"]["job"]
        client.do("edit", **DEEPER)
        client.has("estimate", revision=2)
        beats = client.newest["insertion live"]["periods"]
        client.wait(
            lambda: client.newest["insertion live"]["periods"] > beats
        )  # 0.25 s: the scenario has rested
        assert client.newest["job plan"]["job"] == job
        client.has("rig", state="inserting")
        client.do("stop")
        client.has("plan manipulation", revision=2)
        assert client.newest["job plan"]["job"] > job


@pytest.mark.parametrize("until", [prepared, armed, inserting])
def test_anybody_may_stop(client, watcher, until):
    until(client)
    watcher.do("stop")
    watcher.has("rig", state="stopped", why=f"person {watcher.number} on the page")
    client.job("insertion", "done")
    refuses_to_go(client)
    assert client.refused("save", name="mine").startswith("an insertion on a rig is recorded")


def test_it_is_held_when_control_is_lost_and_never_continues_by_itself(server, watcher):
    with Client(server) as client:
        inserting(client.steer())
    held = watcher.has("rig", state="holding", why=LOST)
    assert (held["begun"], held["moves"]) == (True, ["wait 2"])
    watcher.has("clients", steering=None)
    assert watcher.refused("go").startswith("nobody is in control")
    watcher.steer()
    refuses_to_go(watcher)
    arm(watcher)
    watcher.do("edit", **DEEPER)  # it continues with its own scenario
    watcher.has("rig", state="holding", why=CHANGED)
    arm(watcher)
    watcher.do("steer", take=False)
    watcher.has("rig", state="holding", why=RELEASED)
    watcher.steer()
    refuses_to_go(watcher)
    assert arm(watcher)["begun"]
    watcher.do("go")
    watcher.has("rig", state="inserting")


@pytest.mark.parametrize(
    ("until", "ends_as"), [(prepared, "stopped"), (armed, "stopped"), (inserting, "holding")]
)
def test_who_takes_over_control_confirms_the_motions_again(client, watcher, until, ends_as):
    until(client)
    watcher.do("steer", take=True, over=client.number)
    watcher.has("rig", state=ends_as, why=f"person {watcher.number} has taken over control")
    for each, reason in ((watcher, "Bench is not armed"), (client, f"person {watcher.number} is in control")):
        assert each.refused("go").startswith(reason)
    if ends_as == "holding":
        arm(watcher)
        client.do("steer", take=True, over=watcher.number)  # the confirmation is void
        client.has("rig", state="holding", why=f"person {client.number} has taken over control")
        refuses_to_go(client)
        watcher.do("stop")
        client.has("rig", state="stopped", job=None)


def test_a_fault_is_shown_until_the_next_preparation(client):
    client.do("options", seed=FAULTY)
    armed(client)
    client.do("go")
    client.has("rig", state="fault", why="insertion: the motor is off", job=None)
    refuses_to_go(client)
    client.do("options", seed=0)
    prepared(client)


def test_a_worker_that_ends_leaves_a_fault_and_starts_nothing_again(server, client):
    inserting(client)
    client.has("insertion live", state="running")
    client.wait(lambda: client.newest["insertion live"]["periods"] > 0)
    server.handler._insertions.worker.kill()
    client.has("rig", state="fault")
    summary = client.has("insertion live", state="failed")["summary"]
    assert summary.startswith("the worker has ended (exit status -9)")
    assert summary.endswith("withdraw it with the button Retract")
    refuses_to_go(client)
    prepared(client)


@pytest.mark.parametrize(("seed", "state"), [(UNSTOPPABLE, "fault"), (RECORDS, "stopped")])
def test_a_worker_that_does_not_stop_is_killed_but_not_while_it_writes_the_record(tmp_path, seed, state):
    with served(tmp_path, rig=RIG, limits=replace(QUICK, stop_s=1.0)) as server, Client(server) as client:
        client.steer().do("options", seed=seed)
        inserting(client)
        client.do("stop")
        client.has("rig", state=state)
        if seed == RECORDS:
            assert client.refused("stop").endswith("its record is being written")
            client.job("insertion", "done")
        client.has("rig", state=state, job=None)


def test_a_virtual_insertion_comes_first(client):
    client.inserts("paused", paused=True)
    for request in ("prepare", "check"):
        assert client.refused(request).startswith("an insertion runs")
    client.do("stop")
    client.job("insertion", "done")
    prepared(client)


def test_a_check_is_sent_to_all(client, watcher):
    client.do("check")
    assert watcher.has("check", revision=1)["findings"][0]["found"] == "bench.toml"


# Retractions


def retracting(client):
    """Retract until it is stopped."""
    client.do("options", seed=WORKS_ON)
    client.do("retract")
    client.has("rig", state="ready", motion="retraction")
    arm(client)
    client.do("go")
    client.has("rig", state="retracting", begun=True, moves=[])


def test_a_needle_is_withdrawn_once_it_is_armed_and_started(client):
    inserting(client)
    assert client.refused("retract").startswith("an insertion runs")
    ends(client)
    client.do("retract")
    ready = client.has("rig", state="ready", motion="retraction")
    assert (ready["begun"], ready["moves"]) == (False, ["wait 1"])
    refuses_to_go(client)
    arm(client)
    client.do("go")
    client.has("rig", state="idle", why="the needle was withdrawn", job=None, motion="retraction")
    client.job("retraction", "done")
    client.has("insertion live", state="interrupted")
    refuses_to_go(client)
    prepared(client)
    client.has("rig", motion="insertion")


@pytest.mark.parametrize("request_", ["insert", "prepare", "check", "retract", "undo"])
def test_nothing_else_is_started_beside_a_retraction(client, request_):
    retracting(client)
    assert client.refused(request_).startswith("a retraction runs")
    assert client.refused("start", work="plan").startswith("a retraction is on the rig")
    job = client.newest["rig"]["job"]
    assert client.refused("cancel", job=job).startswith("it is a retraction on the rig")
    client.do("edit", **DEEPER)  # it continues
    client.has("scene", revision=3)
    assert client.newest["rig"]["state"] == "retracting"
    ends(client)
    client.has("rig", state="stopped")


def test_a_retraction_ends_by_any_stop_and_by_a_loss_of_control(server, client, watcher):
    retracting(client)
    watcher.do("stop")
    client.has("rig", state="stopped", why=f"person {watcher.number} on the page", job=None)
    retracting(client)
    client.do("steer", take=False)
    client.has("rig", state="stopped", why=RELEASED, job=None)
    retracting(client.steer())
    watcher.do("steer", take=True, over=client.number)
    watcher.has("rig", state="stopped", why=f"person {watcher.number} has taken over control", job=None)
    watcher.do("steer", take=False)
    with Client(server) as other:
        retracting(other.steer())
    watcher.has("rig", state="stopped", why=LOST, job=None)
    retracting(client.steer())
    client.wait(lambda: client.newest["rig"]["state"] == "retracting")
    server.handler._insertions.worker.kill()
    client.has("rig", state="fault", job=None)


def test_without_a_rig_there_is_nothing_to_retract(tmp_path):
    with served(tmp_path) as server, Client(server) as client:
        assert client.steer().refused("retract").startswith("no rig is connected")
