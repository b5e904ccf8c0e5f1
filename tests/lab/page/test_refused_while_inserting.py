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
from types import SimpleNamespace

import pytest

from page_clients import IN_CONTROL, PATIENCE_S, Client, port_of


@pytest.fixture
def server(tmp_path):
    """A server that prints no traceback."""
    command = [sys.executable, "-m", "flexneedle", "serve", "phantom", "--no-open", "--port", "0"]
    with (
        (tmp_path / "errors").open("w") as errors,
        subprocess.Popen(
            [*command, "--runs", str(tmp_path / "runs")], stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        try:
            yield SimpleNamespace(address=process.stdout.readline().strip())
        finally:
            process.terminate()
    assert (tmp_path / "errors").read_text() == "flexneedle: Ctrl-C ends the server\n"


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
def test_attacks_are_refused_and_change_no_row_of_the_insertion(server):
    with Client(server) as client, ThreadPoolExecutor(1) as pool:
        client.steer().do("edit", values={"target.depth_mm": 30.0, "target.lateral_mm": 2.0})
        client.has("plan manipulation", revision=client.newest["session"]["revision"])
        alone = inserted(client, 50.0)
        watching, rounds = pool.submit(inserted, client, 1.0), 0
        while not watching.done() or rounds == 0:
            for attack in (without_control, incomplete, invalid):
                attack(server)
            rounds += 1
        attacked = watching.result()
    assert attacked == alone
    assert alone[1] == "done"
    assert len(alone[0]) > 50


def without_control(server):
    """Requests of a client while another one is in control."""
    with Client(server) as client:
        reason = f"person {client.newest['clients']['steering']} is in control"
        for type_, values in {**IN_CONTROL, "steer": {"take": True}}.items():
            assert client.refused(type_, **values).startswith(reason)


def incomplete(server):
    """Parts of a request on a web socket."""
    whole = json.dumps({"type": "edit", "values": {"target.depth_mm": 25.0}})
    with Client(server) as client:
        for text in (*(whole[:end] for end in range(len(whole) + 1)), b"\x01\x02", "x" * 390_000):
            client.newest.pop("refused", None)
            client.socket.send(text)
            assert client.has("refused")["reason"]


def invalid(server):
    """Other protocols, methods, and headers, addresses and bodies that are too long."""
    host = f"Host: 127.0.0.1:{port_of(server)}\r\nConnection: close\r\n"

    def ask(first, more="", body=b""):
        return exchange(server, f"{first} HTTP/1.1\r\n{host}{more}\r\n".encode() + body)

    hello = b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n"  # of TLS
    for nonsense in (hello, b"GET\r\n\r\n", b"\0" * 100_000, os.urandom(2_000) + b"\r\n\r\n"):
        assert exchange(server, nonsense) in (0, 400)
    assert ask("TRACE /") == ask("DELETE /static/main.js") == 405
    assert {ask(f"GET /{'x' * 200_000}"), ask("GET /", f"X: {'x' * 200_000}\r\n")} <= {0, 400}
    assert ask("POST /", "Content-Length: 5000000\r\n", b"x" * 5_000_000) in (0, 405)


def exchange(server, request: bytes) -> int:
    """Return the status of the answer to the bytes of a request; 0 if the connection is reset."""
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=PATIENCE_S) as line:
        try:
            line.sendall(request)
            answer = b"".join(iter(lambda: line.recv(65_536), b""))
        except (BrokenPipeError, ConnectionResetError):
            return 0
    return int(re.match(rb"HTTP/1.1 (\d+)", answer)[1])
