"""A virtual insertion in real time while its server, started by `flexneedle serve`, is attacked over real sockets.

Everything is refused with a reason, and the insertion has the same rows as without the attack.
"""

import json
import os
import re
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

import page_clients
from page_clients import Client, port_of

SECRET = "nobody may read this"
OF_OTHER_FILES = {"python", "flexneedle", "root:", "def ", SECRET}
"""Texts of files that are not the page's."""


@dataclass(frozen=True)
class Served:
    """A server of `flexneedle serve`. cookie: contains its token."""

    address: str
    runs: Path

    @property
    def cookie(self) -> str:
        return f"flexneedle-{port_of(self)}={self.address.partition('token=')[2]}"

    @property
    def host(self) -> str:
        return f"127.0.0.1:{port_of(self)}"


@pytest.fixture
def server(tmp_path):
    """A server on all addresses, so that it has a token; beside its folder of runs is a secret; no traceback."""
    (tmp_path / "secret.txt").write_text(SECRET)
    (tmp_path / "runs").mkdir()
    command = [sys.executable, "-m", "flexneedle", "serve", "phantom", "--no-open", "--port", "0"]
    command += ["--host", "0.0.0.0", "--runs", str(tmp_path / "runs")]
    with (
        (tmp_path / "errors").open("w") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        try:
            yield Served(process.stdout.readline().strip(), tmp_path / "runs")
        finally:
            process.terminate()
    assert (tmp_path / "errors").read_text() == "flexneedle: Ctrl-C ends the server\n"


class Member(Client):
    """A client with the token."""

    def __init__(self, server):
        super().__init__(server, additional_headers={"Cookie": server.cookie})


def inserted(client, pace):
    """Insert at a pace; return the rows without the time of the decision, and the last state."""
    client.rows = {}
    client.do("insert", paused=True)
    client.has("insertion live", state="paused")
    client.do("pace", pace=pace)
    client.job("insertion", "done")
    rows = [{key: value for key, value in row.items() if key != "decide_ms"} for row in client.rows["live"]]
    return rows, client.newest["insertion live"]["state"]


@pytest.mark.slow
def test_attacks_are_refused_and_change_no_row_of_the_insertion(server, monkeypatch):
    monkeypatch.setattr(
        page_clients, "PATIENCE_S", 200.0
    )  # a server and its workers start slowly beside others
    with Member(server) as client, ThreadPoolExecutor(1) as pool:
        client.steer().do("edit", values={"target.depth_mm": 30.0, "target.lateral_mm": 2.0})
        client.has("plan manipulation", revision=client.newest["session"]["revision"])
        alone = inserted(client, 50.0)
        watching, rounds = pool.submit(inserted, client, 1.0), 0
        while not watching.done() or rounds == 0:
            for attack in ATTACKS:
                attack(server)
            rounds += 1
        attacked = watching.result()
    assert attacked == alone
    assert alone[1] == "done"
    assert len(alone[0]) > 50


def exchange(server, request: bytes) -> tuple[int, str]:
    """Return status and body of the answer to the bytes of a request, after which the connection ends."""
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=page_clients.PATIENCE_S) as line:
        try:
            line.sendall(request)
            answer = b"".join(iter(lambda: line.recv(65_536), b""))
        except (BrokenPipeError, ConnectionResetError):
            return 0, "connection reset"
    status = re.match(rb"HTTP/1.1 (\d+)", answer)
    head, _, body = answer.partition(b"\r\n\r\n")
    assert status, head[:200]
    return int(status[1]), body.decode(errors="replace")


def ask(server, path="/", method="GET", more=b"", **headers) -> tuple[int, str]:
    """Return status and body of a request with the token; headers replace Host and Cookie, None: without it."""
    headers = {"Host": server.host, "Cookie": server.cookie, "Connection": "close"} | headers
    lines = [f"{name.replace('_', '-')}: {value}" for name, value in headers.items() if value is not None]
    return exchange(server, "\r\n".join((f"{method} {path} HTTP/1.1", *lines, "", "")).encode() + more)


def connect(server, **headers) -> tuple[int, str]:
    """Return status and body of the answer to a request for the web socket."""
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13"}
    key = {"Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    return ask(server, "/live", **{"Origin": f"http://{server.host}"} | upgrade | key | headers)


def strangers(server):
    """Requests with a wrong host or origin, or without the token."""
    for send in (ask, connect):
        for name, value in {"Host": "evil.example", "Origin": "http://evil.example"}.items():
            status, reason = send(server, **{name: value})
            assert (status, reason.startswith(f"{name} = ")) == (403, True), (status, reason)
        for cookie in (None, "", f"flexneedle-{port_of(server)}=guessed", f"other={server.cookie}"):
            assert send(server, Cookie=cookie)[0] == 401
    assert ask(server, "/?token=guessed", Cookie=None)[0] == 401
    assert connect(server, Origin=None)[0] == 403


WAYS = (
    *("../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "..%5csecret.txt", "....//secret.txt"),
    *("%252e%252e%252fsecret.txt", "%2e%2e/server/access.py", "/etc/passwd", "../../../../../../etc/passwd"),
    *("run.json", "%00", "secret.txt%00", "%ff%fe", "~root/", "." * 300, "x" * 5_000),
)


def paths(server):
    """Paths that leave the folders, in all routes."""
    for place in ("/", "/static/", "/runs/", "/runs/mine/", "/live/", "/schema.json/", "/scenario.toml/"):
        for way in WAYS:
            status, body = ask(server, place + way)
            assert 400 <= status < 500, (place, way, status)
            assert body.strip(), (place, way)
            assert not any(word in body for word in OF_OTHER_FILES), (place, way, body)


def invalid(server):
    """Parts of a request on a web socket, other protocols, and headers, addresses and bodies that are too long."""
    whole = json.dumps({"type": "edit", "values": {"target.depth_mm": 25.0}})
    with Member(server) as client:
        for text in (*(whole[:end] for end in range(len(whole) + 1)), b"\x01\x02", "x" * 390_000):
            client.newest.pop("refused", None)
            client.socket.send(text)
            assert client.has("refused")["reason"]
    hello = b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n"  # of TLS
    for nonsense in (hello, b"GET\r\n\r\n", b"\0" * 100_000, os.urandom(2_000) + b"\r\n\r\n"):
        assert exchange(server, nonsense)[0] in (0, 400)
    assert ask(server, method="TRACE")[0] == ask(server, "/static/main.js", method="DELETE")[0] == 405
    assert ask(server, "/" + "x" * 200_000)[0] in (0, 400)
    assert ask(server, X="x" * 200_000)[0] in (0, 400)
    assert ask(server, method="POST", more=b"x" * 5_000_000, Content_Length=5_000_000)[0] in (0, 405)


NEED_CONTROL = {
    "edit": {"values": {"target.depth_mm": 25.0}}, "preset": {"name": "phantom3d"}, "load": {"name": "x", "text": ""},
    "options": {"seed": 7}, "start": {"work": "plan"}, "rest": {}, "insert": {}, "pace": {"pace": 0.0}, "advance": {},
    "disturb": {"what": "push", "size": 1.0}, "cancel": {"job": 1}, "save": {"name": "x"}, "open": {"name": None},
    "steer": {"take": True},
}  # fmt: skip
"""Requests that would change the insertion or the page, by type."""


def without_control(server):
    """Requests of a client with the token, while another client is in control."""
    with Member(server) as client:
        reason = f"person {client.newest['clients']['steering']} is in control"
        for type_, values in NEED_CONTROL.items():
            assert client.refused(type_, **values).startswith(reason)


ATTACKS = (strangers, paths, without_control, invalid)
