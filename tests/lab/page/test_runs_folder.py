"""Recorded runs: what is listed, opened, saved and downloaded, and that nothing else is."""

import asyncio
import io
import json
import os
import zipfile
from contextlib import contextmanager
from http.client import HTTPConnection
from itertools import product
from threading import Event

import pytest

import flexneedle
from commands import run
from flexneedle.lab.page.server import app
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.runs_folder import RunsFolder, zip_run
from page_clients import PATIENCE_S, Client, get, port_of, served
from page_worker import GATE, ROWS
from replays import insertion

RUN = {
    "kind": "insertion",
    "status": "done",
    "result": {"true_error_mm": 0.0161},
    "scenario": {"name": "Phantom", "target": {"depth_mm": 40.0, "lateral_mm": 5.0}},
    "timing": {"started": "2026-01-01T12:00:00Z"},
}


def write_run(folder, started="2026-01-01T12:00:00Z", **values):
    folder.mkdir(parents=True)
    text = json.dumps(RUN | {"timing": {"started": started}} | values)
    (folder / "run.json").write_text(text)
    return folder


@pytest.fixture
def runs(tmp_path):
    """A folder of runs, beside which is something that nobody may read."""
    write_run(tmp_path / "runs" / "older", "2026-01-01T12:00:00Z")
    write_run(tmp_path / "runs" / "newer", "2026-01-02T12:00:00Z", result=None, status="failed")
    write_run(tmp_path / "secret")
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "secret")
    (tmp_path / "runs" / "no run").mkdir()
    (tmp_path / "runs" / "file").write_text("")
    return tmp_path / "runs"


def test_runs_are_listed_newest_first(runs):
    assert RunsFolder(runs).listed() == [
        {
            "name": "newer",
            "kind": "insertion",
            "summary": "Phantom, target 40, 5 mm: failed",
            "made": 1767355200.0,
        },
        {
            "name": "older",
            "kind": "insertion",
            "summary": "Phantom, target 40, 5 mm: done, 0.016 mm off",
            "made": 1767268800.0,
        },
    ]


def test_a_run_that_has_changed_is_read_again(runs):
    folder = RunsFolder(runs)
    folder.listed()
    text = json.dumps(RUN | {"status": "held"})
    (runs / "older" / "run.json").write_text(text)
    assert "held" in folder.listed()[1]["summary"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"kind": 3}', "\udcff"])
def test_a_damaged_run_is_listed_as_that(runs, text):
    (runs / "older" / "run.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    (entry,) = (entry for entry in RunsFolder(runs).listed() if entry["name"] == "older")
    assert (entry["kind"], entry["summary"]) == ("damaged", "run.json cannot be read")


def test_without_a_folder_there_are_no_runs(tmp_path):
    assert RunsFolder(tmp_path / "none").listed() == []


@pytest.fixture
def study(runs):
    """A study in the folder of runs."""
    (runs / "many").mkdir()
    text = json.dumps({"study": {"title": "Many", "insertions": 150}})
    (runs / "many" / "study.json").write_text(text)
    os.utime(runs / "many" / "study.json", (0, 1767700000))
    return runs / "many"


@pytest.mark.usefixtures("study")
def test_studies_are_listed_among_the_runs(runs):
    first, *others = RunsFolder(runs).listed()
    summary = "Many: 150 insertions"
    assert first == {"name": "many", "kind": "study", "summary": summary, "made": 1767700000.0}
    assert [entry["name"] for entry in others] == ["newer", "older"]


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"study": {"title": "x"}}', '{"study": {"title": 1, "insertions": []}}']
)
def test_a_damaged_study_is_listed_as_that(runs, study, text):
    (study / "study.json").write_text(text)
    (entry,) = (entry for entry in RunsFolder(runs).listed() if entry["name"] == "many")
    assert (entry["kind"], entry["summary"]) == ("damaged", "study.json cannot be read")


def test_a_run_is_no_study_and_a_study_no_run(runs, study):
    folder = RunsFolder(runs)
    assert folder.study("many") == study
    with pytest.raises(Refusal, match="'many': no run of this name"):
        folder.run("many")
    with pytest.raises(Refusal, match="'older': no study of this name"):
        folder.study("older")


@pytest.mark.parametrize("file", ["run.json", "study.json"])
def test_a_record_that_is_a_link_is_none(runs, file):
    (runs / "no run" / file).symlink_to(runs.parent / "secret" / "run.json")
    assert [entry["name"] for entry in RunsFolder(runs).listed()] == ["newer", "older"]
    for found in (RunsFolder(runs).run, RunsFolder(runs).study):
        with pytest.raises(Refusal, match="of this name"):
            found("no run")


NO_RUNS = [
    *("nonsense", "..", ".", "", "link", "no run", "file", "../secret", "older/../../secret"),
    *("/etc", "older/", "older\0", "OLDER", "~", "older/run.json", "..%2fsecret", "\\..\\secret", "a" * 200),
]


def test_no_other_name_is_a_run_or_a_study_or_one_to_save_under(runs):
    for name in NO_RUNS:
        for found in (RunsFolder(runs).run, RunsFolder(runs).study):
            with pytest.raises(Refusal, match="of this name in the folder of runs"):
                found(name)
    for name in ("..", "../x", "a/b", ".hidden", "", "a\0", "-rf", "a\nb"):
        with pytest.raises(Refusal, match="must be letters"):
            RunsFolder(runs).new(name)
    for name in ("older", "link", "file"):
        with pytest.raises(Refusal, match="already something of this name"):
            RunsFolder(runs).new(name)


def test_an_archive_has_the_files_of_the_run_alone(runs):
    (runs / "older" / "trace.mcap").write_bytes(b"trace")
    (runs / "older" / "elsewhere").symlink_to(runs.parent / "secret" / "run.json")
    with zipfile.ZipFile(io.BytesIO(zip_run(runs / "older"))) as archive:
        assert archive.namelist() == ["older/run.json", "older/trace.mcap"]
        assert archive.read("older/trace.mcap") == b"trace"


# Over sockets: tmp_path / "runs" is the server's folder


def test_a_link_within_a_run_is_not_followed(runs, server):
    (runs.parent / "secret" / "insertion.png").write_text("secret")
    (runs / "older" / "insertion.png").symlink_to(runs.parent / "secret" / "insertion.png")
    reason = "older: insertion.png is a link, which may lead elsewhere\n"
    for file in ("figure.png", "run.zip", "trace.csv", "replay.html"):
        assert get(server, f"/runs/older/{file}")[:2] == (404, reason)


def test_a_run_with_a_link_is_not_opened(runs, client):
    (runs / "older" / "trace.mcap").symlink_to(runs.parent / "secret" / "run.json")
    assert client.refused("open", name="older") == "older: trace.mcap is a link, which may lead elsewhere"


def test_clients_get_the_runs_and_new_ones(runs, client):
    client.wait(
        lambda: [run["name"] for run in client.newest.get("runs", {"runs": []})["runs"]] == ["newer", "older"]
    )
    write_run(runs / "newest", "2026-01-03T12:00:00Z")
    client.wait(lambda: client.listed()[0] == "newest")


def test_a_run_is_opened_and_closed(runs, server, client):
    client.do("open", name="older")
    client.wait(lambda: len(client.rows.get("first", ())) == ROWS and "frame 2 4" in client.newest)
    assert client.newest["insertion first"]["summary"] == str(runs / "older")
    client.do("open", name="newer", second=True)
    client.wait(lambda: len(client.rows.get("second", ())) == ROWS and "frame 3 4" in client.newest)
    client.do("open", name=None)
    assert client.wait(lambda: client.newest.get("closed")) == {"type": "closed", "of": "first"}
    with Client(server) as other:
        other.wait(lambda: "insertion second" in other.newest and len(other.rows.get("second", ())) == ROWS)
        assert "frame 2 4" not in other.newest
        assert "first" not in other.rows


@pytest.mark.usefixtures("study")
def test_what_is_no_run_or_study_is_not_opened(client):
    for name in filter(None, NO_RUNS):
        assert client.refused("open", name=name) == f"{name!r}: no run of this name in the folder of runs"
        reason = f"{name!r}: no study of this name in the folder of runs"
        assert client.refused("study", name=name) == reason
        assert client.refused("open", name=name, row=3) == reason


@pytest.mark.usefixtures("study")
def test_rows_of_a_study_are_listed_for_all(runs, server, client):
    client.do("study", name="many")
    listed = client.wait(lambda: client.newest.get("study"))
    assert (listed["name"], listed["title"], listed["index"]) == ("many", str(runs / "many"), None)
    client.do("study", name="many", index=120)
    with Client(server) as other:
        other.wait(lambda: other.newest.get("study", {}).get("index") == 120)


@pytest.mark.usefixtures("study")
def test_a_row_of_a_study_is_opened(runs, client):
    client.do("open", name="many", row=17, second=True)
    client.wait(lambda: "insertion second" in client.newest)
    assert json.loads(client.newest["insertion second"]["summary"]) == [str(runs / "many"), 17]
    client.job("row", "done")
    assert (
        client.refused("save", name="kept", of="first") == "no row of a study is shown there: open one first"
    )
    client.do("save", name="kept", of="second")
    client.job("save", "done")
    order = json.loads((runs / "kept" / "run.json").read_text())
    assert (order["action"], order["of"]) == ("save_row", "second")
    assert client.refused("save", name="kept", of="second").startswith("kept: there is already something of")
    client.do("open", name="older", second=True)
    client.job("recording", "done")
    assert client.refused("save", name="other", of="second").startswith("no row of a study is shown there")


def test_the_last_insertion_is_saved(runs, client):
    client.do("insert")
    client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "running")
    assert client.refused("save", name="mine") == "an insertion runs: it can be saved when it has ended"
    client.do("stop")
    client.job("insertion", "done")
    client.do("save", name="mine")
    client.job("save", "done")
    assert (runs / "mine" / "run.json").exists()
    client.wait(lambda: "mine" in client.listed())
    assert client.refused("save", name="mine").startswith("mine: there is already something of this name")


def test_files_of_a_run_are_downloaded(runs, server):
    (runs / "older" / "insertion.png").write_bytes(b"\x89PNG")
    status, _text, headers = get(server, "/runs/older/figure.png")
    assert (status, headers["content-type"]) == (200, "image/png")
    status, _text, headers = get(server, "/runs/older/run.zip")
    assert (status, headers["content-disposition"]) == (200, 'attachment; filename="older-run.zip"')
    assert get(server, "/runs/newer/figure.png")[:2] == (
        404,
        "the run has no figure: flexneedle view draws it\n",
    )


@pytest.mark.usefixtures("runs")
def test_a_file_that_is_none_of_the_four_is_refused(server):
    choices = "'run.json': must be one of figure.png, trace.csv, run.zip, replay.html\n"
    assert get(server, "/runs/older/run.json")[:2] == (404, choices)


@pytest.mark.usefixtures("empty_figures")
def test_a_replay_is_what_the_command_writes(runs, server, capsys):
    flexneedle.save(insertion(), runs / "mine")
    status, text, headers = get(server, "/runs/mine/replay.html")
    assert (status, headers["content-disposition"]) == (200, 'attachment; filename="mine-replay.html"')
    assert headers["content-type"].startswith("text/html")
    assert run(capsys, "view", str(runs / "mine"), "--html", "-") == (0, text, "")


@pytest.mark.usefixtures("runs")
@pytest.mark.parametrize("file", ["trace.csv", "replay.html"])
def test_what_a_command_refuses_is_the_reason(server, file):
    """The run here has no plan and no trace: the commands refuse it."""
    status, text, _headers = get(server, f"/runs/older/{file}")
    assert status == 404
    assert "older" in text
    assert "Traceback" not in text


def test_two_downloads_are_made_at_once_and_no_more(runs, server):
    downloads = app.Downloads(server.handler)
    downloads._busy = 2
    with pytest.raises(Refusal, match="two downloads are being made"):
        downloads._make_one_of_two(None, runs).send(None)


def test_a_download_ends_when_its_browser_has_gone(runs, monkeypatch):
    began, ended = Event(), Event()

    async def endless(_folder):
        began.set()
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()

    monkeypatch.setattr(app, "export_csv", endless)
    with served(runs) as server:
        connection = HTTPConnection("127.0.0.1", port_of(server), timeout=PATIENCE_S)
        connection.request("GET", "/runs/older/trace.csv")
        assert began.wait(PATIENCE_S)
        connection.close()
        assert ended.wait(PATIENCE_S)


PATHS = [
    "/runs/../secret/run.zip",
    "/runs/..%2fsecret/run.zip",
    "/runs/%2e%2e/run.zip",
    "/runs/%2e%2e%2fsecret/run.zip",
    "/runs/link/run.zip",
    "/runs/older%2f..%2f..%2fsecret/run.zip",
    "/runs//etc/run.zip",
    "/runs/older/..%2frun.json",
    "/runs/older/%2e%2e/%2e%2e/secret/run.json",
    "/static/../server/app.py",
    "/static/..%2fserver%2fapp.py",
    "/static/%2e%2e/messages.py",
    "/static//etc/passwd",
    "/static/..\\messages.py",
    "/static/",
    "//etc/passwd",
    "/../../etc/passwd",
]


@pytest.mark.usefixtures("runs")
def test_no_path_leads_out_and_nothing_is_written_over_http(server):
    for path in PATHS:
        status, text, _headers = get(server, path)
        assert status == 404, path
        assert len(text) < 200
    for method, path in product(
        ("POST", "PUT", "DELETE", "OPTIONS", "TRACE"), ("/", "/runs/older/run.zip", "/static/index.html")
    ):
        with requested(server, method, path) as response:
            assert response.status == 405, (method, path)


@contextmanager
def requested(server, method, path):
    connection = HTTPConnection("127.0.0.1", port_of(server), timeout=10.0)
    connection.request(method, path)
    yield connection.getresponse()
    connection.close()


def test_a_run_that_is_being_saved_is_neither_cancelled_nor_replaced(runs, client):
    """It takes seconds, and what is lost is nowhere else."""
    client.do("insert", paused=True)
    client.wait(lambda: client.newest.get("insertion live", {}).get("state") == "paused")
    client.do("stop")
    client.job("insertion", "done")
    os.mkfifo(runs / GATE)
    client.do("save", name="mine")
    number = client.job("save", "running")["job"]
    assert client.refused("save", name="yours") == "another run is being saved: wait for its end"
    assert client.refused("cancel", job=number).startswith("a run that is being saved is not cancelled")
    client.do("insert", paused=True)  # which waits for it
    assert client.newest["job save"]["state"] == "running"
    (runs / GATE).write_bytes(b"")
    client.job("save", "done")
    assert (runs / "mine" / "run.json").exists()
    client.wait(lambda: client.newest["insertion live"]["state"] == "paused")
    (runs / GATE).unlink()
