"""A virtual insertion in real time while its server is attacked over real sockets, as `flexneedle serve` runs it.

Everything is refused with a reason, and the insertion is not disturbed: it has the same rows as without the attack, and
misses no control period. A period is missed if its decision takes longer than it lasts, or if it ends half of it too
late, by which all later rows are then late. A row that is late alone was kept by the attacked server on its way to the
page, for which the insertion does not wait. Whatever else runs on the computer, such as this test, may make it miss a
period as well: if one without the attack misses some just before, it may miss twice as many. One that misses more is
attacked again: an attack that disturbs does so each time.
"""

import json
import os
import re
import socket
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

import page_clients
from flexneedle.lab.page.worker.recordings import row_of
from flexneedle.record.loading import load_insertion
from page_clients import Client, port_of

SEED, DEPTH_MM, LATERAL_MM = 3, 30.0, 2.0
FLEXNEEDLE = (sys.executable, "-m", "flexneedle")
TIMED = {"decide_ms"}
"""Parts of a row that the wall clock decides."""
PERIOD_S = 0.2
"""A control period of the preset `phantom`, at 5 mm/s."""
ATTEMPTS = 3
"""Of an attack that disturbs nothing, while other tests may run."""
SECRET = "nobody may read this"
SERVER = {"python", "flexneedle", "root:", "def ", SECRET}
"""Of which there is something in files that are not the page's."""


@dataclass(frozen=True)
class Served:
    """A server of `flexneedle serve`. cookie: what has its token; secret: a file beside its folder of runs."""

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
    """A server of another address than the computer's own, so that it has a token; it prints no traceback."""
    (tmp_path / "secret.txt").write_text(SECRET)
    (tmp_path / "runs").mkdir()
    command = [*FLEXNEEDLE, "serve", "phantom", "--no-open", "--port", "0", "--host", "0.0.0.0"]
    with (
        (tmp_path / "errors").open("w") as errors,
        subprocess.Popen(
            [*command, "--runs", str(tmp_path / "runs")], stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        try:
            yield Served(process.stdout.readline().strip(), tmp_path / "runs")
        finally:
            process.terminate()
    assert (tmp_path / "errors").read_text() == "flexneedle: Ctrl-C ends the server\n"


class Member(Client):
    """A client with the token. times: when it got each row (s); most: clients at the same time."""

    def __init__(self, server):
        self.times, self.most = {}, 0
        super().__init__(server, additional_headers={"Cookie": server.cookie})

    def read(self, timeout=None):
        super().read(page_clients.PATIENCE_S if timeout is None else timeout)
        for index in range(len(self.times), len(self.rows.get("live", ()))):
            self.times[index] = monotonic()
        self.most = max(self.most, self.newest.get("people", {"clients": 0})["clients"])


@dataclass(frozen=True)
class Watched:
    """An insertion as a client has seen it: its rows, when they came (s), and how it ended."""

    rows: list
    times: list
    end: dict

    @property
    def plain(self) -> list:
        """The rows without times of the wall clock."""
        return [{key: value for key, value in row.items() if key not in TIMED} for row in self.rows]

    @property
    def missed(self) -> list[int]:
        """Indices of the periods that were missed. A row is due when its period begins, which lasts until its time."""
        begins = [0.0, *(row["time"] for row in self.rows)][:-1]
        late = np.subtract(self.times, begins)
        with_all_later = np.minimum.accumulate(late[::-1])[::-1]
        return [
            row["index"]
            for row, more in zip(self.rows, np.diff(with_all_later, prepend=with_all_later[0]), strict=True)
            if row["decide_ms"] > 1e3 * PERIOD_S or more > 0.5 * PERIOD_S
        ]


def inserted(client: Member, name: str) -> Watched:
    """Insert in real time, and save the run under a name."""
    client.rows, client.times, client.most = {}, {}, 0
    client.do("insert")
    client.job("insertion", "done")
    client.do("save", name=name)
    client.job("save", "done")
    return Watched(client.rows["live"], list(client.times.values()), client.newest["insertion live"])


def rows_in(folder: Path) -> list:
    """Rows of a recorded insertion, without times."""
    insertion, lacking = load_insertion(folder)
    assert not lacking
    return [row_of(period, insertion.plan).model_dump(exclude=TIMED) for period in insertion.periods]


def watched(times, decide_ms=12.0):
    """An insertion of which a page has the rows at these times (s)."""
    rows = [{"index": k, "time": PERIOD_S * (k + 1), "decide_ms": decide_ms} for k in range(len(times))]
    return Watched(rows, times, {})


def test_a_period_that_is_missed_is_found():
    in_time = (100.0 + PERIOD_S * np.arange(20)).tolist()
    assert watched(in_time).missed == []
    rolls = watched([*in_time[:12], *(time + 0.5 for time in in_time[12:])])
    for row in rolls.rows[11:]:
        row["time"] += 0.5
    assert rolls.missed == []
    assert watched([*in_time[:12], *(time + 0.11 for time in in_time[12:])]).missed == [12]
    assert watched([*in_time[:12], in_time[12] + 0.15, *in_time[13:]]).missed == []
    assert watched(in_time[:3], decide_ms=210.0).missed == [0, 1, 2]


@pytest.mark.slow
def test_all_is_refused_and_the_insertion_is_not_disturbed(server, tmp_path, monkeypatch):
    monkeypatch.setattr(
        page_clients, "PATIENCE_S", 200.0
    )  # the server takes its time to start where many run
    with Member(server) as client, ThreadPoolExecutor(1) as pool:
        client.steer()
        client.do("options", seed=SEED)
        client.do("edit", values={"target.depth_mm": DEPTH_MM, "target.lateral_mm": LATERAL_MM})
        revision = client.newest["session"]["revision"]
        client.wait(lambda: client.newest.get("plan manipulation", {}).get("revision") == revision)
        for attempt in range(ATTEMPTS):
            alone = inserted(client, f"alone {attempt}")
            attacked = attacked_by_all(server, client, pool, name := f"attacked {attempt}")
            assert client.most == 32
            assert attacked.plain == alone.plain
            if undisturbed := len(attacked.missed) <= 2 * len(alone.missed):
                break

    assert undisturbed, (alone.missed, attacked.missed)
    assert attacked.end["state"] == "done"
    assert len(attacked.times) == attacked.end["periods"] == alone.end["periods"] > 50
    target = ("--target", str(DEPTH_MM), str(LATERAL_MM), "--seed", str(SEED))
    command = [*FLEXNEEDLE, "insert", "phantom", *target, "--out", str(tmp_path / "command")]
    subprocess.run(command, check=True, capture_output=True)
    by_command = rows_in(tmp_path / "command")
    np.testing.assert_equal(rows_in(server.runs / name), by_command)  # NaN equals NaN
    assert len(by_command) == len(attacked.rows)


def attacked_by_all(server, client, pool, name) -> Watched:
    """An insertion during which everything is tried, once at least."""
    watching, rounds = pool.submit(inserted, client, name), 0
    while not watching.done() or rounds == 0:
        for attack in ATTACKS:
            attack(server)
        rounds += 1
    return watching.result()


# Sockets


def exchanged(server, request: bytes) -> tuple[int, str]:
    """Status and body of the answer to the bytes of a request, after which the connection ends."""
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


def asked(server, path="/", method="GET", more=b"", **headers) -> tuple[int, str]:
    """Status and body of a request with the token; headers: in place of Host and Cookie, None: without it."""
    headers = {"Host": server.host, "Cookie": server.cookie, "Connection": "close"} | headers
    lines = [f"{name.replace('_', '-')}: {value}" for name, value in headers.items() if value is not None]
    return exchanged(server, "\r\n".join((f"{method} {path} HTTP/1.1", *lines, "", "")).encode() + more)


def connected(server, **headers) -> tuple[int, str]:
    """Status and body of the answer to a request for the web socket."""
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13"}
    key = {"Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    return asked(server, "/live", **{"Origin": f"http://{server.host}"} | upgrade | key | headers)


# Attacks


def strangers(server):
    """Requests with a wrong Host, with a foreign Origin, or without one, and without the token or with another."""
    foreign = {"Host": "evil.example", "Origin": "http://evil.example"}
    for ask in (asked, connected):
        for name, value in foreign.items():
            status, reason = ask(server, **{name: value})
            assert (status, reason.startswith(f"{name} = ")) == (403, True), (status, reason)
        for cookie in (None, "", f"flexneedle-{port_of(server)}=guessed", f"other={server.cookie}"):
            status, reason = ask(server, Cookie=cookie)
            assert (status, reason.startswith("the token is missing or wrong")) == (401, True)
    assert asked(server, "/?token=guessed", Cookie=None)[0] == 401
    assert connected(server, Origin=None) == (403, "Origin is missing: only the page itself may connect\n")


PLACES = ("/", "/static/", "/runs/", "/runs/alone 0/", "/live/", "/schema.json/", "/scenario.toml/")
WAYS = (
    *("../secret.txt", "../../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "%2e%2e%2fsecret.txt"),
    *("..%5csecret.txt", "....//secret.txt", "..;/secret.txt", "%252e%252e%252fsecret.txt"),
    *("../server/guard.py", "%2e%2e/server/guard.py", "../trace.csv", "%2e%2e/trace.csv", "..%2f/run.zip"),
    *("/etc/passwd", "%2fetc%2fpasswd", "../../../../../../../../etc/passwd", "run.json", "trace.mcap"),
    *("%00", "secret.txt%00", "%ff%fe", "C:%5c", "~root/", "." * 300, "x" * 5_000),
)


def paths(server):
    """Paths that leave the folders, in all routes."""
    for place in PLACES:
        for way in WAYS:
            status, body = asked(server, place + way)
            assert 400 <= status < 500, (place, way, status)
            assert body.strip(), (place, way)
            assert not any(word in body for word in SERVER), (place, way, body)
    with Member(server) as client:
        for name in ("../secret.txt", "..", "/etc", "alone/../..", "alone\0"):
            assert client.refused("open", name=name).startswith(f"person {steering(client)} is in control")


def steering(client):
    return client.newest["people"]["steering"]


def not_steering(server):
    """Requests of a page that does not steer."""
    requests = (
        ("insert", {}), ("pace", {"pace": 0.0}), ("advance", {}), ("disturb", {"what": "push", "size": 1.0}),
        ("edit", {"values": {"target.depth_mm": 25.0}}), ("preset", {"name": "phantom3d"}), ("cancel", {"job": 1}),
        ("options", {"seed": 7}), ("start", {"work": "plan"}), ("load", {"name": "x", "text": ""}),
        ("save", {"name": "x"}), ("open", {"name": None}), ("steer", {"take": True}),
    )  # fmt: skip
    with Member(server) as client:
        for type_, values in requests:
            assert client.refused(type_, **values).startswith(f"person {steering(client)} is in control")


def malformed(server):
    """What is no request: parts of one, bytes, another protocol, requests that are none of HTTP."""
    whole = json.dumps({"type": "edit", "values": {"target.depth_mm": 25.0}})
    texts = [
        *(whole[:end] for end in range(len(whole))),
        whole[::-1],
        "\0",
        "NaN",
        "[" * 1000,
        '{"type": "exec"}',
    ]
    with Member(server) as client:
        for text in (*texts, b"", b"\x01\x02"):
            client.newest.pop("refused", None)
            client.socket.send(text)
            assert client.wait(lambda: client.newest.get("refused"))["reason"]
    hello = b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n"  # of TLS
    for nonsense in (hello, b"GET\r\n\r\n", b"\0" * 100_000, os.urandom(2_000) + b"\r\n\r\n"):
        assert exchanged(server, nonsense)[0] in (0, 400)
    assert asked(server, method="TRACE")[0] == asked(server, "/static/main.js", method="DELETE")[0] == 405


def oversized(server):
    """Messages, headers, addresses and bodies that are too long."""
    with Member(server) as client:
        assert client.refused("edit", values={"name": "x" * 20_000}).endswith(
            "bytes: must have at most 16000"
        )
        client.newest.pop("refused")
        client.socket.send(json.dumps({"type": "load", "name": "x", "text": "x" * 390_000}))
        reason = client.wait(lambda: client.newest.get("refused"))["reason"]
        assert reason.endswith("bytes: must have at most 380000")
        client.socket.send("x" * 1_000_001)
        assert closed(client) == 1009
    assert asked(server, "/" + "x" * 200_000)[0] in (0, 400)
    assert asked(server, X="x" * 200_000)[0] in (0, 400)
    assert asked(server, method="POST", more=b"x" * 5_000_000, Content_Length=5_000_000)[0] in (0, 405)


def many(server):
    """200 pages, and 200 connections that send nothing."""
    with ExitStack() as stack:
        for _ in range(200):
            stack.enter_context(socket.create_connection(("127.0.0.1", port_of(server))))
        answers = Counter()
        for _ in range(200):
            client = Member(server)
            stack.callback(client.socket.close)
            answers[first_answer(client)] += 1
        reason = "32 pages are connected, which is the limit: close one"
        assert set(answers) == {"welcome", (1013, reason)}
        assert answers[1013, reason] > 100  # of those that came first some may be gone by then


def closed(client):
    """Read until the connection is closed; the code of its end."""
    with pytest.raises(ConnectionClosed) as end:
        client.wait(lambda: False)
    return end.value.rcvd.code


def first_answer(client):
    """ "welcome", or code and reason of a connection that is closed."""
    try:
        client.read()
    except ConnectionClosed as end:
        return end.rcvd.code, end.rcvd.reason
    return next(iter(client.newest))


ATTACKS = (strangers, paths, not_steering, malformed, oversized, many)
