"""`flexneedle serve`: its start, its messages, its end."""

import json
import os
import signal
import socket
import subprocess
import sys
from importlib.resources import files

import pytest

from flexneedle.cli.main import main
from flexneedle.lab.commands import serve
from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.page.server.connected_rig import RigReference
from page_clients import PATIENCE_S


def test_the_schema_is_equal_to_the_output_of_the_command(capsys):
    assert main(["scenario", "schema"]) == 0
    assert json.loads(build_catalog().schema) == json.loads(capsys.readouterr().out)
    assert build_catalog().controllers[0]["name"] == "adaptive-mpc"


def test_the_server_does_not_import_the_compiler_or_the_simulator():
    script = "import sys, flexneedle.lab.page.server.page_server; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"numba", "scipy", "matplotlib", "pyarrow", "pandas", "mcap"}
    rooms = ("simulator", "mechanics", "planning", "estimation", "control", "phantom", "lab.rig.rig_file")
    assert not loaded & {f"flexneedle.{room}" for room in rooms}


@pytest.mark.parametrize("ending", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_it_prints_its_address_and_ends_clean(tmp_path, ending):
    command = [
        sys.executable,
        "-m",
        "flexneedle",
        "serve",
        "--port",
        "0",
        "--no-open",
        "--runs",
        str(tmp_path),
    ]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        port = int(address.rstrip("/").rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as page:
            page.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
            assert page.recv(12) == b"HTTP/1.1 200"
        process.send_signal(ending)
        _out, errors = process.communicate(timeout=100.0)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == (0 if ending == signal.SIGINT else -ending)
    assert errors == "flexneedle: Ctrl-C ends the server\n"


def refusal(capsys, *arguments):
    """Return the only line of a command that is refused."""
    assert main(["serve", "--no-open", *arguments]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line.removeprefix("flexneedle: ")


def test_addresses_and_names_that_cannot_be_used_are_refused_in_one_line(capsys, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        message = refusal(capsys, "--port", str(port))
        other = refusal(capsys, "--igtl", str(port))
    for line in (message, other):
        assert line.startswith(f"cannot listen on 127.0.0.1, port {port}: ")
    assert "--host" in refusal(capsys, "--host", "192.0.2.1", "--port", "0")
    for arguments in (["nonsense"], ["--rig", "nonsense"]):
        assert refusal(capsys, *arguments).startswith("nonsense: no such file, and no such")
    path, shipped = tmp_path / "rig.toml", files("flexneedle.lab.rig") / "rigs" / "emulated.toml"
    path.write_text(shipped.read_text() + "[ros]\narm = true\n")
    assert refusal(capsys, "--rig", str(path)).startswith("ros.arm = true: ")
    for number in ("-1", "65536", "x", "1.5", "²"):
        with pytest.raises(SystemExit):
            main(["serve", "--port", number])
        assert "0 to 65535" in capsys.readouterr().err


def test_without_its_packages_it_names_them(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "flexneedle.lab.page.server.page_server", raising=False)
    assert "pip install 'flexneedle[page]'" in refusal(capsys)


class Ended:
    """A server that ends when it has started."""

    address = "http://127.0.0.1:1/"

    def serve_until_interrupted(self):
        self.on_start()


@pytest.fixture
def setups(monkeypatch):
    """The settings with which servers were started."""
    found = []
    monkeypatch.setattr(
        "flexneedle.lab.page.server.page_server.PageServer",
        lambda setup, *_where: found.append(setup) or Ended(),
    )
    return found


def test_it_serves_a_world_or_a_rig_with_shorter_limits(setups):
    assert main(["serve", "world:7", "--no-open"]) == 0
    assert main(["serve", "phantom", "--rig", "emulated", "--no-open"]) == 0
    world, rig = setups
    assert (world.rig, world.session.name, world.limits) == (None, "world:7", PageLimits())
    assert rig.rig == RigReference("Emulated rig", "emulated")
    assert rig.limits.ping_s + rig.limits.pong_s <= 2.0 < PageLimits().pong_s


@pytest.mark.usefixtures("setups")
@pytest.mark.parametrize(
    ("arguments", "display", "opened"),
    [(["--open"], "", True), (["--no-open"], ":0", False), ([], ":0", True), ([], "", False)],
)
def test_a_browser_is_opened_where_there_is_a_display(monkeypatch, arguments, display, opened):
    addresses = []
    monkeypatch.setattr("webbrowser.open", addresses.append)
    monkeypatch.setattr(serve, "Thread", Immediate)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(os.environ, "DISPLAY", display)
    monkeypatch.delitem(os.environ, "WAYLAND_DISPLAY", raising=False)
    assert main(["serve", *arguments]) == 0
    assert addresses == ([Ended.address] if opened else [])


class Immediate:
    """A thread that has ended when it is started."""

    def __init__(self, target, args, **_options):
        self.start = lambda: target(*args)
