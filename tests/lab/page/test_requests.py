"""Each request over a real socket: what it does, and why it is refused."""

import json
from dataclasses import replace

import pytest

from flexneedle.lab.page import requests as r
from flexneedle.lab.page.server.connected_rig import RigReference
from flexneedle.scenario.files import dump_scenario, load_scenario
from page_clients import QUICK, STUB, Client, get, served
from page_worker import HANGS, ROWS, WORKS_ON


def test_a_client_is_welcomed_with_what_can_be_chosen(server):
    with Client(server) as client:
        welcome = client.newest["welcome"]
        assert welcome["presets"] == ["phantom", "phantom3d"]
        assert welcome["controllers"][0]["name"] == "adaptive-mpc"
        assert welcome["strategies"] == ["manipulation", "steering"]
        assert welcome["rig"] is None
        assert client.newest["people"] == {"type": "people", "clients": 1, "steering": None}


def test_the_first_plan_is_made_before_anybody_asks(server):
    with Client(server) as client:
        client.job("plan", "done")
        assert client.newest["plan manipulation"]["revision"] == 1
        assert client.newest["scene"]["revision"] == 1
        assert client.newest["estimate"]["revision"] == 1


def test_a_changed_scenario_is_planned_when_it_rests(tmp_path):
    with served(tmp_path, limits=replace(QUICK, rest_s=0.05)) as server, Client(server) as client:
        client.steer()
        for depth in (35.0, 36.0, 37.0):
            client.do("edit", values={"target.depth_mm": depth})
        client.do("options", seed=3)
        client.wait(lambda: client.newest.get("plan manipulation", {}).get("cost") == 3)
        assert client.newest["plan manipulation"]["revision"] == client.newest["session"]["revision"] == 5


def test_while_it_changes_it_is_estimated_and_not_planned(client):
    client.job("plan", "done")
    first = client.newest["job plan"]["job"]
    for depth in (35.0, 36.0):
        client.do("edit", values={"target.depth_mm": depth})
        revision = client.newest["session"]["revision"]
        client.wait(lambda revision=revision: client.newest["estimate"]["revision"] == revision)
    assert client.newest["job plan"]["job"] == first


def test_what_is_let_go_is_planned_at_once(client):
    client.job("plan", "done")
    client.do("edit", values={"target.depth_mm": 35.0})
    client.do("rest")
    client.wait(
        lambda: client.newest["plan manipulation"]["revision"] == client.newest["session"]["revision"]
    )
    last = client.newest["job plan"]["job"]
    client.do("rest")  # nothing has changed
    client.do("steer", take=True)
    assert client.newest["job plan"]["job"] == last


def test_a_plan_that_was_asked_for_is_not_replaced_by_that_at_rest(tmp_path):
    with served(tmp_path / "runs", limits=replace(QUICK, rest_s=0.02)) as server, Client(server) as client:
        client.steer().job("plan", "done")
        client.do("options", seed=WORKS_ON)
        client.do("start", work="compare")
        for name in ("one", "two"):  # each is listed after 0.05 s
            (tmp_path / "runs" / name).mkdir(parents=True)
            (tmp_path / "runs" / name / "run.json").write_text("{}")
            client.wait(
                lambda name=name: (
                    name in {run["name"] for run in client.newest.get("runs", {"runs": []})["runs"]}
                )
            )
        assert client.newest["job compare"]["state"] == "running"


def test_steering_is_taken_and_released(server):
    with Client(server) as client:
        client.do("steer", take=True)
        client.wait(lambda: client.newest["people"]["steering"] == client.number)
        assert client.newest["people"]["clients"] == 1
        client.do("steer", take=False)
        client.wait(lambda: client.newest["people"]["steering"] is None)
        assert (
            client.refused("edit", values={"target.depth_mm": 35.0})
            == "nobody is in control: take control first"
        )


STEERED = {
    "edit": {"values": {"target.depth_mm": 35.0}},
    "preset": {"name": "phantom3d"},
    "load": {"name": "mine", "text": ""},
    "options": {"seed": 3},
    "start": {"work": "plan"},
    "cancel": {"job": 1},
    "insert": {},
    "check": {},
    "prepare": {},
    "arm": {"armed": True, "job": 1},
    "go": {},
    "rest": {},
    "pace": {"pace": 1.0},
    "advance": {},
    "disturb": {"what": "drop", "size": 1.0},
    "open": {"name": None},
    "study": {"name": "mine"},
    "save": {"name": "mine"},
}


def test_only_the_client_in_control_may_ask_for_it(shared_server):
    with Client(shared_server) as one, Client(shared_server) as other:
        for request, values in STEERED.items():
            assert one.refused(request, **values) == "nobody is in control: take control first"
        other.steer()
        for request, values in STEERED.items():
            assert one.refused(request, **values) == f"person {other.number} is in control: ask for it first"


def test_all_requests_but_four_need_the_steering():
    free = {request for request in r.ClientRequest.__subclasses__() if not request.needs_control}
    assert free == {r.SteerRequest, r.StopRequest, r.PingRequest, r.RowsFromRequest}
    assert len(STEERED) + len(free) == len(r.ClientRequest.__subclasses__())


def test_an_edit_is_seen_by_all_and_computed(server, client):
    with Client(server) as other:
        client.do("edit", values={"target.depth_mm": 35.0})
        for each in (client, other):
            each.wait(lambda each=each: each.newest.get("scene", {}).get("revision") == 2)
            each.wait(lambda each=each: each.newest.get("estimate", {}).get("revision") == 2)
            assert each.newest["scene"]["target"][0] == 35.0
            assert each.newest["session"]["values"]["target.depth_mm"] == 35.0
            assert each.newest["session"]["changed"] == ["target.depth_mm"]
        assert "depth_mm = 35.0" in get(server, "/scenario.toml")[1]


def test_a_wrong_edit_is_refused_with_its_problems_and_changes_nothing(client):
    answer = client.ask("edit", values={"target.depth_mm": 35.0, "tissue.0.alpha": "x"})
    assert answer["problems"] == {"tissue.0.alpha": "must be a number"}
    assert answer["reason"] == 'tissue[0].alpha = "x": must be a number'
    client.do("options", seed=3)
    client.wait(lambda: client.newest["session"]["revision"] == 2)
    assert client.newest["session"]["changed"] == []


def test_a_preset_and_a_file_begin_anew(client):
    client.do("preset", name="phantom3d")
    client.wait(lambda: client.newest["session"]["name"] == "phantom3d")
    client.do("load", name="mine.toml", text=dump_scenario(load_scenario("phantom")))
    client.wait(lambda: client.newest["session"]["name"] == "mine.toml")
    assert client.newest["session"]["values"]["name"] == load_scenario("phantom").name


def test_another_scenario_forgets_what_was_computed(server, client):
    client.job("plan", "done")
    client.do("preset", name="phantom3d")
    client.wait(lambda: client.newest["estimate"]["revision"] == 2)
    with Client(server) as other:
        other.job("estimate", "done")
        assert "plan manipulation" not in other.newest
        assert other.newest["scene"]["revision"] == 2


def test_what_is_no_preset_or_file_is_refused(client):
    assert client.refused("preset", name="nonsense").startswith("preset = nonsense: must be one of phantom, ")
    assert client.refused("load", name="x", text="[").startswith("x: not TOML: ")
    assert client.ask("load", name="x", text="needle = 1")["problems"]["needle"] == "must be a table"


def test_options_are_kept_and_checked(client):
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    client.wait(lambda: client.newest["session"]["controller"] == "ce-mpc")
    client.do("start", work="plan")
    client.wait(lambda: client.newest.get("plan steering", {}).get("cost") == 3)
    reason = client.refused("options", controller="nonsense")
    assert reason.startswith("controller = nonsense: must be one of adaptive-mpc, ")


def test_work_is_started_and_cancelled(client):
    client.do("start", work="reach")
    job = client.job("reach", "running")["job"]
    client.do("cancel", job=job)
    client.job("reach", "cancelled")
    assert client.refused("cancel", job=job) == f"job = {job}: does not run or wait"


def summary(client):
    """What the worker of insertions has got last."""
    return json.loads(client.newest["insertion live"]["summary"])


def running(client, **options):
    client.do("insert", **options)
    state = "paused" if options.get("paused") else "running"
    client.wait(lambda: client.newest.get("insertion live", {}).get("state") == state)


def test_an_insertion_gets_the_session(client):
    client.do("edit", values={"target.depth_mm": 35.0})
    client.do("options", seed=3, strategy="steering", controller="ce-mpc")
    running(client, paused=True)
    order = summary(client)
    assert order["scenario"]["target"]["depth_mm"] == 35.0
    assert [
        order[key] for key in ("action", "seed", "strategy", "controller", "paused", "revision", "name")
    ] == [
        *("insert", 3, "steering", "ce-mpc", True),
        *(3, "phantom"),
    ]
    assert "rig" not in order


def test_an_insertion_is_paced_and_disturbed(client):
    running(client, paused=True)
    client.do("advance")
    client.wait(lambda: len(client.rows.get("live", ())) == 1)
    client.do("disturb", what="push", size=0.5, angle_deg=90.0)
    client.wait(lambda: "disturb" in summary(client))
    assert summary(client)["disturb"] == {"type": "disturb", "what": "push", "size": 0.5, "angle_deg": 90.0}
    client.do("pace", pace=4.0)
    client.wait(lambda: summary(client).get("pace") == 4.0)
    assert client.refused("advance") == "the insertion is not paused: pause it first"
    client.do("pace", pace=0.0)
    client.do("advance")
    client.wait(lambda: len(client.rows["live"]) == 2)


def test_without_an_insertion_nothing_can_be_done_to_it(client):
    reason = "no insertion runs: start one first"
    assert client.refused("pace", pace=1.0) == reason
    assert client.refused("advance") == reason
    assert client.refused("stop") == reason
    assert client.refused("disturb", what="drop", size=1.0) == reason
    assert client.refused("save", name="mine") == "there is no insertion to save: start one first"


def test_a_layer_that_is_not_there_is_not_stiffened(client):
    running(client, paused=True)
    reason = client.refused("disturb", what="stiffen", size=2.0, layer=2)
    assert reason == "layer = 2: must be below 2, the number of layers"
    client.do("disturb", what="stiffen", size=2.0, layer=1)


def test_anybody_may_stop(server, client):
    running(client)
    with Client(server) as other:
        other.do("stop")
        other.wait(lambda: other.newest.get("insertion live", {}).get("state") == "interrupted")
    client.job("insertion", "done")
    assert client.refused("stop") == "no insertion runs: start one first"


NEVER_READY = ("page_script_worker", "channel.receive(None)")
"""A worker that imports and compiles for ever."""


@pytest.mark.parametrize(
    ("rig", "request_"), [(None, "insert"), (RigReference("Bench", "b.toml"), "prepare")]
)
def test_an_insertion_that_waits_for_its_worker_is_shown_and_stopped_by_anybody(tmp_path, rig, request_):
    with served(tmp_path, workers=(STUB, NEVER_READY), rig=rig) as server, Client(server) as client:
        client.steer().do(request_)
        with Client(server) as other:
            shown = other.wait(lambda: other.newest.get("insertion live"))
            assert (shown["state"], shown["rig"]) == ("waiting", "Bench" if rig else "")
            assert shown["target"] == [40.0, 5.0, 0.0]
            other.do("stop")
            other.wait(lambda: other.newest["insertion live"]["state"] == "interrupted")
            if not rig:
                assert other.newest["insertion live"]["summary"].startswith("stopped: person")
        client.job("insertion", "cancelled")
        assert client.refused("stop") == "no insertion runs: start one first"
        assert client.refused("save", name="mine") == "there is no insertion to save: start one first"


def test_an_insertion_that_hangs_ends_as_stopped_with_its_worker(tmp_path):
    with served(tmp_path, limits=replace(QUICK, stop_s=0.1)) as server, Client(server) as client:
        client.steer().do("options", seed=HANGS)
        client.do("insert", paused=True)
        client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "paused")
        client.do("stop")
        client.job("insertion", "failed")
        ended = client.wait(
            lambda: client.newest["insertion live"]["state"] != "running" and client.newest["insertion live"]
        )
        assert ended["state"] == "interrupted"
        assert ended["summary"].startswith("stopped: person")


def test_a_newer_virtual_insertion_replaces_the_older(client):
    running(client, paused=True)
    first = client.newest["job insertion"]["job"]
    client.do("insert", paused=True)
    client.wait(lambda: client.newest["job insertion"]["job"] > first)
    client.job("insertion", "running")
    client.wait(lambda: client.newest["insertion live"]["state"] == "paused")
    assert client.newest["job insertion"]["job"] > first


def test_what_comes_late_of_an_insertion_that_was_replaced_is_not_handed_on(server, client):
    """The worker sends a row of it after it was cancelled, when its rows are forgotten already."""
    running(client)
    client.wait(lambda: len(client.rows.get("live", ())) == ROWS)
    worker = server.handler._insertions.worker._child.pid
    client.do("insert", paused=True)
    client.wait(lambda: client.newest["insertion live"]["state"] == "paused")
    client.do("advance")
    client.wait(lambda: len(client.rows["live"]) == 1)
    assert "frame 1 4" not in joined(server).newest
    assert server.handler._insertions.worker._child.pid == worker


def joined(server):
    """A page that has come now, with the state of all keys."""
    with Client(server) as other:
        other.do("rows_from", index=0)
        return other


def test_an_insertion_that_is_cancelled_has_the_rows_that_were_shown(client):
    running(client)
    client.wait(lambda: len(client.rows.get("live", ())) == ROWS)
    client.do("cancel", job=client.newest["job insertion"]["job"])
    client.wait(lambda: client.newest["insertion live"]["state"] == "interrupted")
    assert client.newest["insertion live"]["periods"] == len(client.rows["live"]) == ROWS


def test_a_virtual_layer_is_not_without_stiffness(client):
    running(client, paused=True)
    reason = "size = 0: must be above 0 for a layer, the factor on its stiffness"
    assert client.refused("disturb", what="stiffen", size=0.0) == reason
    client.do("disturb", what="push", size=0.0)


def test_rows_are_filled_up_on_request(client):
    running(client)
    client.wait(lambda: len(client.rows.get("live", ())) == ROWS)
    client.rows["live"][100:] = []
    client.do("rows_from", index=100)
    client.wait(lambda: len(client.rows["live"]) == ROWS)
    assert [row["index"] for row in client.rows["live"]] == list(range(ROWS))


def test_without_a_rig_nothing_is_done_to_it(client):
    reason = "no rig is connected: start flexneedle serve with --rig FILE"
    for request, values in {"check": {}, "prepare": {}, "arm": {"armed": True, "job": 1}, "go": {}}.items():
        assert client.refused(request, **values) == reason


def test_an_insertion_begins_without_disturbances_of_the_last(client):
    client.do("insert", paused=True)
    client.wait(lambda: "disturbances" in client.newest)
    assert client.newest["disturbances"]["active"] == []
