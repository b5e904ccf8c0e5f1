"""Real-time priority of a process, and of its threads."""

import os
from contextlib import suppress


def set_realtime_priority() -> None:
    """Give this process real-time priority where the system permits it (Linux, as root or with an rtprio limit).

    Only for a process that mostly waits: it runs ahead of all others and could block the machine.
    """
    if hasattr(os, "sched_setscheduler"):
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def set_normal_priority() -> None:
    """Give this thread, and the processes that it starts, no more than the normal priority."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
