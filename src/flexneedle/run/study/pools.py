"""Where a study runs: processes of this machine, or a Dask cluster; both are a `concurrent.futures.Executor`."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from flexneedle.errors import InputError
from flexneedle.run.study.worker import set_up

__all__ = ["cluster", "local", "usable_cores"]

_CONNECT_S = 20


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


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Give the workers of the Dask scheduler at `address` (`tcp://host:8786`).

    Its tasks are not pure: each is carried out, also where two look the same. Raises InputError if the extra
    `cluster` is not installed or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'flexneedle[cluster]'") from None
    try:
        connect: Any = Client  # not typed
        client = connect(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no Dask scheduler answers: {str(error).splitlines()[0]}") from None
    with client:
        yield client.get_executor(pure=False)
