"""Faults injected into a running rig: what happens, how soon, and how far the needle moves after that.

python studies/rig_faults.py [--timings 20] [--out runs/rig-faults] [--only stall,unplugged] [--workers 2]

Each trial has an emulated rig of its own (controller, tracker and phantom in three processes) and an insertion on it.
At a random time of the insertion a fault is injected. The record of the rig's states gives the time to detection, the
true positions how far the base moved after it, and whether the needle rests at the end. Trials are appended to
OUT/trials.jsonl as they end, and not repeated: the study can be interrupted. It prints the table of docs/safety.md.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from zlib import crc32

import numpy as np
from rig_trials import EmulatedRig, emulated_rig, ended, insertion, moved_after, rests

from flexneedle.rig.emulator.coupled.truth import Truth

_MOTION_MM = 0.5  # the most that the base may move after detection
_EARLIEST_S, _LATEST_S = 1.0, 13.0  # after the first motion, while the needle is driven
_STATES = ("holding", "stopped", "fault")
_END = "the controller"  # who stops the motors at the end of an insertion
_PAUSE_S = 0.02  # of the base between two motions; within one it is somewhere else after 4 ms
_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

/* The computer's clock, shifted by the seconds in the file that CLOCK_SHIFT names; the monotonic one as it is. */
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
_SLOW = '''"""The default controller, one of whose decisions takes long."""

import time

from flexneedle.control.methods import METHODS
from dataclasses import replace

_DEFAULT, _count = METHODS["adaptive-mpc"], iter(range(10**6))


def _decide(task, memory, estimate, rng):
    if next(_count) == {step}:
        print("deciding", time.monotonic(), file=open("deciding", "w"))
        time.sleep({seconds})
    return _DEFAULT.decide(task, memory, estimate, rng)


LATE = replace(_DEFAULT, name="late", decide=_decide)
'''


@dataclass(frozen=True)
class Trial:
    """A running trial: rig, insertion, its folder, and randomness."""

    rig: EmulatedRig
    process: subprocess.Popen[bytes]
    folder: Path
    rng: np.random.Generator


Inject = Callable[[Trial], float]
"""Injects a fault; returns when it took effect (s, monotonic)."""


@dataclass(frozen=True)
class Fault:
    """A fault of the table. reaction: the required one; within: time to detection (s), None where none is required;
    outcomes: that the insertion may have. controller: how long which of its decisions takes, where that is the fault;
    since_motion: whether the time to detection counts from the beginning of the motion in which the fault shows.
    """

    group: str
    name: str
    inject: Inject
    reaction: str
    within: float | None
    outcomes: tuple[str, ...]
    controller: tuple[float, int] | None = None
    since_motion: bool = False

    @property
    def unnoticed(self) -> bool:
        """Whether the insertion must go on without a hold or stop."""
        return self.reaction in ("continue", "rest until it is there")

    def detection_s(self, trial: Mapping[str, Any]) -> float | None:
        """Time to detection in a trial; None without one, and where an older trial has not recorded it."""
        found: float | None = trial.get("from_motion_s" if self.since_motion else "detection_s")
        return found

    def timely(self, trial: Mapping[str, Any]) -> bool:
        """Whether it was detected in time. What shows only in a motion may not come about before the end."""
        seconds = self.detection_s(trial)
        if self.since_motion and seconds is None:
            return trial["outcome"] == "done" or "from_motion_s" not in trial
        return self.within is None or (seconds is not None and seconds <= self.within)


def order(text: str) -> Inject:
    """A fault of a device."""
    return lambda trial: trial.rig.fault(text)


def killed(*which: str) -> Inject:
    """Processes killed: controller, supervisor."""

    def inject(trial: Trial) -> float:
        supervisor = _supervisor(trial.process.pid)
        now = monotonic()
        for name in which:
            os.kill(trial.process.pid if name == "controller" else supervisor, signal.SIGKILL)
        return now

    return inject


def signalled(number: signal.Signals, group: bool) -> Inject:
    """A signal to the controller, or to all of its processes, as Ctrl-C at the terminal."""

    def inject(trial: Trial) -> float:
        now = monotonic()
        (os.killpg if group else os.kill)(trial.process.pid, number)
        return now

    return inject


def full_disk(trial: Trial) -> float:
    """The file system of the record becomes full."""
    now = monotonic()
    try:
        with (trial.folder / "disk" / "filler").open("wb", buffering=0) as file:
            while True:
                file.write(b"0" * 4096)
    except OSError:
        return now


def stepped_clock(trial: Trial) -> float:
    """The computer's clock is set back by an hour."""
    now = monotonic()
    (trial.folder / "offset").write_text("-3600\n")
    return now


def late_decision(trial: Trial) -> float:
    """The controller reports when it began to decide slowly."""
    marker = trial.folder / "deciding"
    while not marker.exists() or not marker.read_text().strip():
        sleep(0.01)
    return float(marker.read_text().split()[1])


def _supervisor(controller: int) -> int:
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
            command = (path.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(fields[1]) == controller and b"supervisor.process" in command:
            return int(path.parent.name)
    raise RuntimeError("no supervisor")


def _faults() -> list[Fault]:
    held = ("held",)
    failed = ("failed",)
    interrupted = ("interrupted",)
    tracker = partial(Fault, "tracker")
    motors = partial(Fault, "motors")
    computer = partial(Fault, "computer")
    return [
        # As long as monitor.lost_after_s: it may or may not be a hold.
        tracker(
            "missing for 0.1 s", order("aurora:missing:0.1"), "continue, or hold briefly", None, ("done",)
        ),
        tracker("missing for 0.5 s", order("aurora:missing:0.5"), "hold, then continue", 0.25, ("done",)),
        tracker("missing for 2 s", order("aurora:missing:2"), "hold, end held", 0.25, held),
        tracker("frozen: no new frames", order("aurora:frozen"), "hold, end held", 0.45, held),
        tracker("frozen: values repeat", order("aurora:stuck"), "hold, end held", 0.6, held),
        tracker("not a number", order("aurora:nan"), "hold, end held", 0.25, held),
        tracker("jump of 5 mm", order("aurora:jump=5"), "hold, end held", 0.15, held),
        tracker("garbled", order("aurora:garbled"), "hold, end held", 0.45, held),
        tracker("unplugged", order("aurora:unplug"), "hold, end held", 0.45, held),
        tracker("indicator high", order("aurora:indicator=0.2"), "hold, end held", 0.9, held),
        tracker("0.5 s late", order("aurora:delay=0.5"), "hold, end held", 0.6, held),
        motors("stall", order("galil:stall=A"), "fault", 0.4, failed),
        # It shows in motions faster than max_error / lag = 1.3 mm/s: at worst after a rest and a slow step.
        motors("lag of 0.15 s", order("galil:lag=A"), "fault", 1.0, failed),
        motors("overshoot by a fifth", order("galil:overshoot=A"), "fault", 1.2, failed),
        motors("limit switch", order("galil:limit=A"), "fault", 0.4, failed),
        motors("? in reply", order("galil:refuse"), "fault", 0.1, failed),
        motors("connection lost", order("galil:unplug"), "fault", 0.1, failed),
        motors("connection half open", order("galil:half-open"), "fault", 0.25, failed),
        motors("no replies", order("galil:silence"), "fault", 0.25, failed),
        motors("garbled replies", order("galil:garbled"), "fault", 0.25, failed),
        motors("wrong direction", order("galil:reversed=A"), "fault", 0.4, failed),
        motors("position reset", order("galil:reset=A"), "fault", 0.1, failed),
        motors("motor off", order("galil:off=A"), "fault", 0.1, failed),
        motors("guide stalls", order("galil:stall=C"), "fault", 0.9, ("failed", "done"), since_motion=True),
        computer("decision of 0.5 s", late_decision, "rest until it is there", None, ("done",), (0.5, 0)),
        computer("decision of 5 s", late_decision, "stop", 2.3, interrupted, (5.0, 0)),
        computer("controller killed", killed("controller"), "stop", None, ("running",)),
        computer("supervisor killed", killed("supervisor"), "motors stop by themselves", None, failed),
        computer(
            "both killed", killed("supervisor", "controller"), "motors stop by themselves", None, ("running",)
        ),
        computer("controller stopped (SIGSTOP)", signalled(signal.SIGSTOP, False), "stop", 2.3, interrupted),
        # Found by the controller when it writes a period, which lasts longer while other programs use the processor.
        computer("disk full", full_disk, "end held", 1.0, held),
        computer("clock set back by 1 h", stepped_clock, "continue", None, ("done",)),
        computer("Ctrl-C", signalled(signal.SIGINT, True), "stop", 0.1, interrupted),
        computer("SIGTERM", signalled(signal.SIGTERM, True), "stop", 0.1, ("interrupted", "running")),
    ]


def run_trial(fault: Fault, timing: int, keep: Path | None = None) -> dict[str, Any]:
    """Run one trial; return its result as plain values. keep: folder for the records of the insertions."""
    seed = crc32(f"{fault.group} {fault.name} {timing}".encode())
    rng = np.random.default_rng(seed)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="faults-")))
        out = _record_folder(fault, folder, stack)
        options, environment = _options(fault, folder, rng)
        rig = stack.enter_context(emulated_rig(folder, "phantom", seed % 1000))
        process = insertion(
            rig.rig, "phantom", out, "--seed", str(seed % 1000), *options, environment=environment, cwd=folder
        )
        begun = rig.first_motion()
        sleep(float(rng.uniform(_EARLIEST_S, _LATEST_S)) - (monotonic() - begun))
        injected = fault.inject(Trial(rig, process, folder, rng))
        _await_end(fault, process, injected)
        status, printed, errors = ended(process, 5.0)
        sleep(1.0)
        if keep is not None and out.exists():
            shutil.copytree(
                out, keep / f"{fault.group}-{fault.name}-{timing}".replace(" ", "-"), dirs_exist_ok=True
            )
        return _judged(fault, timing, rig.read_truth(), injected, _recorded(out, printed), status, errors)


def _record_folder(fault: Fault, folder: Path, stack: ExitStack) -> Path:
    """Folder of the record, on a small file system of its own where it is to become full."""
    if fault.inject is not full_disk:
        return folder / "run"
    disk = folder / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)], check=True)
    stack.callback(subprocess.run, ["umount", "-l", str(disk)])
    return disk / "run"


def _options(fault: Fault, folder: Path, rng: np.random.Generator) -> tuple[list[str], dict[str, str]]:
    """Options and environment of the insertion."""
    if fault.controller is not None:
        text = _SLOW.replace("{seconds}", str(fault.controller[0]))
        (folder / "slow.py").write_text(text.replace("{step}", str(rng.integers(5, 60))))
        return ["--controller", "slow:LATE"], {}
    if fault.inject is stepped_clock:
        (folder / "offset").write_text("0\n")
        (folder / "clock.c").write_text(_CLOCK)
        library = str(folder / "clock.so")
        subprocess.run(["cc", "-shared", "-fPIC", "-o", library, folder / "clock.c", "-ldl"], check=True)
        return [], {"LD_PRELOAD": library, "CLOCK_SHIFT": str(folder / "offset")}
    return [], {}


def _await_end(fault: Fault, process: subprocess.Popen[bytes], injected: float) -> None:
    """Wait until the insertion ends; one that is stopped by a signal is ended once it must have been detected."""
    if fault.name.startswith("controller stopped"):
        sleep(max(0.0, injected + 4.0 - monotonic()))
        os.kill(process.pid, signal.SIGCONT)
    deadline = monotonic() + 60.0
    while process.poll() is None and monotonic() < deadline:
        sleep(0.05)


def _recorded(out: Path, printed: str) -> Mapping[str, Any]:
    """What the insertion has recorded in its folder, or printed where that could not be written."""
    file = out / "run.json"
    run: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    if run.get("status") == "running" and printed.startswith("{"):
        result = json.loads(printed)
        run |= {"status": result["outcome"], "reason": result["reason"], "timing": result["timing"]}
    return run


def _judged(
    fault: Fault,
    timing: int,
    truth: Truth,
    injected: float,
    run: Mapping[str, Any],
    status: int,
    errors: str,
) -> dict[str, Any]:
    ticks = (run.get("timing") or {}).get("ticks") or {}
    detected = next(
        (
            one
            for one in ticks.get("states", ())
            if one["state"] in _STATES
            and (
                one["why"] != _END or fault.inject is full_disk
            )  # it is the controller that finds the disk full
            and one["time_s"] >= injected - 1e-3
        ),
        None,
    )
    return {
        "group": fault.group,
        "fault": fault.name,
        "timing": timing,
        "status": status,
        "outcome": run.get("status", "none"),
        "reason": run.get("reason", ""),
        "state": None if detected is None else detected["state"],
        "why": None if detected is None else detected["why"],
        "detection_s": None if detected is None else detected["time_s"] - injected,
        "from_motion_s": None if detected is None else _from_motion(truth, detected["time_s"]),
        "motion_mm": _motion(fault, truth, injected, detected),
        "rests": rests(truth),
        "errors": errors[-300:] if status not in (0, 1, 130) else "",
    }


def _motion(fault: Fault, truth: Truth, injected: float, detected: Mapping[str, Any] | None) -> float | None:
    """How far the base moved after detection; after the fault where a process is killed and cannot record it."""
    since = injected if detected is None and "kill" in fault.name + fault.reaction else None
    since = detected["time_s"] if detected is not None else since
    if since is None or (detected is not None and "continue" in fault.reaction):
        return None
    if detected is None and "by themselves" not in fault.reaction and "killed" not in fault.name:
        return None
    return moved_after(truth, since)


def _from_motion(truth: Truth, time: float) -> float | None:
    """Time since the base last began to move, and with it the guide, or should have; None if it has not."""
    moved = truth.time[:-1][np.diff(truth.positions["insertion"]) != 0.0]
    moved = moved[moved <= time]
    begins = moved[np.diff(moved, prepend=-np.inf) > _PAUSE_S]
    return float(time - begins[-1]) if len(begins) else None


def good(fault: Fault, trial: Mapping[str, Any]) -> bool:
    """Whether a trial ended as required."""
    still = trial["motion_mm"] is None or trial["motion_mm"] <= _MOTION_MM
    unnoticed = trial["state"] is None or not fault.unnoticed
    ended_well = trial["rests"] and trial["outcome"] in fault.outcomes
    return bool(ended_well and still and unnoticed and fault.timely(trial))


def table(faults: list[Fault], trials: list[dict[str, Any]]) -> str:
    """The table of docs/safety.md."""
    lines = [
        "| | fault | required | ended | detected within (limit) s | motion after it mm | as required |",
        "|---|---|---|---|---:|---:|---:|",
    ]
    for fault in faults:
        mine = [one for one in trials if (one["group"], one["fault"]) == (fault.group, fault.name)]
        if mine:
            lines.append(_row(fault, mine))
    return "\n".join(lines)


def _row(fault: Fault, trials: list[dict[str, Any]]) -> str:
    outcomes = sorted({one["outcome"] for one in trials})
    times = [time for time in map(fault.detection_s, trials) if time is not None]
    motions = [one["motion_mm"] for one in trials if one["motion_mm"] is not None]
    longest = f"{max(times):.3f}" if times else "–"
    limit = "–" if fault.within is None else f"{longest} ({fault.within:g})"
    motion = f"{max(motions):.3f}" if motions else "–"
    share = f"{sum(good(fault, one) for one in trials)} of {len(trials)}"
    ended_as = ", ".join("no record" if one == "running" else one for one in outcomes)
    return f"| {fault.group} | {fault.name} | {fault.reaction} | {ended_as} | {limit} | {motion} | {share} |"


def draw(faults: list[Fault], trials: list[dict[str, Any]], path: Path) -> None:
    """Draw the time to detection of each trial with its limit, and the motion after it."""
    import matplotlib.pyplot as plt

    shown = [one for one in faults if any(trial["fault"] == one.name for trial in trials)]
    figure, axes = plt.subplots(
        1, 2, figsize=(10.0, 0.24 * len(shown) + 1.2), sharey=True, layout="constrained"
    )
    for row, fault in enumerate(shown):
        mine = [one for one in trials if (one["group"], one["fault"]) == (fault.group, fault.name)]
        seconds, motions = map(fault.detection_s, mine), (one["motion_mm"] for one in mine)
        for axis, found in zip(axes, (seconds, motions), strict=True):
            values = [value for value in found if value is not None]
            axis.plot(
                np.maximum(values, 1e-3), [row] * len(values), "o", color="#0072b2", alpha=0.4, markersize=4
            )
        if fault.within is not None:
            axes[0].plot([fault.within], [row], "|", color="#d55e00", markersize=11, markeredgewidth=2)
    axes[1].axvline(_MOTION_MM, color="#d55e00", linewidth=2)
    axes[0].set(
        xscale="log", xlim=(8e-4, 4.0), xlabel="time to detection (s); its limit", yticks=range(len(shown))
    )
    axes[0].set_yticklabels([f"{one.group}: {one.name}" for one in shown])
    axes[1].set(xlabel="motion of the base after detection (mm); limit 0.5", xlim=(-0.02, 0.6))
    for axis in axes:
        axis.grid(axis="both", color="0.9")
        axis.set_axisbelow(True)
    axes[0].set_ylim(len(shown) - 0.5, -0.5)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Run the trials that are missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--timings", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", default="", help="parts of names of faults, with commas")
    parser.add_argument("--keep", action="store_true", help="keep the records of the insertions in OUT")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-faults"))
    args = parser.parse_args()
    chosen = [part.strip() for part in args.only.split(",") if part.strip()]
    faults = [one for one in _faults() if not chosen or any(part in one.name for part in chosen)]
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "trials.jsonl"
    trials = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(one["group"], one["fault"], one["timing"]) for one in trials}
    keep = args.out if args.keep else None
    missing = [
        (fault, timing)
        for timing in range(args.timings)
        for fault in faults
        if (fault.group, fault.name, timing) not in done
    ]
    with ThreadPoolExecutor(args.workers) as pool:
        for (fault, _), trial in zip(
            missing, pool.map(lambda one: run_trial(*one, keep), missing), strict=True
        ):
            trials.append(trial)
            with path.open("a") as file:
                file.write(json.dumps(trial) + "\n")
            mark = "ok " if good(fault, trial) else "BAD"
            shown = {key: trial[key] for key in ("outcome", "state", "detection_s", "motion_mm", "rests")}
            print(
                f"{mark} {fault.group}: {fault.name}: {shown} {trial['why'] or trial['reason']}", flush=True
            )
    print(table(faults, trials))
    draw(faults, trials, args.out / "faults.png")
    bad = [one for fault in faults for one in trials if one["fault"] == fault.name and not good(fault, one)]
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
