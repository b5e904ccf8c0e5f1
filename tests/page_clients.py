"""A served page, and clients of its web socket."""

import json
import os
from collections.abc import Callable
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from unittest.mock import patch

from websockets.sync.client import connect

from flexneedle.lab.page.protocol import ServerMessage
from flexneedle.lab.page.server import job_queue
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.page.server.page_server import PageServer
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.lab.page.server.request_handler import PageSetup
from flexneedle.lab.process import ChildProcess
from flexneedle.scenario.files import load_scenario
from page_frames import unpack_frame
from page_worker import WorkerThread

STUB = ("page_worker",)
PATIENCE_S = 200.0
"""Deadline of a wait, which takes milliseconds on an idle machine; workers start slowly beside other processes."""
QUICK = PageLimits(rest_s=60.0, alone_s=60.0, cancel_s=60.0, stop_s=60.0, runs_s=0.05)
"""Limits that a busy machine does not reach; a changed scenario is planned only on request."""

IN_CONTROL = {
    "edit": {"values": {"target.depth_mm": 35.0}}, "preset": {"name": "phantom3d"},
    "load": {"name": "mine", "text": ""},
    "options": {"seed": 3}, "start": {"work": "plan"}, "cancel": {"job": 1}, "insert": {}, "check": {},
    "prepare": {}, "arm": {"armed": True, "job": 1}, "go": {}, "rest": {}, "undo": {}, "targets": {"what": "add"},
    "pace": {"pace": 1.0}, "advance": {}, "disturb": {"what": "drop", "size": 1.0}, "open": {"name": None},
    "study": {"name": "mine"}, "save": {"name": "mine"}, "retract": {},
}  # fmt: skip
"""Requests that only the client in control may send, by type."""


_RESTORED = ("name", "values", "seed", "strategy", "controller", "targets", "target")


def restored(session):
    """Values of the request that gives a session (its message) back."""
    return {name: session[name] for name in _RESTORED}


def start_worker(module, *arguments):
    """Start a worker: the stub in a thread, any other in a process."""
    return WorkerThread() if (module,) == STUB else ChildProcess(module, *arguments)


@contextmanager
def served(
    runs: Path, name="phantom", *, limits=QUICK, rig=None, host="127.0.0.1", port=0, workers=(STUB, STUB)
):
    """A server in a thread, on a free port; its workers may be modules of the tests."""
    session = PageSession.of(name, load_scenario(name))
    server = PageServer(PageSetup(session, runs, limits, workers, rig), host, port)
    listens = Event()
    server.on_start = listens.set
    thread = Thread(target=server.serve_until_interrupted)
    path = os.pathsep.join((str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")))
    with patch.dict(os.environ, PYTHONPATH=path), patch.object(job_queue, "ChildProcess", start_worker):
        thread.start()
        try:
            assert listens.wait(PATIENCE_S)
            yield server
        finally:
            server.should_exit = True
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def port_of(server) -> int:
    return int(server.address.partition("?")[0].rstrip("/").rpartition(":")[2])


class Client:
    """A client. newest: last message of each key; rows: received rows of each insertion, in order."""

    def __init__(self, server, **options) -> None:
        port = port_of(server)
        fixed = {"proxy": None, "max_size": None, "ping_interval": None, "close_timeout": 0.1}
        options = {"origin": f"http://127.0.0.1:{port}"} | fixed | options
        self._connecting = connect(f"ws://127.0.0.1:{port}/live", **options)
        self.socket = self._connecting.__enter__()
        self.newest, self.rows = {}, {}
        self._asked = 0

    def __enter__(self):
        self.wait(lambda: "clients" in self.newest and "session" in self.newest)
        return self

    def __exit__(self, *_error) -> None:
        self._connecting.__exit__(None, None, None)

    @property
    def number(self) -> int:
        return self.newest["welcome"]["client"]

    def send(self, type_: str, **values) -> None:
        self.socket.send(json.dumps({"type": type_, **values}))

    def ask(self, type_: str, **values) -> dict:
        """Send a request, and return the answer."""
        self._asked += 1
        self.send(type_, request=self._asked, **values)
        return self.wait(lambda: self.answer_to(self._asked))

    def refused(self, type_: str, **values) -> str:
        """Send a request that is refused, and return the reason."""
        answer = self.ask(type_, **values)
        assert answer["type"] == "refused", answer
        assert answer["what"] == type_
        return answer["reason"]

    def do(self, type_: str, **values) -> None:
        """Send a request that is carried out."""
        answer = self.ask(type_, **values)
        assert answer["type"] == "done", answer

    def steer(self):
        self.do("steer", take=True)
        return self

    def run_names(self) -> list[str]:
        """Return the names of the runs, the newest first; none before the first message."""
        return [run["name"] for run in self.newest.get("runs", {"runs": []})["runs"]]

    def answer_to(self, number: int) -> dict | None:
        answers = (self.newest.get("done"), self.newest.get("refused"))
        return next((answer for answer in answers if answer and answer["request"] == number), None)

    def wait(self, wanted: Callable[[], object]):
        """Read messages until a function returns a true value, and return that."""
        end = monotonic() + PATIENCE_S
        while not (found := wanted()):
            self.read(timeout=max(end - monotonic(), 0.0))
        return found

    def read(self, timeout: float = PATIENCE_S) -> None:
        """Read one message."""
        message = self.socket.recv(timeout=timeout)
        if isinstance(message, bytes):
            self.newest[unpack_frame(message).key] = message
            return
        values = json.loads(message)
        self.newest[_key(values)] = values
        if values["type"] == "rows":
            rows = self.rows.setdefault(values["of"], [])
            assert values["first"] <= len(rows), "rows are missing"
            rows[values["first"] :] = values["rows"]

    def has(self, key: str, **values) -> dict:
        """Wait for a message of a key with these values, and return it."""
        return self.wait(
            lambda: (found := self.newest.get(key)) and values.items() <= found.items() and found
        )

    def job(self, kind: str, state: str) -> dict:
        """Wait for the state of a job."""
        return self.has(f"job {kind}", state=state)

    def inserts(self, state: str, **options) -> None:
        """Start a virtual insertion and wait for its state."""
        self.do("insert", **options)
        self.has("insertion live", state=state)

    def got_rows(self, count: int, of: str = "live") -> None:
        """Wait for all rows of an insertion."""
        self.wait(lambda: [row["index"] for row in self.rows.get(of, ())] == list(range(count)))


BY = {each.model_fields["type"].default: each.by for each in ServerMessage.__subclasses__()}


def _key(values) -> str:
    """Return the key of a message, as `ServerMessage.key`."""
    by = BY[values["type"]]
    return f"{values['type']} {values[by]}" if by else values["type"]


def get(server, path: str, **headers) -> tuple[int, str, dict[str, str]]:
    """Return status, text and headers (lower case) of a page. headers: of the request, `_` for `-`."""
    connection = HTTPConnection("127.0.0.1", port_of(server), timeout=PATIENCE_S)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    response = connection.getresponse()
    body = response.read().decode(errors="replace")
    found = {name.lower(): value for name, value in response.getheaders()}
    connection.close()
    return response.status, body, found
