"""Recorded runs: listed, opened, saved and downloaded; nothing else is read or written."""

import io
import json
import os
import zipfile
from http.client import HTTPConnection
from itertools import product

import pytest

import flexneedle
from commands import run
from flexneedle.lab.page.server import runs_folder
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.runs_folder import RunsFolder, zip_run
from page_clients import Client, get, port_of
from page_worker import GATE, ROWS
from replays import insertion

RUN = {
    "kind": "insertion",
    "status": "done",
    "result": {"true_error_mm": 0.0161},
    "scenario": {"name": "Phantom", "target": {"depth_mm": 40.0, "lateral_mm": 5.0}},
}


def write_run(folder, day=1, **values):
    folder.mkdir(parents=True)
    made = RUN | {"timing": {"started": f"2026-01-{day:02}T12:00:00Z"}} | values
    (folder / "run.json").write_text(json.dumps(made))


@pytest.fixture
def runs(tmp_path):
    """A folder with two runs and a study, beside a secret."""
    write_run(tmp_path / "runs" / "older")
    write_run(tmp_path / "runs" / "newer", 2, result=None, status="failed")
    write_run(tmp_path / "secret")
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "secret")
    for name in ("no run", "many"):
        (tmp_path / "runs" / name).mkdir()
    (tmp_path / "runs" / "file").write_text("")
    study = tmp_path / "runs" / "many" / "study.json"
    study.write_text(json.dumps({"study": {"title": "Many", "insertions": 150}}))
    os.utime(study, (0, 1767700000))
    return tmp_path / "runs"


def test_runs_and_studies_are_listed_newest_first(runs):
    folder = RunsFolder(runs)
    many = {"name": "many", "kind": "study", "summary": "Many: 150 insertions", "made": 1767700000.0}
    newer = {"name": "newer", "kind": "insertion", "summary": "Phantom, target 40, 5 mm: failed"}
    older = {"name": "older", "kind": "insertion", "summary": "Phantom, target 40, 5 mm: done, 0.016 mm off"}
    assert folder.list_runs() == [many, newer | {"made": 1767355200.0}, older | {"made": 1767268800.0}]
    (runs / "older" / "run.json").write_text(
        json.dumps(RUN | {"status": "held", "timing": {"started": "2026-01-01"}})
    )
    assert "held" in folder.list_runs()[2]["summary"]
    assert RunsFolder(runs / "none").list_runs() == []


@pytest.mark.parametrize(
    ("name", "file", "texts"),
    [
        ("older", "run.json", [b"", b"[]", b"{}", b'{"kind": 3}', b"\xff"]),
        (
            "many",
            "study.json",
            [b"", b"[]", b"{}", b'{"study": {"title": "x"}}', b'{"study": {"insertions": []}}'],
        ),
    ],
)
def test_a_damaged_record_is_listed_as_damaged(runs, name, file, texts):
    for text in texts:
        (runs / name / file).write_bytes(text)
        (entry,) = (entry for entry in RunsFolder(runs).list_runs() if entry["name"] == name)
        assert (entry["kind"], entry["summary"]) == ("damaged", f"{file} cannot be read")


OTHERS = [
    *("nonsense", "..", ".", "", "link", "no run", "file", "../secret", "older/../../secret"),
    *("/etc", "older/", "older\0", "OLDER", "~", "older/run.json", "..%2fsecret", "\\..\\secret", "a" * 200),
]


def test_no_other_name_is_a_run_or_a_study_or_one_to_save_under(runs):
    folder = RunsFolder(runs)
    for file in ("run.json", "study.json"):
        (runs / "no run" / file).symlink_to(runs.parent / "secret" / "run.json")
    assert [entry["name"] for entry in folder.list_runs()] == ["many", "newer", "older"]
    assert (folder.find_run("older"), folder.find_study("many")) == (runs / "older", runs / "many")
    for find, names in ((folder.find_run, [*OTHERS, "many"]), (folder.find_study, [*OTHERS, "older"])):
        for name in names:
            with pytest.raises(Refusal, match="of this name in the folder of runs"):
                find(name)
    for name in ("..", "../x", "a/b", ".hidden", "", "a\0", "-rf", "a\nb", "older", "link", "file"):
        with pytest.raises(Refusal):
            folder.new(name)
    assert folder.new("mine") == runs / "mine"


def test_an_archive_has_only_the_files_of_the_run(runs):
    (runs / "older" / "trace.mcap").write_bytes(b"trace")
    (runs / "older" / "elsewhere").symlink_to(runs.parent / "secret" / "run.json")
    with zipfile.ZipFile(io.BytesIO(zip_run(runs / "older"))) as archive:
        assert archive.namelist() == ["older/run.json", "older/trace.mcap"]
        assert archive.read("older/trace.mcap") == b"trace"


# Over sockets: tmp_path / "runs" is the server's folder


def test_runs_are_listed_for_clients_also_new_ones(runs, client):
    client.wait(lambda: client.run_names() == ["many", "newer", "older"])
    write_run(runs / "newest", 20)
    client.wait(lambda: client.run_names()[0] == "newest")


def test_a_run_is_opened_and_closed(runs, server, client):
    for name, of, key in (("older", "first", "frame 2 4"), ("newer", "second", "frame 3 4")):
        client.do("open", name=name, second=of == "second")
        client.got_rows(ROWS, of)
        client.has(f"insertion {of}", summary=str(runs / name))
        client.wait(lambda key=key: key in client.newest)
    client.do("open", name=None)
    client.has("closed", of="first")
    with Client(server) as other:
        other.got_rows(ROWS, "second")
        assert not {"frame 2 4", "insertion first"} & set(other.newest)
        assert "first" not in other.rows


def test_rows_of_a_study_are_listed_for_all_opened_and_saved(runs, server, client):
    client.do("study", name="many")
    client.has("study", name="many", title=str(runs / "many"), index=None)
    client.do("study", name="many", index=120)
    with Client(server) as other:
        other.has("study", index=120)
    client.do("open", name="many", row=17, second=True)
    assert json.loads(client.has("insertion second")["summary"]) == [str(runs / "many"), 17]
    client.job("row", "done")
    assert client.refused("save", name="kept", of="first").startswith("no row of a study is shown there")
    client.do("save", name="kept", of="second")
    client.job("save", "done")
    order = json.loads((runs / "kept" / "run.json").read_text())
    assert (order["action"], order["of"]) == ("save_row", "second")
    assert client.refused("save", name="kept", of="second").startswith("kept: there is already something of")
    client.do("open", name="older", second=True)
    client.job("recording", "done")
    assert client.refused("save", name="other", of="second").startswith("no row of a study is shown there")


def test_nothing_else_is_opened_and_no_link_is_followed(runs, server, client):
    for name in filter(None, OTHERS):
        for request, values in (("open", {}), ("study", {}), ("open", {"row": 3})):
            assert client.refused(request, name=name, **values).startswith(repr(name))
    (runs.parent / "secret" / "insertion.png").write_text("secret")
    (runs / "older" / "insertion.png").symlink_to(runs.parent / "secret" / "insertion.png")
    reason = "older: insertion.png is a link, which may lead elsewhere"
    assert client.refused("open", name="older") == reason
    for file in ("figure.png", "run.zip", "trace.csv", "replay.html"):
        assert get(server, f"/runs/older/{file}")[:2] == (404, f"{reason}\n")


def test_the_last_insertion_is_saved_and_neither_cancelled_nor_replaced_meanwhile(runs, client):
    """A save takes seconds, and its data is nowhere else."""
    client.inserts("running")
    assert client.refused("save", name="mine").startswith("an insertion runs")
    client.do("stop")
    client.job("insertion", "done")
    os.mkfifo(runs / GATE)
    client.do("save", name="mine")
    number = client.job("save", "running")["job"]
    assert client.refused("save", name="yours").startswith("another run is being saved")
    assert client.refused("cancel", job=number).startswith("a run that is being saved is not cancelled")
    client.do("insert", paused=True)  # which waits for it
    assert client.newest["job save"]["state"] == "running"
    (runs / GATE).write_bytes(b"")
    client.job("save", "done")
    assert (runs / "mine" / "run.json").exists()
    client.has("insertion live", state="paused")
    (runs / GATE).unlink()
    client.wait(lambda: "mine" in client.run_names())


def test_files_of_a_run_are_downloaded(runs, server, monkeypatch):
    """The runs have no plan and no trace: the commands that export them refuse."""
    (runs / "older" / "insertion.png").write_bytes(b"\x89PNG")
    status, _text, headers = get(server, "/runs/older/figure.png")
    assert (status, headers["content-type"]) == (200, "image/png")
    status, _text, headers = get(server, "/runs/older/run.zip")
    assert (status, headers["content-disposition"]) == (200, 'attachment; filename="older-run.zip"')
    for path, reason in (
        ("newer/figure.png", "no figure"),
        ("older/run.json", "must be one of"),
        ("older/trace.csv", "older"),
    ):
        status, text, _headers = get(server, f"/runs/{path}")
        assert (status, reason in text, "Traceback" in text) == (404, True, False)
    monkeypatch.setattr(runs_folder, "_EXPORT_S", 0.0)
    assert get(server, "/runs/older/replay.html")[:2] == (404, "not ready after 0 s\n")


@pytest.mark.usefixtures("empty_figures")
def test_a_replay_is_the_file_of_the_command(runs, server, capsys):
    flexneedle.save(insertion(), runs / "mine")
    status, text, headers = get(server, "/runs/mine/replay.html")
    assert (status, headers["content-disposition"]) == (200, 'attachment; filename="mine-replay.html"')
    assert headers["content-type"].startswith("text/html")
    assert run(capsys, "view", str(runs / "mine"), "--html", "-") == (0, text, "")


PATHS = [
    *("/runs/../secret/run.zip", "/runs/..%2fsecret/run.zip", "/runs/%2e%2e/run.zip", "/runs/link/run.zip"),
    *("/runs/%2e%2e%2fsecret/run.zip", "/runs/older%2f..%2f..%2fsecret/run.zip", "/runs//etc/run.zip"),
    *("/runs/older/..%2frun.json", "/runs/older/%2e%2e/%2e%2e/secret/run.json", "/static/../server/app.py"),
    *(
        "/static/..%2fserver%2fapp.py",
        "/static/%2e%2e/protocol.py",
        "/static//etc/passwd",
        "/static/..\\protocol.py",
    ),
    *("/static/", "//etc/passwd", "/../../etc/passwd", "/live/../run.json", "/runs/older/....//secret.txt"),
    *("/runs/%252e%252e%252fsecret/run.zip", "/runs/older/%00", "/static/%ff%fe", "/runs/~root/run.zip"),
    *(f"{place}{'.' * 100}" for place in ("/", "/static/", "/runs/older/")),
]


@pytest.mark.usefixtures("runs")
def test_no_path_leads_out_and_nothing_is_written_over_http(server):
    for path in PATHS:
        status, text, _headers = get(server, path)
        assert status == 404, path
        assert len(text) < 200
    methods, paths = (
        ("POST", "PUT", "DELETE", "OPTIONS", "TRACE"),
        ("/", "/runs/older/run.zip", "/static/index.html"),
    )
    for method, path in product(methods, paths):
        connection = HTTPConnection("127.0.0.1", port_of(server), timeout=30.0)
        connection.request(method, path)
        assert connection.getresponse().status == 405, (method, path)
        connection.close()
