"""`Aurora`: the port `Tracker` of an NDI Aurora, over a link process that is restarted when it ends."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Self

from flexneedle.errors import InputError, RunError
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.aurora.incoming import AuroraCounts, LinkReceiver
from flexneedle.lab.rig.devices.aurora.library import library_path
from flexneedle.lab.rig.devices.aurora.messages import Message, message_channel
from flexneedle.lab.rig.devices.aurora.readings import NAMES
from flexneedle.ports import Clock
from flexneedle.types import Frame

_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.25, 5.0  # before a reconnection
_CONNECT_S, _SILENT_S = 45.0, 3.0  # a link without messages for longer is killed
_STOP_S, _POLL_S = 2.0, 0.1
_PORTS = ("ttyUSB*", "ttyACM*", "cu.usb*")
_BREAK_EVERY = 3


class Aurora:
    """An NDI Aurora at a serial port; `read` returns its frames without waiting. Use it as a context manager.

    clock: of the run, in real time. names: of the sensors at ports 1, 2, ….
    After a failure of the line `status` gives the reason, and the link reconnects until frames arrive again. A link is
    also ended if it sends an invalid message, or a frame that is not new.
    Raises InputError if there is no such port or ndicapi is not installed, RunError if no tracker replies there.
    """

    def __init__(self, path: str, clock: Clock, names: Sequence[str] = NAMES) -> None:
        library_path()
        _check_port(path)
        self._path = path
        self._incoming = LinkReceiver(names, clock.now() - monotonic())
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
        """Return the frames since the last call, oldest first; may be empty."""
        return self._incoming.read()

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, else the reason in a few words."""
        return self._incoming.status

    @property
    def counts(self) -> AuroraCounts:
        """Counts since the start."""
        return self._incoming.counts

    # The thread: runs one link after another

    def _await_first(self) -> None:
        self._first.wait()
        if self._stop.is_set():
            raise RunError(f"{self._path}: not connected: {self._incoming.reason}")

    def _keep_connected(self) -> None:
        pause, attempt = _FIRST_WAIT_S, 0
        try:
            while not self._stop.is_set():
                # A serial break resets the tracker and may take seconds: at the first attempt, then at every third.
                try:
                    tracked = self._connect_once(attempt % _BREAK_EVERY == 0)
                except (OSError, ValueError) as error:  # it cannot be started, or its output is invalid
                    tracked = False
                    self._incoming.record_crash(f"the link failed: {error}")
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
        before = self._incoming.connections
        arguments = (self._path, *(["break"] if may_break else []))
        link = ChildProcess(f"{__package__}.link", *arguments, keep_printed=True, channel=message_channel)
        try:
            try:
                self._listen(link)
            finally:  # also if it sent an invalid message, and would continue
                code = link.end(_STOP_S, terminate=not link.channel.ended)
            self._record_end(code, link.last_line())
        finally:
            link.close()
        return self._incoming.connections > before

    def _listen(self, link: ChildProcess) -> None:
        """Process the link's messages until it ends, hangs, or is stopped."""
        self._incoming.begin_link()
        received_at, limit = monotonic(), _CONNECT_S
        while not (self._stop.is_set() or link.channel.ended):
            for message in link.channel.receive(_POLL_S):
                self._take(message)
                received_at, limit = monotonic(), _SILENT_S
            if monotonic() - received_at > limit:
                self._incoming.set_reason("no reply: the link does not respond")
                return

    def _take(self, message: Message) -> None:
        """Take a message of a link. Raises ValueError for one out of order."""
        try:
            self._incoming.take(message)
        finally:
            if self._incoming.connections:
                self._first.set()

    def _record_end(self, code: int, printed: str) -> None:
        """Record the reason why a link ended if it sent none: a crash, or it was killed."""
        if self._stop.is_set() or code == 0:
            return
        problem = (
            "no reply: the link does not respond"
            if code == -signal.SIGKILL
            else f"the link ended with exit code {code}"
        )
        self._incoming.record_crash(printed or problem)


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
