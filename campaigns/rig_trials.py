"""Processes for studies of rigs: an emulated rig, an insertion on it, and a witness of the stalls of the machine."""

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from select import select
from threading import Event, Thread
from time import monotonic, sleep
from typing import Any, TypeVar

import numpy as np
import psutil

import flexneedle
from flexneedle.lab.emulators.emulated_rig.truth import TruthRecord, read_truth
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.results import Insertion
from flexneedle.scenario.files import dump_scenario

START_S, END_S, _ABORT_S = 300.0, 60.0, 5.0
SHORT = {"setup.tip_to_skin_mm": 2.0, "target.depth_mm": 20.0, "target.lateral_mm": 1.0}
"""Values of a scenario whose insertion takes seconds, for quick runs of campaigns."""
_STALL_S = 0.005
_POLL_S = 0.2
_BAD_INPUT = 2  # exit status


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

    def wait(self, seconds: float) -> None:
        """Wait for lines, at most for a time."""
        self._read(monotonic() + seconds)

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
    """A running emulated rig: its rig file, its orders, and the file of the true states."""

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

    def first_motion(self, process: subprocess.Popen[bytes]) -> float:
        """Wait for the first motion of an insertion; return its time (s, monotonic). Raises RuntimeError if it ends."""
        deadline = monotonic() + START_S
        while monotonic() < deadline and process.poll() is None:
            moved = next((one for one in self.lines.messages if one.get("event") == "first motion"), None)
            if moved is not None:
                return float(moved["time_s"])
            self.lines.wait(0.1)
        raise RuntimeError(f"no motion: {wait_for_end(process, 0.0)}")

    def read_truth(self) -> TruthRecord:
        """Return the true states until now."""
        return read_truth(self.truth)


def shipped_rig() -> str:
    """Return the rig file of the package for an emulated rig."""
    return (files("flexneedle.lab.rig") / "rigs" / "emulated.toml").read_text()


def write_short(folder: Path) -> Path:
    """Write the preset with `SHORT` to a folder, and return its file."""
    path = folder / "short.toml"
    path.write_text(dump_scenario(flexneedle.load_scenario("phantom").with_values(SHORT)))
    return path


@contextmanager
def emulated_rig(folder: Path, scenario: str, seed: int, *, text: str | None = None) -> Iterator[EmulatedRig]:
    """Serve an emulated rig with its files in a folder.

    text: its rig file, with the address and the port of the shipped one (default: that one).
    """
    text = shipped_rig() if text is None else text
    for before, after in {"/tmp/aurora": str(folder / "aurora"), "127.0.0.1:2323": "127.0.0.1:0"}.items():
        text = text.replace(before, after)
    given, rig, truth = folder / "given.toml", folder / "rig.toml", folder / "truth.csv"
    given.write_text(text)
    command = [sys.executable, "-m", "flexneedle", "emulate", "rig", given, scenario]
    options = ["--seed", str(seed), "--truth", truth, "--save", rig]
    process = subprocess.Popen([*command, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        lines = Lines(process)
        lines.until("ready", START_S)
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
    """Start an insertion on a rig, in a separate session."""
    command = [sys.executable, "-m", "flexneedle", "insert", scenario, "--rig", str(rig), "--yes"]
    return subprocess.Popen(
        [*command, "--plan-seed", "0", "--out", str(out), "--json", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | {"PYTHONFAULTHANDLER": "1"} | dict(environment),
        cwd=cwd,
    )


def wait_for_end(process: subprocess.Popen[bytes], seconds: float = END_S) -> tuple[int, str, str]:
    """Wait for the end of an insertion; return its exit status, stdout and stderr.

    One that hangs is killed; stderr has where each of its threads was.
    """
    try:
        out, errors = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_ABORT_S)
        with suppress(ProcessLookupError):  # all of its group have ended with it
            os.killpg(process.pid, signal.SIGKILL)
        out, errors = process.communicate()
    return process.returncode, out.decode(), errors.decode()


@dataclass(frozen=True)
class Inserted:
    """An insertion on an emulated rig that has ended.

    status: exit status; errors: what it has printed on stderr; run: its run.json, empty without one; tip: the true
    position of the tip at the end (mm); out: its folder.
    """

    status: int
    errors: str
    run: Mapping[str, Any]
    tip: tuple[float, float, float]
    out: Path

    @property
    def outcome(self) -> str:
        """Outcome, or "refused" where it was refused before it began."""
        return "refused" if self.status == _BAD_INPUT else str(self.run.get("status", "no record"))

    @property
    def reason(self) -> str:
        """Return the reason for the end, in one line."""
        printed = self.errors.strip().splitlines() if self.status not in (0, 1) else ()
        return str(self.run.get("reason") or "") or next(reversed(printed), "")

    @property
    def ticks(self) -> Mapping[str, Any]:
        """Times of the supervisor's ticks, empty if it has none."""
        return (self.run.get("timing") or {}).get("ticks") or {}

    def unexplained(self, seen: "Witness") -> int:
        """Stalls of the ticks during which the witness was not late."""
        return sum(not seen.explains(one["time_s"], one["late_s"]) for one in self.ticks.get("stalls", ()))


def run_insertion(
    folder: Path,
    scenario: Path | str,
    seed: int,
    out: Path,
    *options: str,
    text: str | None = None,
    seconds: float = 180.0,
) -> Inserted:
    """Insert into a scenario on a separate emulated rig, with its files in a folder, within `seconds`.

    text: of the rig file, as for `emulated_rig`; options: of the insertion, which runs in the folder.
    """
    with emulated_rig(folder, str(scenario), seed, text=text) as rig:
        process = insertion(rig.rig, str(scenario), out.resolve(), "--seed", str(seed), *options, cwd=folder)
        status, _, errors = wait_for_end(process, seconds)
        x, y, z = map(float, rig.read_truth().tips[-1, :3])
    run = json.loads(file.read_text()) if (file := out / "run.json").exists() else {}
    return Inserted(status, errors, run, (x, y, z), out)


def axial_innovation(record: Insertion) -> float:
    """Return the mean axial innovation (mm) of the periods with good readings."""
    found = [one.innovation[0] for one in record.periods if one.verdict.ok and one.readings]
    return float(np.mean(found)) if found else float("nan")


Task = TypeVar("Task")
Row = dict[str, Any]


def resume_rows(
    file: Path, tasks: Sequence[Task], run: Callable[[Task], Row], workers: int, key: Callable[[Task], Row]
) -> Iterator[tuple[Row, bool]]:
    """Yield the row of each task, and whether it is new: those in a file first, then others as they end.

    A row contains its task's key, which identifies it, and is appended to the file (JSON, a line each)
    once it is complete. A task that raises RuntimeError is printed, and leaves no row. After an interrupt (Ctrl-C,
    SIGTERM) tasks that have not ended leave none, and the processes that they have started are ended.
    """
    lines = file.read_text().splitlines() if file.exists() else []
    kept = [row for row in map(json.loads, lines) if any(key(task).items() <= row.items() for task in tasks)]
    yield from ((row, False) for row in kept)
    missing = [task for task in tasks if not any(key(task).items() <= row.items() for row in kept)]
    file.parent.mkdir(parents=True, exist_ok=True)
    # A flag, since an exception that a signal raises can be lost where Python ignores exceptions, as in a weak
    # reference's callback.
    interrupted = Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: interrupted.set()) for number in numbers}
    try:
        with ThreadPoolExecutor(workers) as pool:
            try:
                for row in _rows([pool.submit(run, task) for task in missing], interrupted):
                    with file.open("a") as opened:
                        opened.write(json.dumps(row) + "\n")
                    yield row, True
            except BaseException:
                _end(pool)
                raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def collect_rows(
    file: Path,
    tasks: Sequence[Task],
    run: Callable[[Task], Row],
    workers: int,
    key: Callable[[Task], Row],
    show: Callable[[Row], str],
) -> list[Row]:
    """Return the rows of `resume_rows`, and print a line of each new one. show: returns a row as a line."""
    rows: list[Row] = []
    for row, new in resume_rows(file, tasks, run, workers, key):
        rows.append(row)
        if new:
            print(f"{len(rows)} of {len(tasks)}: {show(row)}", file=sys.stderr, flush=True)
    return rows


def _rows(running: Sequence[Future[Row]], interrupted: Event) -> Iterator[Row]:
    """The rows of tasks as they end, without those that fail. Raises KeyboardInterrupt once `interrupted` is set."""
    left = set(running)
    while left:
        wait_for_end, left = wait(left, _POLL_S, FIRST_COMPLETED)
        if interrupted.is_set():
            raise KeyboardInterrupt
        # Futures with an exception come last: another's exception loses no row.
        for one in sorted(wait_for_end, key=lambda one: one.exception() is not None):
            try:
                yield one.result()
            except RuntimeError as error:
                print(error, file=sys.stderr, flush=True)


def _end(pool: ThreadPoolExecutor) -> None:
    """Cancel tasks, and end all child processes until no task runs, since a task may start further processes."""
    closing = Thread(target=pool.shutdown, kwargs={"cancel_futures": True})
    closing.start()
    wait_for_end = set[psutil.Process]()
    while closing.is_alive():
        for process in set(psutil.Process().children(recursive=True)) - wait_for_end:
            wait_for_end.add(process)
            with suppress(psutil.NoSuchProcess):
                process.terminate()
                process.resume()  # one that is stopped does not end
        closing.join(0.1)


@dataclass
class Witness:
    """The file of the times (s, monotonic) at which a process that only sleeps woke up late, and how late.

    text: of the file, once the process has ended.
    """

    file: Path
    text: str | None = None

    def explains(self, time: float, late: float) -> bool:
        """Return whether the witness was late by at least half as much when a tick began late at this time."""
        begun = time - late - 0.005
        return any(begun <= at <= time + 0.05 and gap >= 0.5 * late for at, gap in self._stalls())

    def _stalls(self) -> Iterator[tuple[float, float]]:
        text = self.file.read_text() if self.text is None else self.text
        for line in text[: text.rfind("\n") + 1].splitlines():
            at, gap = map(float, line.split())
            yield at, gap


@contextmanager
def witness() -> Iterator[Witness]:
    """Detect stalls of the machine: a process with the priority of the supervisor repeatedly sleeps 1 ms."""
    with tempfile.TemporaryDirectory() as folder:
        found = Witness(Path(folder) / "stalls")
        with found.file.open("wb") as file:
            process = subprocess.Popen([sys.executable, __file__], stdout=file)
        try:
            yield found
        finally:
            process.terminate()
            process.wait()
            found.text = found.file.read_text()


def watch() -> None:
    """Print the end and the length of each stall of more than 5 ms."""
    set_realtime_priority()
    before = monotonic()
    while True:
        sleep(0.001)
        now = monotonic()
        if now - before > _STALL_S:
            print(f"{now:.6f} {now - before:.6f}", flush=True)
        before = now


def moved_between(
    truth: TruthRecord, since: float, until: float = math.inf, axis: str = "insertion"
) -> float:
    """Return the motion of an axis (mm, rad) between two times (s, monotonic)."""
    places = truth.positions[axis]
    after = places[(truth.time >= since) & (truth.time <= until)]
    return float(np.abs(after - np.interp(since, truth.time, places)).max()) if len(after) else 0.0


def is_at_rest(truth: TruthRecord, seconds: float = 0.5, most: float = 0.005) -> bool:
    """Return whether no axis has moved by `most` (mm, rad) in the last `seconds`."""
    last = truth.time >= truth.time[-1] - seconds
    return all(np.ptp(place[last]) < most for place in truth.positions.values())


def percentile(values: Sequence[float], share: float) -> float:
    """Return a percentile of values, NaN without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


if __name__ == "__main__":
    watch()
