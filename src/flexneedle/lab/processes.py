"""Processes that belong to a rig: their end, and what they printed last."""

import os
import subprocess
from typing import IO

_LONGEST = 4096  # bytes of a last line


def end_process(process: subprocess.Popen[bytes], seconds: float) -> None:
    """Wait until a process that was asked to end has ended; kill it after `seconds`."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def last_line(printed: IO[bytes]) -> str:
    """The last line in a file that a process has written, "" without one."""
    printed.seek(max(0, printed.seek(0, os.SEEK_END) - _LONGEST))
    lines = printed.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""
