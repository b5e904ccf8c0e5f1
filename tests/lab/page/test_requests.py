"""Requests over a socket: their effects, and their refusals."""

import json
from dataclasses import replace

import pytest

from flexneedle.lab.page import requests as r
from flexneedle.lab.page.server.connected_rig import RigReference
from flexneedle.scenario.files import dump_scenario, load_scenario
from page_clients import IN_CONTROL, QUICK, STUB, Client, get, restored, served
from page_worker import HANGS, ROWS, WORKS_ON

NONE_RUNS = "no insertion runs: start one first"
DEPTH = "target.depth_mm"


def test_a_new_client_gets_the_choices_and_the_first_plan(server):
    with Client(server) as client:
        welcome = client.newest["welcome"]
        assert welcome["presets"] == ["gel", "phantom", "phantom3d"]
        assert welcome["controllers"][0]["name"] == "adaptive-mpc"
        assert (welcome["strategies"], welcome["rig"]) == (["manipulation", "steering"], None)
        client.has("clients", clients=1, steering=None)
        for key in ("plan manipulation", "scene", "estimate"):
            client.has(key, revision=1)


def test_a_changed_scenario_is_estimated_at_once_and_planned_when_it_rests(tmp_path):
    with served(tmp_path, limits=replace(QUICK, rest_s=0.05)) as server, Client(server) as client:
        client.steer()
        for depth in (35.0, 36.0, 37.0):
            client.do("edit", values={DEPTH: depth})
        client.do("options", seed=3)
        client.has("plan manipulation", cost=3, revision=5)


def test_an_edit_is_planned_only_after_its_end(client):
    first = client.job("plan", "done")["job"]
    for revision in (2, 3):
        client.do("edit", values={DEPTH: 30.0 + revision})
        client.has("estimate", revision=revision)
    assert client.newest["job plan"]["job"] == first
    client.do("rest")
    client.has("plan manipulation", revision=3)
    last = client.newest["job plan"]["job"]
    client.do("rest")  # nothing has changed
    client.do("ping")
    assert client.newest["job plan"]["job"] == last


def test_a_requested_comparison_is_not_replaced_by_the_plan_of_a_rested_scenario(tmp_path):
    with served(tmp_path / "runs", limits=replace(QUICK, rest_s=0.02)) as server, Client(server) as client:
        client.steer().job("plan", "done")
        client.do("options", seed=WORKS_ON)
        client.do("start", work="compare")
        for name in ("one", "two"):  # each is listed after 0.05 s
            (tmp_path / "runs" / name).mkdir(parents=True)
            (tmp_path / "runs" / name / "run.json").write_text("{}")
            client.wait(lambda name=name: name in client.run_names())
        assert client.newest["job compare"]["state"] == "running"


def test_only_the_client_in_control_may_ask_for_what_needs_control(shared_server):
    free = {request for request in r.ClientRequest.__subclasses__() if not request.needs_control}
    assert free == {r.SteerRequest, r.StopRequest, r.PingRequest, r.RestoreRequest}
    assert len(IN_CONTROL) + len(free) == len(r.ClientRequest.__subclasses__())
    with Client(shared_server) as one, Client(shared_server) as other:
        for request, values in IN_CONTROL.items():
            assert one.refused(request, **values).startswith("nobody is in control")
        other.steer()
        one.has("clients", clients=2, steering=other.number)
        for request, values in IN_CONTROL.items():
            assert one.refused(request, **values).startswith(f"person {other.number} is in control")
        for take in (True, False):
            assert one.refused("steer", take=take).startswith(f"person {other.number} is in control")
        other.do("steer", take=False)
        one.steer()
        other.has("clients", steering=one.number)
        for take, over in ((True, other.number), (False, one.number), (True, None)):
            assert other.refused("steer", take=take, over=over).startswith(
                f"person {one.number} is in control"
            )
        other.do("steer", take=True, over=one.number)
        one.has("clients", steering=other.number)
        assert one.refused("insert").startswith(f"person {other.number} is in control")
        other.do("steer", take=False)


def lost_session(folder):
    """Return the welcome and the session of a server that has ended."""
    with served(folder) as server, Client(server) as client:
        client.steer().do("edit", values={DEPTH: 35.0})
        client.do("options", seed=3)
        return client.newest["welcome"], client.has("session", seed=3)


def test_a_restarted_server_gets_the_session_of_the_first_page_back(tmp_path):
    welcome, lost = lost_session(tmp_path)
    with served(tmp_path) as server, Client(server) as one, Client(server) as other:
        assert one.newest["welcome"]["started"] == other.newest["welcome"]["started"] != welcome["started"]
        assert one.newest["welcome"]["initial"] == welcome["initial"]
        assert one.refused("restore", **restored(lost) | {"controller": "x"}).startswith("controller = x")
        one.do("restore", **restored(lost))
        again = other.has("session", revision=2)
        assert (restored(again), again["changed"]) == (restored(lost), [DEPTH])
        other.do("restore", **restored(lost))  # the same
        changed = restored(lost) | {"seed": 4}
        assert other.refused("restore", **changed) == "nobody is in control: take control first"
        one.steer()
        assert other.refused("restore", **changed).startswith(f"person {one.number} is in control")
        one.do("restore", **changed)  # as any change
        other.has("session", revision=3, seed=4)
        one.do("undo")
        other.has("session", revision=4, seed=3)
    with served(tmp_path, rig=RigReference("Bench", "bench.toml")) as server, Client(server) as client:
        assert client.newest["welcome"]["initial"] != welcome["initial"]


def test_a_session_is_not_restored_beside_a_client_in_control_or_an_insertion(tmp_path):
    _welcome, lost = lost_session(tmp_path)
    with served(tmp_path) as server, Client(server) as one, Client(server) as other:
        one.steer()
        assert other.refused("restore", **restored(lost)).startswith(f"person {one.number} is in control")
        one.inserts("paused", paused=True)
        one.do("steer", take=False)
        assert other.refused("restore", **restored(lost)).startswith("an insertion runs")
        one.do("stop")
        one.job("insertion", "done")
        other.do("restore", **restored(lost))


def test_a_chosen_target_is_planned_and_undone_as_any_change(client):
    client.do("targets", what="add", name="Near")
    client.do("edit", values={DEPTH: 30.0})
    client.do("targets", what="choose", name="Target 1")
    client.has("estimate", revision=client.has("session", target="Target 1", revision=4)["revision"])
    client.do("undo")
    client.has("scene", target=[30.0, 5.0, 0.0])
    assert client.has("session", revision=5)["target"] == "Near"
    client.inserts("paused", paused=True)
    assert json.loads(client.newest["insertion live"]["summary"])["target_name"] == "Near"


def test_an_edit_is_sent_to_all_and_computed(server, client):
    with Client(server) as other:
        client.do("edit", values={DEPTH: 35.0})
        for each in (client, other):
            each.has("estimate", revision=2)
            assert each.has("scene", revision=2)["target"][0] == 35.0
            assert each.newest["session"]["values"][DEPTH] == 35.0
            assert each.newest["session"]["changed"] == [DEPTH]
    assert "depth_mm = 35.0" in get(server, "/scenario.toml")[1]


def test_a_refused_edit_has_its_problems_and_changes_nothing(client):
    answer = client.ask("edit", values={DEPTH: 35.0, "tissue.0.alpha": "x"})
    assert answer["problems"] == {"tissue.0.alpha": "must be a number"}
    assert answer["reason"].startswith('tissue[0].alpha = "x"')
    client.do("options", seed=3)
    assert client.has("session", revision=2)["changed"] == []


def test_a_preset_and_a_file_begin_a_new_session_without_the_results_of_the_last(server, client):
    client.job("plan", "done")
    client.do("preset", name="phantom3d")
    client.has("session", name="phantom3d")
    client.has("estimate", revision=2)
    newest = newest_of(server)
    assert newest["scene"]["revision"] == 2
    assert "plan manipulation" not in newest
    client.do("load", name="mine.toml", text=dump_scenario(load_scenario("phantom")))
    assert client.has("session", name="mine.toml")["values"]["name"] == load_scenario("phantom").name
    assert client.ask("load", name="x", text="needle = 1")["problems"]["needle"] == "must be a table"


def newest_of(server):
    """Return the state that a new client gets."""
    with Client(server) as other:
        other.do("ping")
        return other.newest


def test_options_are_kept(client):
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    client.has("session", controller="ce-mpc")
    client.do("start", work="plan")
    client.has("plan steering", cost=3)


def test_work_is_started_and_cancelled(client):
    client.do("start", work="reach")
    job = client.job("reach", "running")["job"]
    client.do("cancel", job=job)
    client.job("reach", "cancelled")
    assert client.refused("cancel", job=job).startswith(f"job = {job}")


REFUSED = [
    ("preset", {"name": "nonsense"}, "preset = nonsense: must be one of gel, phantom, "),
    ("load", {"name": "x", "text": "["}, "x: not TOML: "),
    ("options", {"controller": "nonsense"}, "controller = nonsense: must be one of adaptive-mpc, "),
    ("pace", {"pace": 1.0}, NONE_RUNS),
    ("advance", {}, NONE_RUNS),
    ("stop", {}, NONE_RUNS),
    ("disturb", {"what": "drop", "size": 1.0}, NONE_RUNS),
    ("save", {"name": "mine"}, "there is no insertion to save"),
    *((request, IN_CONTROL[request], "no rig is connected") for request in ("check", "prepare", "arm", "go")),
]


def test_requests_that_need_something_else_first_are_refused(client):
    for request, values, reason in REFUSED:
        assert client.refused(request, **values).startswith(reason)


def received(client):
    """Return what the worker of insertions has received last."""
    return json.loads(client.newest["insertion live"]["summary"])


def test_an_insertion_gets_the_session(client):
    client.do("edit", values={DEPTH: 35.0})
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    client.inserts("paused", paused=True)
    order = received(client)
    assert order["scenario"]["target"]["depth_mm"] == 35.0
    wanted = {"action": "insert", "seed": 3, "strategy": "steering", "controller": "ce-mpc", "paused": True}
    assert (wanted | {"revision": 3, "name": "phantom"}).items() <= order.items()
    assert "rig" not in order
    assert client.newest["disturbances"]["active"] == []


def test_an_insertion_is_paced_and_disturbed(client):
    client.inserts("paused", paused=True)
    client.do("advance")
    client.got_rows(1)
    client.do("disturb", what="push", size=0.5, angle_deg=90.0)
    client.wait(lambda: "disturb" in received(client))
    assert received(client)["disturb"] == {"type": "disturb", "what": "push", "size": 0.5, "angle_deg": 90.0}
    for values, reason in (
        ({"size": 2.0, "layer": 2}, "layer = 2: must be below 2"),
        ({"size": 0.0}, "size = 0: "),
    ):
        assert client.refused("disturb", what="stiffen", **values).startswith(reason)
    client.do("disturb", what="stiffen", size=2.0, layer=1)
    client.do("disturb", what="push", size=0.0)
    client.do("pace", pace=4.0)
    client.wait(lambda: received(client).get("pace") == 4.0)
    assert client.refused("advance").startswith("the insertion is not paused")
    client.do("pace", pace=0.0)
    client.do("advance")
    client.got_rows(2)


def test_anybody_may_stop(server, client):
    client.inserts("running")
    with Client(server) as other:
        other.do("stop")
        other.has("insertion live", state="interrupted")
    client.job("insertion", "done")
    assert client.refused("stop") == NONE_RUNS


NEVER_READY = ("page_script_worker", "channel.receive(None)")
"""A worker that never becomes ready."""


@pytest.mark.parametrize(
    ("rig", "request_"), [(None, "insert"), (RigReference("Bench", "b.toml"), "prepare")]
)
def test_an_insertion_that_waits_for_its_worker_is_shown_and_stopped_by_anybody(tmp_path, rig, request_):
    with served(tmp_path, workers=(STUB, NEVER_READY), rig=rig) as server, Client(server) as client:
        client.steer().do(request_)
        with Client(server) as other:
            shown = other.has("insertion live", state="waiting", rig="Bench" if rig else "")
            assert shown["target"] == [40.0, 5.0, 0.0]
            other.do("stop")
            ended = other.has("insertion live", state="interrupted")
            assert rig or ended["summary"].startswith("stopped: person")
        client.job("insertion", "cancelled")
        assert client.refused("stop") == NONE_RUNS
        assert client.refused("save", name="mine").startswith("there is no insertion to save")


def test_an_insertion_that_hangs_ends_as_stopped_with_its_worker(tmp_path):
    with served(tmp_path, limits=replace(QUICK, stop_s=0.1)) as server, Client(server) as client:
        client.steer().do("options", seed=HANGS)
        client.inserts("paused", paused=True)
        client.do("stop")
        client.job("insertion", "failed")
        assert client.has("insertion live", state="interrupted")["summary"].startswith("stopped: person")


def test_a_newer_virtual_insertion_replaces_the_older_whose_late_reports_are_discarded(server, client):
    """The worker sends a row of the older after it was cancelled, when its rows are forgotten already."""
    client.inserts("running")
    client.got_rows(ROWS)
    first = client.newest["job insertion"]["job"]
    worker = server.handler._insertions.worker._child
    client.inserts("paused", paused=True)
    assert client.job("insertion", "running")["job"] > first
    client.do("advance")
    client.got_rows(1)
    assert "frame 1 4" not in newest_of(server)
    assert server.handler._insertions.worker._child is worker


def test_a_cancelled_insertion_has_the_rows_that_were_shown(client):
    client.inserts("running")
    client.got_rows(ROWS)
    client.do("cancel", job=client.newest["job insertion"]["job"])
    client.has("insertion live", state="interrupted", periods=ROWS)
    assert len(client.rows["live"]) == ROWS
