"""The emulated Aurora on a pseudo-terminal: bytes in, bytes out, the cable and the clock. Runs until interrupted."""

import os
import pty
import select
import tempfile
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import NoReturn, Self

import numpy as np

from flexneedle.errors import InputError
from flexneedle.rig.emulator import codec
from flexneedle.rig.emulator.aurora import AuroraState, Seen, answer
from flexneedle.rig.emulator.faults import Fault, active
from flexneedle.rig.emulator.motion import RATE_HZ, SENSORS, pose
from flexneedle.rig.emulator.orders import Orders, parse_place
from flexneedle.types import Point

_TICK_S = 0.005  # the longest that the loop sleeps
_LONGEST_STEP_S = 2 * _TICK_S
_CATCHING_UP, _MOST_BEHIND_S = 1.1, 0.2
_LONGEST_LINE = 4096


@dataclass
class EmulatorSession:
    """The device and its faults over time. Times are seconds on the device's clock, first of all that of power-on.

    rest: where the tip rests (mm, the tracker's frame), None while it moves along its arc.
    """

    device: AuroraState
    faults: Sequence[Fault]
    seed: int
    power_on: float
    tracked_since: float | None = None
    rest: Point | None = None

    def __post_init__(self) -> None:
        self._random = np.random.default_rng((self.seed, 1))

    def faults_at(self, now: float) -> dict[str, Fault]:
        """Return the faults that are on, by kind; there are none before tracking first begins."""
        if self.tracked_since is None:
            return {}
        return {fault.kind: fault for fault in active(self.faults, now - self.tracked_since)}

    def reply(self, line: bytes, now: float) -> tuple[float, bytes]:
        """Return when to answer a command, and with what (b"" is silence)."""
        faults = self.faults_at(now)
        if "silence" in faults:
            return now, b""
        if "error" in faults:
            return now, codec.text(f"ERROR{faults['error'].detail}")
        self.device, whole = answer(self.device, line, self._seen(now, faults))
        if self.device.mode == "tracking" and self.tracked_since is None:
            self.tracked_since = now
        late = float(faults["delay"].detail) if "delay" in faults else 0.0
        return now + late, self._damaged(whole, faults)

    def _seen(self, now: float, faults: dict[str, Fault]) -> Seen:
        if "frozen" in faults and self.tracked_since is not None:
            now = self.tracked_since + faults["frozen"].start
        number = int((now - self.power_on) * RATE_HZ) & 0xFFFF_FFFF
        on = () if self.tracked_since is None else active(self.faults, now - self.tracked_since)
        ailments = {fault.detail: fault.kind for fault in on if fault.detail in SENSORS}
        poses = {name: pose(name, number, self.seed, self.rest) for name in SENSORS}
        return Seen(number, poses, ailments, int(faults["system"].detail, 16) if "system" in faults else 0)

    def _damaged(self, whole: bytes, faults: dict[str, Fault]) -> bytes:
        if "cut" in faults:
            return whole[: len(whole) // 2]
        if "garbled" not in faults:
            return whole
        at, flipped = self._random.integers(len(whole)), self._random.integers(1, 256)
        return whole[:at] + bytes([whole[at] ^ int(flipped)]) + whole[at + 1 :]


def _is_left_over(link: Path) -> bool:
    """Whether it is a link to a terminal that is gone, as an emulator that was killed leaves it."""
    return link.is_symlink() and not link.exists() and link.readlink().parent == Path("/dev/pts")


class Serial:
    """A pseudo-terminal and a link to it. Plugged in and out; the link's path stays the same. Use it as a context.

    link: its path, or None for one in a new folder. Raises InputError if something else is there.
    """

    def __init__(self, link: Path | None) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if link is None:
            self._folder = tempfile.TemporaryDirectory(prefix="flexneedle-")
            link = Path(self._folder.name) / "aurora"
        self.link = link
        if os.path.lexists(self.link) and not _is_left_over(self.link):
            raise InputError(f"{self.link}: is there already: name another, or take it away")
        self.ends: tuple[int, int] | None = None
        """Descriptors of the device's end and of the host's; the latter stays open, or the former would fail."""

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def plug(self) -> None:
        """Make the pseudo-terminal and the link. Raises InputError if the link cannot be made."""
        device, host = pty.openpty()
        self.ends = device, host
        tty.setraw(host)  # no echo, no line editing, before the first host opens it
        os.set_blocking(device, False)
        try:
            if _is_left_over(self.link):
                self.link.unlink()
            self.link.symlink_to(os.ttyname(host))
        except OSError as error:
            raise InputError(f"{self.link}: the link cannot be made: {error.strerror}") from None

    def unplug(self) -> None:
        """Hang up on the host and take the link away."""
        if self.ends is not None:
            # Another's link, made since, stays.
            if self.link.is_symlink() and self.link.readlink() == Path(os.ttyname(self.ends[1])):
                self.link.unlink()
            for end in self.ends:
                os.close(end)
        self.ends = None

    @property
    def sources(self) -> list[int]:
        """What to wait for: the device's end, or nothing."""
        return [] if self.ends is None else [self.ends[0]]

    def read(self) -> bytes:
        """Return what the host has written, without waiting for it."""
        with suppress(BlockingIOError):
            return b"".join(os.read(source, _LONGEST_LINE) for source in self.sources)
        return b""

    def write(self, data: bytes) -> None:
        """Send to the host; what it does not take is lost, as on a wire."""
        if self.ends is not None and data:
            with suppress(BlockingIOError):
                os.write(self.ends[0], data)


def device_time(before: float, served: float, now: float) -> float:
    """Return the device's time (s) at `now`, from that `before`, when it was last `served`.

    It is real time, but does not leap where the machine kept this process waiting: it stands, as the device does
    whose part the process plays, and then runs a tenth faster until it has caught up. Else a machine that takes the
    processor away for a frame's length (virtual machines do, for tens of ms) would lose frames that no line loses.
    After more than 0.2 s it leaps, so that its frames do not look stale: then the process was stopped.
    """
    stepped = before + _CATCHING_UP * min(now - served, _LONGEST_STEP_S)
    return max(now - _MOST_BEHIND_S, min(now, stepped))


def serve(session: EmulatorSession, serial: Serial, orders: Orders, say: Callable[[str], None]) -> NoReturn:
    """Answer until interrupted. say: told when the cable is pulled or plugged in, and where the tip rests now."""
    heard, due = b"", list[tuple[float, bytes]]()
    now = served = monotonic()
    while True:
        pulled = "unplug" in session.faults_at(now)
        if pulled != (serial.ends is None):
            (serial.unplug if pulled else serial.plug)()
            heard, due = b"", []
            say("unplugged" if pulled else f"plugged in again: {serial.link}")
        idle = max(0.0, min([_TICK_S, *(time - now for time, _ in due)]))
        ready, _, _ = select.select([*serial.sources, *orders.sources], [], [], idle)
        now, served = device_time(now, served, real := monotonic()), real
        for order in orders.read(ready):
            say(obey(session, order))
        heard += serial.read()
        *lines, heard = heard[-_LONGEST_LINE:].split(b"\r")
        due += [session.reply(line, now) for line in lines]
        while due and due[0][0] <= now:
            serial.write(due.pop(0)[1])


def obey(session: EmulatorSession, order: str) -> str:
    """Rest the tip where a line says; return where it is, or what is wrong with the line."""
    try:
        session.rest = parse_place(order)
    except InputError as error:
        return str(error)
    return "the tip rests at {:g} {:g} {:g} mm".format(*session.rest)
