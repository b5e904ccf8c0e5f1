"""Programs of the C++ library as peers: the examples that Debian ships as sources (`openigtlink-examples`)."""

import asyncio
import shutil
import socket
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest

from flexneedle.lab.igtl.endpoint import IgtlClient, IgtlServer
from flexneedle.lab.igtl.messages import StatusMessage, StringMessage, TransformMessage
from igtl_messages import EXAMPLES

SOURCES = Path("/usr/share/doc/openigtlink-examples/examples")
INCLUDES = Path("/usr/include/openigtlink")
SHOWN = {
    "TRANSFORM": "0, -1, 0, 1.5\n1, 0, 0, -2.25\n0, 0, 1, 30\n0, 0, 0, 1\n",
    "POSITION": "position   = (1, 2, 3)\nquaternion = (0, 0, 0, 1)\n",
    "POINT": " Position  : ( 1.000000, 2.000000, 35.500000 )\n Radius    : 2.000000\n Owner     : CT\n",
    "TRAJ": " Target Pt : ( 1.000000, 2.000000, 35.500000 )\n Radius    : 0.500000\n",
    "POLYDATA": "Receiving : POLYDATA\n",
    "STATUS": " Code      : 1\n SubCode   : -2\n Error Name: OK\n Status    : inserting\n",
    "STRING": "Encoding: 3; String: 0.4 mm\n",
}

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not (SOURCES.exists() and INCLUDES.exists() and shutil.which("g++")),
        reason="openigtlink-examples, libopenigtlink-dev or g++ is not installed",
    ),
]


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")

    def compile_example(path):
        program = folder / Path(path).name
        if not program.exists():
            source = SOURCES / f"{path}.cxx"
            command = ["g++", "-w", f"-I{INCLUDES}", source, "-o", program, "-lOpenIGTLink", "-lpthread"]
            subprocess.run(command, check=True)
        return program

    return compile_example


@contextmanager
def running(*command, output=subprocess.DEVNULL):
    with subprocess.Popen(list(map(str, command)), stdout=output, stderr=subprocess.STDOUT) as process:
        try:
            yield process
        finally:
            process.kill()


async def until(condition):
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.01)


def test_a_client_in_cpp_reads_every_message(build, tmp_path):
    program, shown = build("Receiver/ReceiveClient"), tmp_path / "shown"

    async def scenario():
        async with IgtlServer(print, print, port=0) as server:
            with (
                shown.open("w") as output,
                running("stdbuf", "-o0", program, server.host, server.port, output=output),
            ):
                await until(lambda: server.peers)
                for message in EXAMPLES.values():
                    server.send(message)
                await until(lambda: SHOWN["STRING"] in shown.read_text())

    asyncio.run(scenario())
    found = shown.read_text()
    assert "CRC" not in found
    for text in SHOWN.values():
        assert text in found


def test_a_client_in_cpp_reads_the_needle_as_one_line(build, tmp_path):
    program, shown = build("PolyData/PolyDataClient"), tmp_path / "shown"

    async def scenario():
        async with IgtlServer(print, print, port=0) as server:
            server.send(EXAMPLES["POLYDATA"])
            with (
                shown.open("w") as output,
                running("stdbuf", "-o0", program, server.host, server.port, output=output),
            ):
                await until(lambda: "TriangleStrips" in shown.read_text())

    asyncio.run(scenario())
    assert "point[1] = (1, 0.5, 0)\n  point[2] = (2, 0.75, -1)" in shown.read_text()
    assert (
        "Lines ------\n  cell[0] = (0, 0, 1, 2)\n" in shown.read_text()
    )  # the example repeats the first point


@pytest.mark.parametrize(
    ("path", "arguments", "kind", "holds"),
    [
        ("Status/StatusServer", (), StatusMessage, lambda one: one.error == "OK!" and one.subcode == 128),
        ("String/StringServer", (10,), StringMessage, lambda one: one.text == "OpenIGTLink"),
        ("Tracker/TrackerServer", (10,), TransformMessage, lambda one: one.matrix[3] == (0.0, 0.0, 0.0, 1.0)),
        ("Point/PointServer", (), None, lambda one: one.points[1].position == (40.0, 50.0, 60.0)),
        (
            "Trajectory/TrajectoryServer",
            (),
            None,
            lambda one: (one.trajectories[0].entry, one.trajectories[0].radius) == ((10.0, 20.0, 30.0), 15.0),
        ),
    ],
)
def test_messages_of_a_server_in_cpp_are_read(build, path, arguments, kind, holds):
    program = build(path)
    with socket.create_server(("", 0)) as free:
        port = free.getsockname()[1]
    found = []

    async def scenario():
        with running(program, port, *arguments):
            async with IgtlClient(lambda one, _: found.append(one), print, port=port):
                await until(lambda: found)

    asyncio.run(scenario())
    assert kind is None or isinstance(found[0], kind)
    assert holds(found[0])
