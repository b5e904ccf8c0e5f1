"""`Aurora`: the port `Tracker` over a link process that is started again for as long as it takes."""

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from time import monotonic
from typing import IO, Any, Self

from flexneedle.errors import InputError, RunError
from flexneedle.rig.devices.aurora.library import library_path
from flexneedle.rig.devices.aurora.readings import NAMES, readings, sensor_name
from flexneedle.rig.devices.aurora.timing import Numbering, Timeline
from flexneedle.rig.ports import Clock
from flexneedle.types import VISIBLE, Frame

RATE_HZ = 40.0
"""Frames a second of an Aurora."""

_QUEUE = 4000  # frames: 100 s for one who does not read
_LATE_S = 0.15  # six frames
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.25, 5.0  # before connecting again
_CONNECT_S, _SILENT_S = 45.0, 3.0  # a link that says nothing for so long hangs
_STOP_S = 2.0
_PORTS = ("ttyUSB*", "ttyACM*", "cu.usb*")
_BREAK_EVERY = 3


@dataclass(frozen=True)
class Counts:
    """What happened so far: frames told, frame numbers that never came, frames that nobody read in time,
    connections after the first, and failed readings by kind ("garbled", "no reply", "error", "system", "unplugged";
    "crash" for a link that ended otherwise)."""

    frames: int
    missed: int
    dropped: int
    reconnections: int
    troubles: Mapping[str, int]


class Aurora:
    """An NDI Aurora at a serial port, tracking; `read` returns its frames and never waits. Use it as a context.

    clock: of the run, in real time. names: of the sensors at ports 1, 2, ….
    Whatever happens to the line later is told by `status` and ends by itself or not; frames go on when it does.
    Raises InputError if there is no such port or ndicapi is not installed, RunError if no tracker answers there.
    """

    def __init__(self, path: str, clock: Clock, names: Sequence[str] = NAMES) -> None:
        library_path()
        _check_port(path)
        self._path, self._names = path, tuple(names)
        self._offset = clock.now() - monotonic()
        self._frames: deque[Frame] = deque(maxlen=_QUEUE)
        self._numbering = Numbering(RATE_HZ)
        self._timeline = Timeline(RATE_HZ)
        self._named: dict[str, str] = {}
        self._lock = Lock()
        self._told = self._missed = self._dropped = 0
        self._reconnections = -1
        self._troubles: Counter[str] = Counter()
        self._last: tuple[int, float] | None = None
        self._reason = "connecting"
        self._first, self._stop = Event(), Event()
        self._thread = Thread(target=self._keep_connected, name="aurora", daemon=True)
        self._thread.start()
        try:
            self._await_first()
        except BaseException:  # Ctrl-C as well: nothing is to go on holding the port
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop tracking and close the port."""
        self._stop.set()
        self._thread.join()

    def read(self) -> tuple[Frame, ...]:
        """The frames since the last call, oldest first; empty if there was none."""
        with self._lock:
            frames = tuple(self._frames)
            self._frames.clear()
        return frames

    @property
    def status(self) -> str:
        """VISIBLE while frames come, or in a few words why none do."""
        with self._lock:
            last, reason = self._last, self._reason
        if reason != VISIBLE:
            return reason
        silent = monotonic() - last[1] if last is not None else 0.0
        return VISIBLE if silent < _LATE_S else f"no frame for {silent:.1f} s"

    @property
    def counts(self) -> Counts:
        """What happened so far."""
        with self._lock:
            again = max(0, self._reconnections)
            return Counts(self._told, self._missed, self._dropped, again, dict(self._troubles))

    # The thread: one link after the other

    def _await_first(self) -> None:
        self._first.wait()
        if self._stop.is_set():
            raise RunError(f"{self._path}: no tracker: {self._reason}")

    def _keep_connected(self) -> None:
        pause, attempt = _FIRST_WAIT_S, 0
        try:
            while not self._stop.is_set():
                # A break resets the tracker and may take seconds: first, and then only where nothing else helped.
                try:
                    tracked = self._connect_once(attempt % _BREAK_EVERY == 0)
                except (OSError, ValueError) as error:  # no process to be had, or it tells nonsense
                    tracked = False
                    self._crashed(f"the link cannot be run: {error}")
                if not self._first.is_set():
                    return
                pause, attempt = (
                    (_FIRST_WAIT_S, 1) if tracked else (min(2 * pause, _LONGEST_WAIT_S), attempt + 1)
                )
                self._stop.wait(pause)
        finally:
            self._stop.set()
            self._first.set()

    def _connect_once(self, may_break: bool) -> bool:
        """Read one link to its end; return whether it ever was ready."""
        before = self._reconnections
        command = [sys.executable, "-m", f"{__package__}.link", self._path, *(["break"] if may_break else [])]
        # A session of its own: Ctrl-C in the terminal is for the run, which then stops the link in good order.
        with tempfile.TemporaryFile() as errors:
            link = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, start_new_session=True)
            with link:
                self._listen(link)
                _stop(link)
            self._judge_end(link.returncode, errors)
        return self._reconnections > before

    def _listen(self, link: subprocess.Popen[bytes]) -> None:
        """Take the link's messages until it ends, hangs, or is no longer wanted."""
        out, heard = _descriptor(link), b""
        heard_at, limit = monotonic(), _CONNECT_S
        while not self._stop.is_set():
            if select.select([out], [], [], 0.1)[0]:
                data = os.read(out, 65536)
                if not data:
                    return
                *lines, heard = (heard + data).split(b"\n")
                for line in lines:
                    self._take(json.loads(line))
                heard_at, limit = monotonic(), _SILENT_S
            elif monotonic() - heard_at > limit:
                self._set_reason("no reply: the link hung")
                return

    def _take(self, message: list[Any]) -> None:
        match message:
            case ["frame", number, asked, found]:
                self._take_frame(number, asked, found)
            case ["ready", ports]:
                named = {h: sensor_name(port, channel, self._names) for h, (port, channel) in ports.items()}
                with self._lock:
                    self._named, self._reconnections = named, self._reconnections + 1
                    self._timeline = Timeline(RATE_HZ)
                self._first.set()
            case ["trouble", kind, words]:
                with self._lock:
                    self._troubles[kind] += 1
                    self._reason = words
            case ["end", words]:
                self._set_reason(words)

    def _take_frame(self, device_number: int, asked: float, found: Mapping[str, Sequence[Any]]) -> None:
        number = self._numbering.count(device_number, asked)
        time = self._timeline.stamp(number, asked) + self._offset
        frame = Frame(time, number, readings(found, device_number, self._named))
        with self._lock:
            self._missed += 0 if self._last is None else number - self._last[0] - 1
            self._dropped += len(self._frames) == _QUEUE
            self._told += 1
            self._last, self._reason = (number, asked), VISIBLE
            self._frames.append(frame)

    def _judge_end(self, code: int, errors: IO[bytes]) -> None:
        """Say why a link ended that did not say so itself: it crashed or was killed."""
        if self._stop.is_set() or code == 0:
            return
        errors.seek(0)
        said = errors.read().decode(errors="replace").strip().splitlines()
        hung = "no reply: the link hung" if code == -signal.SIGKILL else f"the link ended with status {code}"
        self._crashed(said[-1] if said else hung)

    def _crashed(self, words: str) -> None:
        with self._lock:
            self._troubles["crash"] += 1
            self._reason = words

    def _set_reason(self, words: str) -> None:
        with self._lock:
            self._reason = words


def _check_port(path: str) -> None:
    """Raise InputError, with the ports that there are, if a port cannot be opened."""
    found = (
        ", ".join(sorted(str(port) for pattern in _PORTS for port in Path("/dev").glob(pattern))) or "none"
    )
    if not Path(path).exists():
        raise InputError(f"{path}: no such port; serial ports found: {found}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise InputError(
            f"{path}: no permission; on Linux join the group of the port (dialout) and log in again"
        )


def _descriptor(link: subprocess.Popen[bytes]) -> int:
    if link.stdout is None:
        raise RunError("the link has no output")
    return link.stdout.fileno()


def _stop(link: subprocess.Popen[bytes]) -> None:
    """Let a link put the tracker to rest; end it if it does not."""
    link.terminate()
    try:
        link.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        link.kill()
        link.wait()
