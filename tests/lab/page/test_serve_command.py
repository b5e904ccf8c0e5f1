"""`flexneedle serve`: its start, its messages, its end."""

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from importlib.resources import files

import pytest

from flexneedle.cli.main import main
from flexneedle.lab.commands import serve
from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.page.server.connected_rig import RigReference
from page_clients import PATIENCE_S


def test_the_schema_is_what_the_command_prints(capsys):
    assert main(["scenario", "schema"]) == 0
    assert json.loads(build_catalog().schema) == json.loads(capsys.readouterr().out)
    assert build_catalog().controllers[0]["name"] == "adaptive-mpc"


def test_the_server_does_not_import_the_compiler_or_the_simulator():
    script = "import sys, flexneedle.lab.page.server.page_server; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"numba", "scipy", "matplotlib", "pyarrow", "pandas", "mcap"}
    layers = ("simulator", "mechanics", "planning", "estimation", "control", "rig", "runs")
    assert not loaded & {f"flexneedle.{layer}" for layer in layers}


@contextmanager
def started(*arguments):
    """The command as a process, when it has printed its address."""
    command = [sys.executable, "-m", "flexneedle", "serve", "--port", "0", "--no-open", *arguments]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_it_prints_its_address_and_ends_clean(tmp_path, ending):
    with started("--runs", str(tmp_path)) as (process, address):
        assert address.startswith("http://127.0.0.1:")
        port = int(address.rstrip("/").rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as page:
            page.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
            assert page.recv(12) == b"HTTP/1.1 200"
        process.send_signal(ending)
        _out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == (0 if ending == signal.SIGINT else -ending)
    assert "Traceback" not in errors
    assert errors.startswith("flexneedle: Ctrl-C ends the server\n")


def failed(capsys, *arguments):
    """The message of a command that is refused."""
    assert main(["serve", "--no-open", *arguments]) == 2
    return capsys.readouterr().err


def test_a_port_that_is_taken_is_named(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        message = failed(capsys, "--port", str(port))
    assert message == (
        f"flexneedle: cannot listen on 127.0.0.1, port {port}: Address already in use; choose another with --port\n"
    )


def test_wrong_arguments_are_refused_in_one_line(capsys):
    message = failed(capsys, "--host", "192.0.2.1", "--port", "0")
    assert message.startswith("flexneedle: cannot listen on 192.0.2.1, port 0: ")
    assert message.endswith("; choose others with --host and --port\n")
    assert failed(capsys, "nonsense").startswith("flexneedle: nonsense: no such file, and no such preset")


@pytest.mark.parametrize("port", ["-1", "65536", "x", "1.5", "²"])
def test_a_port_has_a_range(capsys, port):
    with pytest.raises(SystemExit):
        main(["serve", "--port", port])
    assert "must be a whole number from 0 to 65535" in capsys.readouterr().err


def test_without_its_packages_it_names_them(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "flexneedle.lab.page.server.page_server", raising=False)
    message = failed(capsys)
    assert message == (
        "flexneedle: the page needs starlette, uvicorn and websockets: pip install 'flexneedle[page]'\n"
    )


@pytest.fixture
def setups(monkeypatch):
    """What servers were started with."""
    found = []
    monkeypatch.setattr(
        "flexneedle.lab.page.server.page_server.PageServer",
        lambda setup, *_where: found.append(setup) or Ended(),
    )
    return found


def test_a_world_is_shown_without_a_rig(setups):
    assert main(["serve", "world:7", "--no-open"]) == 0
    (setup,) = setups
    assert setup.rig is None
    assert setup.session.name == "world:7"
    assert setup.limits == PageLimits()


def test_a_rig_is_named_by_its_file_and_clients_are_lost_sooner(setups):
    assert main(["serve", "phantom", "--rig", "emulated", "--no-open"]) == 0
    (setup,) = setups
    assert setup.rig == RigReference("Emulated rig", "emulated")
    assert setup.limits.ping_s + setup.limits.pong_s <= 2.0 < PageLimits().pong_s


def test_a_rig_that_cannot_be_used_is_refused_in_one_line(capsys, tmp_path):
    assert failed(capsys, "--rig", "nonsense").startswith(
        "flexneedle: nonsense: no such file, and no such rig"
    )
    path = tmp_path / "rig.toml"
    path.write_text(
        (files("flexneedle.lab.rig") / "rigs" / "emulated.toml").read_text() + "[ros]\narm = true\n"
    )
    message = failed(capsys, "--rig", str(path))
    rule = "must be false for the page, which arms the rig and has the target: use flexneedle insert"
    assert message == f"flexneedle: ros.arm = true: {rule}\n"


class Ended:
    """A server that has nothing to do."""

    address = "http://127.0.0.1:1/"

    def serve_until_interrupted(self):
        self.on_start()


@pytest.mark.parametrize(
    ("arguments", "display", "opened"),
    [(["--open"], "", True), (["--no-open"], ":0", False), ([], ":0", True), ([], "", False)],
)
def test_a_browser_is_opened_where_there_is_a_display(monkeypatch, arguments, display, opened):
    addresses = []
    monkeypatch.setattr("flexneedle.lab.page.server.page_server.PageServer", lambda *_setup: Ended())
    monkeypatch.setattr("webbrowser.open", addresses.append)
    monkeypatch.setattr(serve, "Thread", Immediate)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(os.environ, "DISPLAY", display)
    monkeypatch.delitem(os.environ, "WAYLAND_DISPLAY", raising=False)
    assert main(["serve", *arguments]) == 0
    assert addresses == (["http://127.0.0.1:1/"] if opened else [])


class Immediate:
    """A thread that has ended when it is started."""

    def __init__(self, target, args, **_options):
        self.start = lambda: target(*args)
