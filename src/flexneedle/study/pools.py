"""Where a study runs: processes of this machine, or a Dask cluster; both are a `concurrent.futures.Executor`."""

import multiprocessing
import os
import re
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, cast

from flexneedle.errors import InputError
from flexneedle.scenario.problems import Problem, printable, to_line
from flexneedle.study.worker import set_up

_CONNECT_S = 20
_LAST_PORT = 65535
_ADDRESS = re.compile(r"(tcp|tls|ws|wss)://(\[[0-9A-Fa-f:.]+\]|[^\s/:@?#\[\]]+):(?P<port>[0-9]{1,5})")


def usable_cores() -> int:
    """Return how many cores the process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local(workers: int | None = None) -> Iterator[Executor]:
    """Give a pool of worker processes (default: one for each usable core)."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or usable_cores(), context, set_up) as pool:
        with _without_ctrl_c():
            pool.submit(int)  # starts the processes
        yield pool


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Put off Ctrl-C, also in the processes that start meanwhile, until they have set themselves up."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def check_address(address: str) -> None:
    """Raise InputError unless this can be the address of a Dask scheduler."""
    found = _ADDRESS.fullmatch(address)
    if found is None or not 1 <= int(found["port"]) <= _LAST_PORT:
        rule = "must be protocol://host:port, such as tcp://host:8786; protocols: tcp, tls, ws, wss"
        raise InputError(to_line(Problem("--scheduler", address, rule)))


@contextmanager
def cluster(address: str, on_no_workers: Callable[[], None] = lambda: None) -> Iterator[Executor]:
    """Give the workers of the Dask scheduler at `address` (`tcp://host:8786`).

    Its tasks are not pure: each is carried out, also where two look the same. `on_no_workers` is called if it has
    none yet; tasks wait for them. Raises InputError for an address that cannot be one, or if the extra `cluster`
    is not installed or no scheduler answers.
    """
    check_address(address)
    with _client(address) as client:
        if not client.nthreads():
            on_no_workers()
        yield client.get_executor(pure=False)


def _client(address: str) -> Any:
    try:
        from distributed import Client, Security
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'flexneedle[cluster]'") from None
    connect, secure = cast("Any", Client), cast("Any", Security)  # not typed
    security = secure()
    # Asked here, as a client that fails for it takes long to close and says so on stderr.
    if address.startswith("tls:") and security.get_connection_args("client")["ssl_context"] is None:
        raise InputError(f"{address}: needs a certificate: set distributed.comm.tls in Dask's configuration")
    try:
        return connect(address, timeout=_CONNECT_S, security=security, set_as_default=False)
    except Exception as error:  # noqa: BLE001  Dask raises what it trips over in the answer of any server
        message = " ".join(str(error).split()) or type(error).__name__
        raise InputError(printable(f"{address}: no Dask scheduler answers: {message}")) from None
