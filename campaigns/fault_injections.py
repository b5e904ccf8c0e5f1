"""Injection of faults into a trial: preparation of the insertion, and the injection at its time."""

import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from signal import SIGKILL, Signals
from time import monotonic, time
from typing import Protocol

import psutil

from rig_trials import EmulatedRig

_DISK = "size=8m"
_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

/* The computer's clock, shifted by the seconds in the file that CLOCK_SHIFT names; the monotonic one is unchanged. */
static long shift(void) {
    long seconds = 0;
    FILE *file = fopen(getenv("CLOCK_SHIFT"), "r");
    if (file) { if (fscanf(file, "%ld", &seconds) != 1) seconds = 0; fclose(file); }
    return seconds;
}
int clock_gettime(clockid_t id, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(id, now);
    if (id == CLOCK_REALTIME) now->tv_sec += shift();
    return code;
}
int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec at;
    (void)zone;
    int code = clock_gettime(CLOCK_REALTIME, &at);
    now->tv_sec = at.tv_sec;
    now->tv_usec = at.tv_nsec / 1000;
    return code;
}
time_t time(time_t *now) {
    struct timespec at;
    clock_gettime(CLOCK_REALTIME, &at);
    if (now) *now = at.tv_sec;
    return at.tv_sec;
}
"""
_PROBE, _MOST_OFF_S = "import time; print(time.time())", 60.0
_CHANNELS = {"insertion": "A", "rotation": "B", "guide_y": "C"}  # of the shipped rig file


@dataclass(frozen=True)
class Setting:
    """Folder of the insertion's record, and variables of its environment."""

    record: Path
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Running:
    """A running trial: its rig, its folder, the axis that becomes faulty, the controller and what it has started."""

    rig: EmulatedRig
    folder: Path
    axis: str
    controller: psutil.Process
    others: tuple[psutil.Process, ...]

    @property
    def supervisor(self) -> psutil.Process:
        """The process of the supervisor."""
        for one in self.others:
            if any("supervisor.process" in part for part in one.cmdline()):
                return one
        raise RuntimeError("the insertion has no supervisor")


class Injection(Protocol):
    """A way in which a fault is injected."""

    def prepare(self, folder: Path, stack: ExitStack) -> Setting:
        """Prepare the folder of a trial before its insertion; what has to be undone is left to the stack."""
        ...

    def inject(self, trial: Running) -> float:
        """Inject the fault; return when it took effect (s, monotonic)."""
        ...


class _Plain:
    """An injection that needs no preparation."""

    def prepare(self, folder: Path, _stack: ExitStack) -> Setting:
        """Return the setting of a record in the folder."""
        return Setting(folder / "run")


class Nothing(_Plain):
    """Nothing: the controller itself is the fault."""

    def inject(self, _trial: Running) -> float:
        """Return the present time: the fault begins without an injection."""
        return monotonic()


@dataclass(frozen=True)
class Device(_Plain):
    """A fault of an emulated device, with {channel} for the channel of the faulty axis."""

    order: str

    def inject(self, trial: Running) -> float:
        """Order the fault."""
        return trial.rig.fault(self.order.format(channel=_CHANNELS[trial.axis]))


class Kill(_Plain):
    """Processes that are killed: controller, supervisor."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def inject(self, trial: Running) -> float:
        """Kill the processes."""
        processes = {"controller": trial.controller, "supervisor": trial.supervisor}
        now = monotonic()
        for name in self.names:
            processes[name].send_signal(SIGKILL)
        return now


@dataclass(frozen=True)
class Signal(_Plain):
    """A signal to the controller, or to all of its processes, as Ctrl-C at the terminal."""

    number: Signals
    group: bool = False

    def inject(self, trial: Running) -> float:
        """Send the signal."""
        now = monotonic()
        (os.killpg if self.group else os.kill)(trial.controller.pid, self.number)
        return now


class Disk:
    """The file system of the record becomes full."""

    def prepare(self, folder: Path, stack: ExitStack) -> Setting:
        """Mount a small file system for the record alone."""
        disk = folder / "disk"
        disk.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", _DISK, "tmpfs", str(disk)], check=True)
        stack.callback(subprocess.run, ["umount", "-l", str(disk)])
        return Setting(disk / "run")

    def inject(self, trial: Running) -> float:
        """Fill the file system."""
        now = monotonic()
        try:
            with (trial.folder / "disk" / "filler").open("wb", buffering=0) as file:
                while True:
                    file.write(b"0" * 4096)
        except OSError:
            return now


@dataclass(frozen=True)
class Clock:
    """The computer's clock is stepped by some seconds, for the insertion's processes."""

    seconds: int

    def prepare(self, folder: Path, _stack: ExitStack) -> Setting:
        """Build a library with the shifted clock. Raises RuntimeError if a process with it has the usual time."""
        source, library, shift = folder / "clock.c", folder / "clock.so", folder / "shift"
        source.write_text(_CLOCK)
        subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        environment = {"LD_PRELOAD": str(library), "CLOCK_SHIFT": str(shift)}
        shift.write_text(f"{self.seconds}\n")
        probe = [sys.executable, "-c", _PROBE]
        found = subprocess.run(probe, env=os.environ | environment, stdout=subprocess.PIPE, check=True)
        if abs(float(found.stdout) - time() - self.seconds) > _MOST_OFF_S:
            raise RuntimeError("the clock cannot be stepped")
        shift.write_text("0\n")
        return Setting(folder / "run", environment)

    def inject(self, trial: Running) -> float:
        """Step the clock. Raises RuntimeError if a process of the insertion has the usual clock."""
        for process in (trial.controller, trial.supervisor):
            if "clock.so" not in Path(f"/proc/{process.pid}/maps").read_text():
                raise RuntimeError(f"process {process.pid} has the usual clock")
        now = monotonic()
        (trial.folder / "shift").write_text(f"{self.seconds}\n")
        return now
