"""Insertions that peers of pyigtl follow, aim and stop, over sockets; most are invented, the node is its process."""

import json
import socket
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest

import flexneedle
from commands import run
from emulated import DEADLINE_S, until
from flexneedle.cli.common import choose_scenario
from flexneedle.errors import RunError, ScenarioWarning, StoppedError
from flexneedle.lab.igtl.bridge import IgtlBridge
from flexneedle.lab.igtl.settings import IgtlAddress, IgtlSettings
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.loop.events import Ended, PeriodEnded, Planned
from flexneedle.planning.events import Iterated
from flexneedle.results import Insertion, Outcome
from flexneedle.types import Pose
from igtl_messages import MATRIX
from igtl_peers import connected, free_port
from ros_rig import PATIENCE_S, quick_scenario, started
from synthetic import make_periods, make_plan

PLAN = make_plan()
PERIODS = list(make_periods(PLAN))
SPACE = flexneedle.load_scenario("phantom3d")
IMAGE = ImageRegistration.of_matrix(MATRIX)
IN_IMAGE = SPACE.with_values({"image.rotation": IMAGE.rotation, "image.translation_mm": IMAGE.translation})


class Rig:
    """A replacement for the client of a supervisor."""

    ended = None

    def __init__(self):
        self.stops = []

    def now(self):
        return 0.0

    def request_stop(self, why):
        self.stops.append(why)


@pytest.fixture
def port():
    return free_port()


def opened(port, **more):
    return IgtlBridge(IgtlSettings(IgtlAddress(port=port)), **more)


def listed(bridge):
    return [one["event"] for one in bridge.record["events"]]


def await_peer(bridge, peer):
    """Wait until the node has a message of a peer, so that it gets what follows."""
    peer.send_text("hello")
    until(lambda: any("'Text'" in one for one in listed(bridge)))


def test_a_peer_receives_an_insertion(port):
    with opened(port, scenario=IN_IMAGE) as bridge, connected(port) as peer:
        await_peer(bridge, peer)
        bridge(Iterated("manipulation", {}))
        bridge(Planned(PLAN))
        for period in PERIODS:
            bridge(PeriodEnded(period))
        bridge(Ended(Insertion(PLAN, 0, tuple(PERIODS), Outcome.HELD, "no sample for 1.00 s")))
        last = PERIODS[-1]
        at = (np.linalg.inv(MATRIX) @ [*last.estimate.point, 1.0])[:3]
        until(lambda: peer.last("NeedleTip") is not None)
        until(lambda: np.allclose(peer.last("NeedleTip").matrix[:3, 3], at, atol=1e-4))
        shape = (np.linalg.inv(MATRIX) @ np.column_stack([last.shape[:, :3], np.ones(len(last.shape))]).T)[
            :3
        ].T
        until(lambda: peer.last("NeedlePoints") and "held" in peer.last("NeedleError").string)
        np.testing.assert_allclose(peer.last("NeedlePoints").positions, shape, atol=1e-4)
        assert peer.last("NeedleError").string.endswith("no sample for 1.00 s")


@pytest.mark.parametrize("with_rig", [True, False])
def test_a_stop_of_a_peer_stops_the_rig_or_the_next_event(port, with_rig):
    rig = Rig()
    with opened(port) as bridge, connected(port) as peer:
        if with_rig:
            bridge.confirm(rig)
        peer.send_stop()
        until(lambda: any(one.startswith("stop: ") for one in listed(bridge)))
        for event in (Iterated("manipulation", {}), PeriodEnded(PERIODS[0])):
            with pytest.raises(StoppedError, match=r"^stopped: OpenIGTLink 127\.0\.0\.1:\d+$"):
                bridge(event)
        bridge(Ended(Insertion(PLAN, 0, (), Outcome.INTERRUPTED, "")))  # the record is complete
    assert len(rig.stops) == with_rig


def awaited(bridge):
    """A thread that waits for a target, and a list for the scenario with it."""
    found = []
    waiting = Thread(target=lambda: found.append(bridge.await_target()))
    waiting.start()
    until(lambda: listed(bridge) and bridge._awaited)
    return waiting, found


def test_a_target_waits_for_points_by_the_registration_of_the_peer(port):
    with opened(port, scenario=SPACE, awaits=True) as bridge, connected(port) as peer:
        waiting, found = awaited(bridge)
        peer.send_registration(np.array(MATRIX))
        peer.send_points(Lesion=(1.0, 1.0, 1.0))
        peer.send_points(Target=(900.0, -28.5, 7.0))  # out of reach
        peer.send_points(**{"Entry-1": (1.0, 1.5, -23.0), "Target-1": (1.0, -28.5, -23.0)})
        waiting.join(DEADLINE_S)
        peer.send_registration(np.eye(4))
        until(lambda: any("differs from [image]" in one for one in listed(bridge)))
    (scenario,) = found
    assert scenario.target.position == pytest.approx((30.0, -1.25, 7.0), abs=1e-9)
    assert (scenario.entry.lateral_mm, scenario.entry.lateral_z_mm) == pytest.approx((-1.25, 7.0), abs=1e-9)
    assert scenario.image == IN_IMAGE.image
    events = listed(bridge)
    assert any(one.endswith(": target 30, -1.25, 7 mm, entry 0, -1.25, 7 mm") for one in events)
    assert any("no point is named Target or Entry" in one for one in events)
    assert any("refused: target.lateral_mm = 897.75" in one for one in events)


def test_another_registration_than_the_scenarios_is_refused_in_one_line(port):
    shifted = np.array(MATRIX) + np.eye(4, k=3) * 9.0  # 9 mm along x
    with opened(port, scenario=IN_IMAGE, awaits=True) as bridge, connected(port) as peer:
        waiting, found = awaited(bridge)
        peer.send_registration(shifted)
        peer.send_points(Target=(1.0, -28.5, -23.0))
        waiting.join(DEADLINE_S)
    assert found[0].target.position == pytest.approx((30.0, -1.25, 7.0), abs=1e-9)
    assert found[0].image == IN_IMAGE.image
    (refusal,) = [one for one in listed(bridge) if "differs" in one]
    assert "refused: registration of the image: differs from [image] of the scenario by up to 9 mm" in refusal


def test_a_registration_that_is_not_awaited_is_refused(port):
    with opened(port, scenario=SPACE) as bridge, connected(port) as peer:
        peer.send_registration(np.array(MATRIX))
        until(lambda: any("registration of the image: not awaited" in one for one in listed(bridge)))


def test_a_connection_stays_open_for_further_insertions(port):
    stops, received = [], []
    with opened(port, forward=received.append) as bridge, connected(port) as peer:

        def ignored(number):
            return sum("ignored, there is no insertion" in one for one in listed(bridge)) == number

        peer.send_stop()
        until(lambda: ignored(1))
        peer.send_points(Target=(30.0, 1.0, 0.0))
        until(lambda: received)
        with bridge.insertion(SPACE, on_stop=stops.append):
            bridge(PeriodEnded(PERIODS[0]))
            peer.send_points(Target=(31.0, 1.0, 0.0))
            peer.send_stop()
            until(lambda: stops)
            assert any("ignored, no target is awaited" in one for one in listed(bridge))
        peer.send_stop()
        until(lambda: ignored(1))

        def taken():  # the node may not know yet that the insertion has ended
            peer.send_points(Target=(32.0, 1.0, 0.0))
            return len(received) > 1

        until(taken)
        with bridge.insertion(SPACE):
            bridge(PeriodEnded(PERIODS[0]))
            with pytest.raises(RunError), bridge.insertion(SPACE):
                raise RunError("refused")
        until(lambda: peer.last("NeedleError").string == "refused")
    assert len(stops) == 1
    assert [one.target for one in received[:2]] == [(30.0, 1.0, 0.0), (32.0, 1.0, 0.0)]


def test_a_peer_that_reads_nothing_delays_neither_the_insertion_nor_another_peer(port):
    with opened(port) as bridge, connected(port) as peer, socket.socket() as stalled:
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", port))
        await_peer(bridge, peer)
        number = 0
        for number in range(200):  # 4 MB, more than all buffers
            bridge(PeriodEnded(replace(PERIODS[0], estimate=Pose(float(number), 0.0, 0.0, 0.0, 0.0))))
            until(lambda: bridge._node._channel.waiting == 0)
        until(lambda: peer.last("NeedleTip") and peer.last("NeedleTip").matrix[0, 3] == number)
        assert bridge._node.dropped == 0


def test_garbage_is_noted_and_stops_nothing(port):
    with opened(port) as bridge:
        with socket.create_connection(("127.0.0.1", port)) as one:
            one.sendall(b"GET / HTTP/1.1\r\n" * 9)
            until(lambda: any("closed: header version" in line for line in listed(bridge)))
        bridge(PeriodEnded(PERIODS[0]))


def test_it_connects_to_a_server():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = IgtlAddress(port=server.getsockname()[1], connects=True)
        with IgtlBridge(IgtlSettings(address)), server.accept()[0] as one:
            assert one.recv(14)[2:].rstrip(b"\0") == b"STATUS"


def test_a_port_that_is_taken_is_one_line(port, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", port)):
        status, _, error = run(capsys, "insert", "phantom", "--igtl", str(port))
    assert (status, error) == (
        1,
        f"flexneedle: cannot listen on 127.0.0.1, port {port}: Address already in use\n",
    )


@pytest.mark.parametrize(
    ("options", "key"),
    [
        (("--igtl-target",), "--igtl-target: needs --igtl"),
        (("--igtl", "0", "--igtl-target", "--target", "35", "0"), "--target: not with --igtl-target"),
    ],
)
def test_options_that_contradict_each_other_are_refused(capsys, options, key):
    status, _, error = run(capsys, "insert", "phantom", *options)
    assert (status, error.startswith(f"flexneedle: {key}")) == (2, True), error


@pytest.mark.parametrize("awaits", [False, True])
def test_zones_in_files_are_in_the_needles_frame_until_a_registration_comes(awaits):
    zone = {"shape": "file", "name": "artery", "file": "artery.stl"}
    scenario = SPACE.with_values({"zone": [zone]})
    args = Namespace(image="case", load=lambda _: scenario, target=None, igtl_target=awaits)
    end = "until a registration comes" if awaits else "needle's frame"
    with pytest.warns(ScenarioWarning, match=f"{end}$"):
        choose_scenario(args)


# The command in a process


class Started:
    """An insertion of the command on the virtual phantom."""

    def __init__(self, folder, port, *options, scenario=None):
        self.out = folder / "out"
        command = [
            sys.executable,
            "-m",
            "flexneedle",
            "insert",
            str(scenario or quick_scenario(folder)),
            "--force",
        ]
        command += ["--igtl", str(port), "--out", str(self.out), *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def end(self):
        out, errors = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, errors

    @property
    def stored(self):
        return json.loads((self.out / "run.json").read_text())


@pytest.mark.long
def test_a_command_takes_its_target_and_sends_the_insertion_of_its_record(tmp_path, port):
    insertion = Started(tmp_path, port, "--igtl-target")
    with connected(port, PATIENCE_S) as peer:
        peer.send_registration(np.array(MATRIX))
        target = (np.linalg.inv(MATRIX) @ [6.0, 0.5, 0.0, 1.0])[:3]

        def planned():  # earlier points are ignored
            peer.send_points(Target=tuple(target))
            return peer.last("NeedleTip") is not None or insertion.process.poll() is not None

        until(planned, PATIENCE_S)
        until(lambda: peer.take() and insertion.process.poll() is not None, PATIENCE_S)
        status, _, errors = insertion.end()
        made = flexneedle.load(insertion.out)
        tip = (np.linalg.inv(MATRIX) @ [*made.periods[-1].estimate.point, 1.0])[:3]
        np.testing.assert_allclose(peer.last("NeedleTip").matrix[:3, 3], tip, atol=1e-4)
    assert status in (0, 1), errors
    aim = insertion.stored["scenario"]["target"]
    assert (aim["depth_mm"], aim["lateral_mm"]) == pytest.approx((6.0, 0.5), abs=1e-3)
    assert any("target 6, 0.5, 0 mm" in one["event"] for one in insertion.stored["timing"]["igtl"]["events"])


@pytest.mark.long
def test_a_stop_on_a_rig_stops_its_motors_beside_a_client_that_reads_nothing(tmp_path, port):
    """The rig's ticks and decisions are in time, though frames of the stalled client wait."""
    with (
        started(tmp_path, None, "--yes", "--igtl", str(port), on_rig=True) as insertion,
        connected(port, PATIENCE_S) as peer,
        socket.socket() as stalled,
    ):
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", port))
        insertion.await_that(lambda: peer.last("NeedleTip") is not None)
        until(lambda: any(where["A"] > 3000.0 for *_, where in insertion.calls("follow")))
        peer.send_stop()
        status, _, errors = insertion.end()
    assert status == 130
    assert "stopped: OpenIGTLink 127.0.0.1:" in errors[-2]
    stopped = insertion.stored["timing"]["ticks"]["states"][-1]
    assert stopped["state"] == "stopped"
    assert flexneedle.load(insertion.out).late == 0
