"""`Aurora`: the port `Tracker` of an NDI Aurora, over a link process that is restarted when it ends."""

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
"""Frame rate of an Aurora."""

_QUEUE = 4000  # frames: 100 s without a call of `read`
_LATE_S = 0.15  # six frames
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.25, 5.0  # before a reconnection
_CONNECT_S, _SILENT_S = 45.0, 3.0  # a link without messages for longer is killed
_STOP_S = 2.0
_PORTS = ("ttyUSB*", "ttyACM*", "cu.usb*")
_BREAK_EVERY = 3


@dataclass(frozen=True)
class Counts:
    """Counts since the start: frames received, frame numbers missed, frames dropped before they were read, connections
    after the first, and errors by kind ("garbled", "no reply", "error", "system", "unplugged"; "crash": the link ended
    without a reason)."""

    frames: int
    missed: int
    dropped: int
    reconnections: int
    errors: Mapping[str, int]


class Aurora:
    """An NDI Aurora at a serial port; `read` returns its frames without waiting. Use it as a context manager.

    clock: of the run, in real time. names: of the sensors at ports 1, 2, ….
    After a failure of the line `status` gives the reason, and the link reconnects until frames arrive again.
    Raises InputError if there is no such port or ndicapi is not installed, RunError if no tracker replies there.
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
        self._received = self._missed = self._dropped = 0
        self._reconnections = -1
        self._errors: Counter[str] = Counter()
        self._last: tuple[int, float] | None = None
        self._reason = "connecting"
        self._first, self._stop = Event(), Event()
        self._thread = Thread(target=self._keep_connected, name="aurora", daemon=True)
        self._thread.start()
        try:
            self._await_first()
        except BaseException:  # also on Ctrl-C: the port must be released
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
        """The frames since the last call, oldest first; may be empty."""
        with self._lock:
            frames = tuple(self._frames)
            self._frames.clear()
        return frames

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, else the reason in a few words."""
        with self._lock:
            last, reason = self._last, self._reason
        if reason != VISIBLE:
            return reason
        silent = monotonic() - last[1] if last is not None else 0.0
        return VISIBLE if silent < _LATE_S else f"no frame for {silent:.1f} s"

    @property
    def counts(self) -> Counts:
        """Counts since the start."""
        with self._lock:
            reconnections = max(0, self._reconnections)
            return Counts(self._received, self._missed, self._dropped, reconnections, dict(self._errors))

    # The thread: runs one link after another

    def _await_first(self) -> None:
        self._first.wait()
        if self._stop.is_set():
            raise RunError(f"{self._path}: no tracker: {self._reason}")

    def _keep_connected(self) -> None:
        pause, attempt = _FIRST_WAIT_S, 0
        try:
            while not self._stop.is_set():
                # A serial break resets the tracker and may take seconds: at the first attempt, then at every third.
                try:
                    tracked = self._connect_once(attempt % _BREAK_EVERY == 0)
                except (
                    OSError,
                    ValueError,
                ) as error:  # the process cannot be started, or its output is invalid
                    tracked = False
                    self._crashed(f"the link failed: {error}")
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
        """Run one link to its end; return whether it was ready at any time."""
        before = self._reconnections
        command = [sys.executable, "-m", f"{__package__}.link", self._path, *(["break"] if may_break else [])]
        # In a separate session, so that Ctrl-C reaches only the run, which then stops the link.
        with tempfile.TemporaryFile() as errors:
            link = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, start_new_session=True)
            with link:
                self._listen(link)
                _stop(link)
            self._record_end(link.returncode, errors)
        return self._reconnections > before

    def _listen(self, link: subprocess.Popen[bytes]) -> None:
        """Process the link's messages until it ends, hangs, or is stopped."""
        out, received = _descriptor(link), b""
        received_at, limit = monotonic(), _CONNECT_S
        while not self._stop.is_set():
            if select.select([out], [], [], 0.1)[0]:
                data = os.read(out, 65536)
                if not data:
                    return
                *lines, received = (received + data).split(b"\n")
                for line in lines:
                    self._process(json.loads(line))
                received_at, limit = monotonic(), _SILENT_S
            elif monotonic() - received_at > limit:
                self._set_reason("no reply: the link does not respond")
                return

    def _process(self, message: list[Any]) -> None:
        match message:
            case ["frame", number, requested, found]:
                self._add_frame(number, requested, found)
            case ["ready", ports]:
                named = {h: sensor_name(port, channel, self._names) for h, (port, channel) in ports.items()}
                with self._lock:
                    self._named, self._reconnections = named, self._reconnections + 1
                    self._timeline = Timeline(RATE_HZ)
                self._first.set()
            case ["error", kind, description]:
                with self._lock:
                    self._errors[kind] += 1
                    self._reason = description
            case ["end", reason]:
                self._set_reason(reason)

    def _add_frame(self, device_number: int, requested: float, found: Mapping[str, Sequence[Any]]) -> None:
        number = self._numbering.count(device_number, requested)
        time = self._timeline.stamp(number, requested) + self._offset
        frame = Frame(time, number, readings(found, device_number, self._named))
        with self._lock:
            self._missed += 0 if self._last is None else number - self._last[0] - 1
            self._dropped += len(self._frames) == _QUEUE
            self._received += 1
            self._last, self._reason = (number, requested), VISIBLE
            self._frames.append(frame)

    def _record_end(self, code: int, errors: IO[bytes]) -> None:
        """Record the reason why a link ended if it sent none: a crash, or it was killed."""
        if self._stop.is_set() or code == 0:
            return
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
        problem = (
            "no reply: the link does not respond"
            if code == -signal.SIGKILL
            else f"the link ended with exit code {code}"
        )
        self._crashed(lines[-1] if lines else problem)

    def _crashed(self, reason: str) -> None:
        with self._lock:
            self._errors["crash"] += 1
            self._reason = reason

    def _set_reason(self, reason: str) -> None:
        with self._lock:
            self._reason = reason


def _check_port(path: str) -> None:
    """Raise InputError, with a list of the ports found, if a port cannot be opened."""
    found = (
        ", ".join(sorted(str(port) for pattern in _PORTS for port in Path("/dev").glob(pattern))) or "none"
    )
    if not Path(path).exists():
        raise InputError(f"{path}: no such port; serial ports found: {found}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise InputError(
            f"{path}: no permission; on Linux add your user to the group of the port (dialout) and log in again"
        )


def _descriptor(link: subprocess.Popen[bytes]) -> int:
    if link.stdout is None:
        raise RunError("the link has no output")
    return link.stdout.fileno()


def _stop(link: subprocess.Popen[bytes]) -> None:
    """Ask a link to stop the tracker and end; kill it after a timeout."""
    link.terminate()
    try:
        link.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        link.kill()
        link.wait()
