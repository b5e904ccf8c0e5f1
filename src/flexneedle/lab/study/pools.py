"""Executors of a study: local processes or a Dask cluster, both as `concurrent.futures.Executor`."""

import multiprocessing
import re
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, cast

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError, describe_error
from flexneedle.lab.study.provenance import REMEDY, StudyCode, find_difference
from flexneedle.lab.study.worker import set_up_worker
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.simulator.batch import count_cores

_CONNECT_S = 20
_LAST_PORT = 65535
_ADDRESS = re.compile(r"(tcp|tls|ws|wss)://(\[[0-9A-Fa-f:.]+\]|[^\s/:@?#\[\]]+):(?P<port>[0-9]{1,5})")


@contextmanager
def open_processes(workers: int | None = None) -> Iterator[Executor]:
    """Yield a pool of worker processes (default: one per usable core)."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or count_cores(), context, set_up_worker) as pool:
        with _defer_ctrl_c():
            pool.submit(int)  # starts the processes
        yield pool


@contextmanager
def _defer_ctrl_c() -> Iterator[None]:
    """Defer Ctrl-C, also in the processes that start in the meantime, until they are set up."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def check_address(address: str) -> None:
    """Raise InputError unless this is a valid address of a Dask scheduler."""
    found = _ADDRESS.fullmatch(address)
    if found is None or not 1 <= int(found["port"]) <= _LAST_PORT:
        rule = "must be protocol://host:port, such as tcp://host:8786; protocols: tcp, tls, ws, wss"
        raise InputError(to_line(Problem("--scheduler", address, rule)))


@contextmanager
def open_cluster(
    address: str, code: StudyCode, on_no_workers: Callable[[], None] = lambda: None
) -> Iterator[Executor]:
    """Yield the workers of the Dask scheduler at `address` (`tcp://host:8786`) as an executor.

    Tasks are submitted as impure, so that equal tasks are all executed. `on_no_workers` is called if there are no
    workers yet; tasks wait for them. Raises InputError for an invalid address, if the extra `cluster` is not
    installed, if no scheduler responds, or if a worker has other code.
    """
    check_address(address)
    with _connect(address) as client:
        if not client.nthreads():
            on_no_workers()
        _check_workers(client, code)
        yield client.get_executor(pure=False)


def _check_workers(client: Any, code: StudyCode) -> None:
    """Raise InputError, with the first difference, if a worker has other code than this process."""
    found = client.run(find_difference, code, on_error="return")
    differing = {address: problem for address, problem in found.items() if problem}
    for address, problem in differing.items():
        if isinstance(problem, Exception):
            problem = f"its flexneedle cannot be compared ({describe_error(problem)}): {REMEDY}"
        others = f" ({len(differing)} of {len(found)} workers)" if len(differing) > 1 else ""
        raise InputError(f"worker {address}: {problem}{others}")


def _connect(address: str) -> Any:
    require_extra("cluster", "distributed")
    from distributed import Client, Security

    connect, secure = cast("Any", Client), cast("Any", Security)  # not typed
    security = secure()
    # Checked here: a client that fails for this reason closes slowly and prints to stderr.
    if address.startswith("tls:") and security.get_connection_args("client")["ssl_context"] is None:
        raise InputError(f"{address}: needs a certificate: set distributed.comm.tls in Dask's configuration")
    try:
        return connect(address, timeout=_CONNECT_S, security=security, set_as_default=False)
    except Exception as error:  # noqa: BLE001  Dask raises many types for the response of another server
        raise InputError(f"{address}: no Dask scheduler responds: {describe_error(error)}") from None
