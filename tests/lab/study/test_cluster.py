"""A study on a real Dask scheduler with two workers, one of which is killed during the study."""

import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from threading import Timer

import pyarrow.parquet as pq
import pytest

from flexneedle.errors import InputError, RunError
from flexneedle.lab.study import pools
from flexneedle.lab.study.provenance import StudyCode
from flexneedle.lab.study.runner import run_study
from flexneedle.record.folder import versions

CODE = StudyCode(versions(), {})

distributed = pytest.importorskip("distributed")


@contextmanager
def process(part, *argv, folder=None):
    """Run a Dask scheduler or worker in a separate process (default: in this folder), with its log on stderr."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{part}", *argv, "--no-dashboard"]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder)
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


@contextmanager
def scheduler():
    """Run a scheduler and yield its address. It is killed after two minutes, which ends all waiting clients."""
    with process("scheduler", "--host", "127.0.0.1", "--port", "0") as running:
        watchdog = Timer(120, running.kill)
        watchdog.start()
        try:
            yield next(line for line in running.stderr if "Scheduler at:" in line).split("at:")[1].strip()
        finally:
            watchdog.cancel()


def worker(address, folder=None):
    """Run a worker with one thread that is not restarted."""
    options = ("--nthreads", "1", "--no-nanny", "--death-timeout", "60")
    return process("worker", address, *options, folder=folder)


@pytest.mark.slow
def test_a_killed_worker_loses_no_row_and_repeats_none(quick, uninterrupted, tmp_path):
    counts = []
    with scheduler() as address, worker(address) as first, worker(address) as second:
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)

        def kill_one(advance):
            counts.append(advance.insertions)
            if advance.insertions == 3 and first.poll() is None:
                first.kill()

        out = run_study(quick, tmp_path / "a", scheduler=address, on_advance=kill_one)
        assert first.wait(timeout=30) == -signal.SIGKILL
        assert second.poll() is None
    assert counts[-1] == 16
    assert (out / "runs.parquet").read_bytes() == (uninterrupted / "runs.parquet").read_bytes()
    assert len((out / "journal.jsonl").read_text().splitlines()) == 16
    assert len(pq.read_table(out / "timing.parquet")) == 16


def test_only_a_scheduler_without_workers_is_reported():
    calls = []
    with scheduler() as address:
        with pools.open_cluster(address, CODE, lambda: calls.append("none")):
            assert calls == ["none"]
        with worker(address), distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=30)
            with pools.open_cluster(address, CODE, lambda: calls.append("none")):
                assert calls == ["none"]


CONTROLLER = """
from dataclasses import replace
from flexneedle.control.controllers import CONTROLLERS
from mine_gains import GAIN

MINE = replace(CONTROLLERS["open-loop"], name="mine")
"""
STUDY = """
name = "mine"
repeats = 3
[values]
controller = "mine_pid:MINE"
plan = { samples = 16, iterations = 2 }
setup.tip_to_skin_mm = 4.0
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }
target = [8, 0.5]
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a function that makes a folder with a study of an own controller, whose module imports a gain."""

    def make(name, gain):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        (folder / "mine_pid.py").write_text(CONTROLLER)
        (folder / "mine_gains.py").write_text(f"GAIN = {gain}\n")
        (folder / "mine.toml").write_text(STUDY)
        return folder

    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(make("here", 1.0))
    yield make
    for name in ("mine_pid", "mine_gains"):
        sys.modules.pop(name, None)


DIFFERENT = r"module mine_pid: mine_gains\.py is [0-9a-f]{12} there, [0-9a-f]{12} here: give the worker"


def test_a_worker_with_another_version_of_a_module_is_refused_before_the_first_row(own):
    """With its address, although another worker has the same version; no folder is created."""
    with scheduler() as address, worker(address, own("same", 1.0)), worker(address, own("there", 2.0)):
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)
        with pytest.raises(InputError, match=f"^worker tcp://127.0.0.1:[0-9]+: {DIFFERENT}"):
            run_study("mine.toml", "out", scheduler=address)
    assert not (Path.cwd() / "out").exists()


@pytest.mark.slow
def test_a_worker_with_another_version_that_joins_late_or_keeps_an_old_one_computes_no_row(own):
    """The first study of a worker loads the module; after an edit both its memory and the files are compared."""
    there, here = own("there", 2.0), Path.cwd()
    with scheduler() as address:
        joined = []

        def join():
            joined.append(worker(address, there))
            joined[-1].__enter__()

        try:
            with pytest.raises(RunError, match=f"^worker tcp://127.0.0.1:[0-9]+: {DIFFERENT}"):
                run_study("mine.toml", "late", scheduler=address, on_advance=lambda _: joined or join())
        finally:
            joined[0].__exit__(None, None, None)
        assert len(pq.read_table(here / "late" / "runs.parquet")) == 0
        own("there", 1.0)
        with worker(address, there), distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=30)
            run_study("mine.toml", "good", scheduler=address)
            own("there", 3.0)
            own("here", 3.0)
            for name in ("mine_pid", "mine_gains"):
                del sys.modules[name]
            with pytest.raises(InputError, match=DIFFERENT):
                run_study("mine.toml", "old", scheduler=address)
    assert len(pq.read_table(here / "good" / "runs.parquet")) == 3


def refusal(quick, tmp_path, address):
    """Return the message about an address; no folder is created."""
    with pytest.raises(InputError) as caught:
        run_study(quick, tmp_path / "a", scheduler=address)
    assert not (tmp_path / "a").exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


INVALID = (
    "",
    "foo:bar",
    "tcp://host",
    "tcp://:8786",
    "tcp://host:0",
    "tcp://host:65536",
    "tcp://host:8786/x",
)
INVALID += ("tcp://a b:1", "tcp://host:1\n", "tcp://host:٣", "http://localhost:1", "127.0.0.1:8786")


def test_an_invalid_address_is_rejected_before_dask_is_needed(quick, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for address in INVALID:
        assert refusal(quick, tmp_path, address).startswith("--scheduler = "), address
    for address in ("tcp://127.0.0.1:1", "tls://login-1.cluster:8786", "ws://[::1]:65535"):
        assert "pip install 'flexneedle[cluster]'" in refusal(quick, tmp_path, address), address


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:9", "tcp://127.0.0.1:9: no Dask scheduler responds: "),
        ("tls://127.0.0.1:9", "tls://127.0.0.1:9: needs a certificate: set distributed.comm.tls"),
    ],
)
def test_a_scheduler_that_cannot_be_reached_is_refused(quick, tmp_path, monkeypatch, address, message):
    monkeypatch.setattr(pools, "_CONNECT_S", 0.2)
    assert refusal(quick, tmp_path, address).startswith(message)
