"""Being served in time by a busy machine."""

import os
from contextlib import suppress


def come_first() -> None:
    """Let this process run as soon as it has something to do, where the system has that and allows it (Linux, root or
    an rtprio limit). For one that needs little and mostly waits: ahead of all others, it could stop the machine."""
    if hasattr(os, "sched_setscheduler"):
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
