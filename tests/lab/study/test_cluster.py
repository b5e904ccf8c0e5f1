"""A study on a real Dask scheduler with two workers, one of which is killed during the study."""

import signal
import subprocess
import sys
from contextlib import contextmanager
from threading import Timer

import pyarrow.parquet as pq
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.study import pools
from flexneedle.lab.study.runner import run_study

distributed = pytest.importorskip("distributed")


@contextmanager
def process(part, *argv):
    """Run a Dask scheduler or worker in a separate process, with its log on stderr."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{part}", *argv, "--no-dashboard"]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
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


def worker(address):
    """Run a worker with one thread that is not restarted."""
    return process("worker", address, "--nthreads", "1", "--no-nanny", "--death-timeout", "60")


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
        with pools.open_cluster(address, lambda: calls.append("none")):
            assert calls == ["none"]
        with worker(address), distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=30)
            with pools.open_cluster(address, lambda: calls.append("none")):
                assert calls == ["none"]


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
