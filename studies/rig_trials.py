"""Processes for studies of rigs: an emulated rig, an insertion on it, and a witness of the machine's own stalls."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from select import select
from time import monotonic, sleep
from typing import Any

from flexneedle.rig.devices.priority import set_realtime_priority
from flexneedle.rig.emulator.coupled.truth import Truth, read_truth

START_S, END_S = 120.0, 60.0
_STALL_S = 0.005


class Lines:
    """Messages in lines of JSON from a process, as they arrive; other lines are dropped."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process, self._received = process, b""
        self.messages: list[Mapping[str, Any]] = []

    def until(self, key: str, seconds: float, after: int = 0) -> Mapping[str, Any]:
        """Wait for the first message with a key, not counting `after` messages."""
        deadline = monotonic() + seconds
        while True:
            found = next((one for one in self.messages[after:] if key in one), None)
            if found is not None:
                return found
            if monotonic() > deadline or not self._read(deadline):
                raise RuntimeError(f"no {key}: {self.messages} {self._received!r}")

    def _read(self, deadline: float) -> bool:
        stream = self._process.stdout.fileno()
        if not select([stream], [], [], max(0.0, deadline - monotonic()))[0]:
            return False
        data = os.read(stream, 65_536)
        *lines, self._received = (self._received + data).split(b"\n")
        self.messages += [json.loads(line) for line in lines if line.startswith(b"{")]
        return bool(data)


@dataclass
class EmulatedRig:
    """An emulated rig that serves: its rig file, its orders, and the file of the true states."""

    process: subprocess.Popen[bytes]
    lines: Lines
    rig: Path
    truth: Path

    def fault(self, text: str) -> float:
        """Inject a fault such as galil:stall=A; return when it took effect (s, monotonic)."""
        before = len(self.lines.messages)
        self.process.stdin.write(f"fault {text}\n".encode())
        self.process.stdin.flush()
        return float(self.lines.until("done", 10.0, before)["time_s"])

    def first_motion(self) -> float:
        """Wait for the first motion; return its time (s, monotonic)."""
        deadline = monotonic() + START_S
        while monotonic() < deadline:
            found = self.lines.until("event", START_S)
            known = [one for one in self.lines.messages if one.get("event") == "first motion"]
            if known:
                return float(known[0]["time_s"])
            self.lines.until("event", START_S, self.lines.messages.index(found) + 1)
        raise RuntimeError("no motion")

    def read_truth(self) -> Truth:
        """The true states so far."""
        return read_truth(self.truth)


@contextmanager
def emulated_rig(
    folder: Path, scenario: str, seed: int, *, changes: Mapping[str, str] = {}
) -> Iterator[EmulatedRig]:
    """Serve an emulated rig with its files in a folder. changes: texts of the rig file by what they replace."""
    text = (files("flexneedle.scenario") / "rigs" / "emulated.toml").read_text()
    for before, after in {
        "/tmp/aurora": str(folder / "aurora"),
        "127.0.0.1:2323": "127.0.0.1:0",
        **changes,
    }.items():
        text = text.replace(before, after)
    rig, truth = folder / "rig.toml", folder / "truth.csv"
    rig.write_text(text)
    command = [sys.executable, "-m", "flexneedle", "emulate", "rig", rig, scenario]
    options = ["--seed", str(seed), "--truth", truth]
    process = subprocess.Popen([*command, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        lines = Lines(process)
        address = lines.until("ready", START_S)["ready"]["galil"]
        rig.write_text(text.replace("127.0.0.1:0", address))
        yield EmulatedRig(process, lines, rig, truth)
    finally:
        process.terminate()
        process.wait(END_S)
        process.stdin.close()
        process.stdout.close()


def insertion(
    rig: Path,
    scenario: str,
    out: Path,
    *options: str,
    environment: Mapping[str, str] = {},
    cwd: Path | None = None,
) -> subprocess.Popen[bytes]:
    """Start an insertion on a rig, in a session of its own."""
    command = [sys.executable, "-m", "flexneedle", "insert", scenario, "--rig", str(rig), "--yes"]
    return subprocess.Popen(
        [*command, "--plan-seed", "0", "--out", str(out), "--json", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | dict(environment),
        cwd=cwd,
    )


def ended(process: subprocess.Popen[bytes], seconds: float = END_S) -> tuple[int, str, str]:
    """Wait for the end of an insertion; return its exit status and what it has printed on stdout and stderr."""
    try:
        out, errors = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, errors = process.communicate()
    return process.returncode, out.decode(), errors.decode()


@dataclass
class Witness:
    """Times (s, monotonic) at which a process that only sleeps woke up late, and how late."""

    stalls: list[tuple[float, float]] = field(default_factory=list)

    def explains(self, time: float, late: float) -> bool:
        """Whether it was late, too, by at least half as much, when a tick began late at this time."""
        begun = time - late - 0.005
        return any(begun <= at <= time + 0.05 and gap >= 0.5 * late for at, gap in self.stalls)


@contextmanager
def witness() -> Iterator[Witness]:
    """Watch the machine: a process with the priority of the supervisor sleeps 1 ms again and again."""
    found = Witness()
    with tempfile.TemporaryFile() as file:
        process = subprocess.Popen([sys.executable, __file__], stdout=file)
        try:
            yield found
        finally:
            process.terminate()
            process.wait()
            file.seek(0)
            for line in file.read().decode().splitlines():
                at, gap = map(float, line.split())
                found.stalls.append((at, gap))


def watch() -> None:
    """Print each stall of more than 5 ms: when it ended, and how long it was."""
    set_realtime_priority()
    before = monotonic()
    while True:
        sleep(0.001)
        now = monotonic()
        if now - before > _STALL_S:
            print(f"{now:.6f} {now - before:.6f}", flush=True)
        before = now


def percentile(values: Sequence[float], share: float) -> float:
    """A percentile of values; NaN of none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


if __name__ == "__main__":
    watch()
