"""`flexneedle serve --rig` with an emulated rig in separate processes: an insertion from the page, and its ends."""

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from time import monotonic
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

import flexneedle
from emulated import until
from emulated_rig import emulated_rig, rig_file
from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.page.job_orders import SILENT_S
from flexneedle.lab.page.server.clients import RIG_LIMITS
from flexneedle.scenario.files import dump_scenario
from page_clients import PATIENCE_S, Client, port_of
from page_tasks import short

pytestmark = pytest.mark.long

PERIOD_S = 1.0
"""A control period with its decision, on a busy computer."""
RESTS_S = 0.5
"""From a stop of the supervisor until all motors rest: the queue, and a tick."""
LONGER = {"target.depth_mm": 20.0, "setup.insertion_speed_mm_s": 2.0}
"""Settings of an insertion with time to interrupt it."""


@dataclass
class Bench:
    """An emulated rig with a server of the page on it."""

    process: subprocess.Popen[str]
    page: SimpleNamespace
    truth: Path
    runs: Path

    @property
    def base(self):
        """Times (s, monotonic) and positions (mm) of the base."""
        truth = read_truth(self.truth)
        return truth.time, truth.positions["insertion"]

    def moved_after(self, time):
        """Return the distance (mm) by which the base has moved since a time."""
        times, places = self.base
        return float(np.ptp(places[times >= time])) if (times >= time).any() else 0.0

    def advanced(self, distance):
        """Wait until the base has advanced by a distance (mm)."""
        until(lambda: np.ptp(self.base[1]) > distance, PATIENCE_S)

    def visitor(self):
        """Return a client that receives messages while it is not read, as a browser does."""
        return Client(self.page, max_queue=None)

    def worker(self):
        """The process of the worker of insertions."""
        children = psutil.Process(self.process.pid).children()
        return next(one for one in children if one.cmdline()[-1] == "insertion")

    def run_file(self):
        """The record of the only run, completed."""
        (folder,) = self.runs.iterdir()
        until(lambda: (folder / "insertion.png").exists(), PATIENCE_S)
        return flexneedle.load(folder)

    def timing(self):
        """Times of the only run."""
        (folder,) = self.runs.iterdir()
        return json.loads((folder / "run.json").read_text())["timing"]


@contextmanager
def bench(folder, **changes):
    """Serve an emulated rig, and the page with it."""
    path, scenario, truth = rig_file(folder), folder / "case.toml", folder / "truth.csv"
    scenario.write_text(dump_scenario(short(**changes)))
    with emulated_rig(path, scenario, "--seed", 3, "--truth", truth) as rig:
        path.write_text(path.read_text().replace("127.0.0.1:0", rig.ready["ready"]["galil"]))
        command = [sys.executable, "-m", "flexneedle", "serve", str(scenario), "--rig", str(path)]
        options = ["--port", "0", "--no-open", "--runs", str(folder / "runs")]
        process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
        try:
            page = SimpleNamespace(address=process.stdout.readline().strip())
            yield Bench(process, page, truth, folder / "runs")
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.communicate(timeout=60.0)


def rig_is(client, state):
    client.wait(lambda: client.newest["rig"]["state"] == state)
    return client.newest["rig"]


def armed(client):
    client.do("arm", armed=True, job=client.newest["rig"]["job"])
    rig_is(client, "armed")


def inserting(client):
    """Prepare, arm, start."""
    client.do("prepare")
    rig_is(client, "ready")
    armed(client)
    client.do("go")
    rig_is(client, "inserting")


def test_an_insertion_from_check_to_target_with_a_hold_when_the_steering_client_is_lost(tmp_path):
    with bench(tmp_path, **LONGER) as one, one.visitor() as watcher:
        with one.visitor() as client:
            client.steer().do("check")
            client.job("check", "done")
            assert [line for line in client.newest["check"]["findings"] if line["problem"]] == []
            client.do("prepare")
            moves = rig_is(client, "ready")["moves"]
            assert moves[0].startswith(
                "Emulated rig: the needle will be inserted from its present position to a target 20 mm"
            )
            assert moves[1] == "insertion: at 0 mm, moves at most at 10 mm/s"
            assert client.refused("go") == "Emulated rig is not armed: arm it first"
            assert one.moved_after(0.0) == 0.0
            armed(client)
            assert one.moved_after(0.0) == 0.0
            client.do("go")
            rig_is(client, "inserting")
            one.advanced(3.0)
            for request, values in {"pace": {"pace": 0.0}, "advance": {}}.items():
                assert "is for virtual insertions" in client.refused(request, **values)
            assert "is for virtual insertions" in client.refused("disturb", what="push", size=0.1)
            lost = monotonic()
        held = rig_is(watcher, "holding")
        assert held["why"] == "nobody is in control: the connection was lost"
        Event().wait(1.0)
        assert one.moved_after(lost + PERIOD_S) < 0.005
        assert watcher.newest["rig"]["state"] == "holding"
        watcher.steer()
        assert watcher.refused("go") == "Emulated rig is not armed: arm it first"
        armed(watcher)
        watcher.do("go")
        watcher.job("insertion", "done")
        live = watcher.newest["insertion live"]
        assert live["state"] == "done", live["summary"]
        assert live["rig"] == "Emulated rig"
        assert rig_is(watcher, "idle")["job"] is None
        assert watcher.refused("go") == "Emulated rig is not armed: arm it first"
        recorded, timing = one.run_file(), one.timing()
        tip = read_truth(one.truth).tips[-1, :3]
    assert recorded.reached
    assert (recorded.rig, recorded.dry_run) == ("Emulated rig", False)
    assert len(recorded.periods) == live["periods"] == len(watcher.rows["live"])
    assert float(np.linalg.norm(tip - recorded.target)) < 0.5
    holds = [period for period in recorded.periods if period.decision == f"held: {held['why']}"]
    assert holds
    assert timing["ticks"]["count"] > 100


def withdrawing(client):
    client.do("retract")
    (move, _switched_on) = rig_is(client, "ready")["moves"]
    armed(client)
    client.do("go")
    rig_is(client, "retracting")
    return move


def test_the_needle_is_withdrawn_after_a_stop_and_the_retraction_is_stopped_and_repeated(tmp_path):
    with bench(tmp_path, **LONGER) as one, one.visitor() as client, one.visitor() as watcher:
        inserting(client.steer())
        one.advanced(6.0)
        client.do("stop")
        client.job("insertion", "done")
        rig_is(client, "stopped")
        deepest = one.base[1].max()
        assert withdrawing(client).startswith("insertion: from ")
        until(lambda: one.base[1][-1] < deepest - 2.0, PATIENCE_S)
        watcher.do("stop")
        client.job("retraction", "cancelled")
        assert rig_is(client, "stopped")["why"] == f"person {watcher.number} on the page"
        stopped = monotonic()
        Event().wait(RESTS_S + 0.5)
        assert one.moved_after(stopped + RESTS_S) < 0.005
        assert 1.0 < one.base[1][-1] < deepest - 1.0
        withdrawing(client)
        client.job("retraction", "done")
        assert rig_is(client, "idle")["why"].startswith("the needle was withdrawn to ")
        until(lambda: one.base[1][-1] < 0.5, PATIENCE_S)
        client.do("retract")
        assert "nothing to retract" in client.job("retraction", "failed")["text"]


@pytest.mark.slow
def test_a_steering_client_that_is_silent_is_lost(tmp_path):
    """Its computer has crashed or its line is cut: the connection stays open and silent."""
    with bench(tmp_path, **LONGER) as one, one.visitor() as watcher:
        client = Client(one.page, max_queue=1)
        client.wait(lambda: "rig" in client.newest)
        inserting(client.steer())
        silent = monotonic()  # from now on it reads nothing and answers no ping
        rig_is(watcher, "holding")
        limit = RIG_LIMITS.ping_s + RIG_LIMITS.pong_s + PERIOD_S
        Event().wait(max(0.0, silent + limit + 0.5 - monotonic()))
        assert one.moved_after(silent + limit) < 0.005
        watcher.do("stop")
        watcher.job("insertion", "done")
        client.socket.socket.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_without_its_server_the_rig_is_stopped(tmp_path, number):
    """Killed, or hanging: nobody could stop the rig any more."""
    with bench(tmp_path, **LONGER) as one, one.visitor() as client:
        inserting(client.steer())
        one.advanced(3.0)
        worker = one.worker()
        os.kill(one.process.pid, number)
        gone = monotonic()
        limit = RESTS_S if number == signal.SIGKILL else SILENT_S + 0.5 + RESTS_S
        Event().wait(limit + 0.5)
        assert one.moved_after(gone + limit) < 0.005
        recorded = one.run_file()
        assert str(recorded.outcome) == "interrupted"
        assert "the page" in recorded.reason
        if number == signal.SIGKILL:
            until(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)
        with suppress(OSError):  # closed already
            client.socket.socket.shutdown(socket.SHUT_RDWR)


@pytest.mark.slow
def test_without_its_worker_the_rig_is_stopped(tmp_path):
    with bench(tmp_path, **LONGER) as one, one.visitor() as client:
        inserting(client.steer())
        one.advanced(3.0)
        one.worker().kill()
        killed = monotonic()
        fault = rig_is(client, "fault")
        assert fault["why"].startswith("the worker has ended (exit status -9)")
        Event().wait(RESTS_S + 0.5)
        assert one.moved_after(killed + RESTS_S) < 0.005
        assert client.refused("go") == "Emulated rig is not armed: arm it first"
        assert port_of(one.page) > 0


@pytest.mark.slow
def test_at_the_end_of_the_server_the_record_is_completed(tmp_path):
    with bench(tmp_path, **LONGER) as one:
        with one.visitor() as client:
            inserting(client.steer())
            one.advanced(3.0)
            one.process.send_signal(signal.SIGINT)
            ended = monotonic()
            one.process.wait(60.0)
            client.socket.socket.close()
        assert one.moved_after(ended + RESTS_S) < 0.005
        assert one.run_file().reason == "stopped: the server of the page ends"
