"""Real-time priority of a process, and of its threads."""

import os
from contextlib import suppress
from pathlib import Path

_THREADS = Path("/proc/self/task")


def set_realtime_priority() -> None:
    """Give all threads of this process real-time priority where the system permits it.

    On Linux that is as root or with an rtprio limit; threads that are started later have it, too. It is set for all
    threads, since one that is preempted while it holds Python's lock delays the others. Only for a process that
    mostly waits: it has priority over all others and could block the machine.
    """
    if not hasattr(os, "sched_setscheduler"):
        return
    for thread in _THREADS.iterdir():
        with suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))


def set_normal_priority() -> None:
    """Give this thread, and the processes that it starts, no more than the normal priority."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
