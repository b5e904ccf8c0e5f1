"""Emulated Aurora on a pseudo-terminal, with its cable and clock. It runs until interrupted."""

import os
import pty
import select
import tempfile
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from time import monotonic
from typing import NoReturn, Self

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.emulators.aurora import AuroraState, EmulatedFrame
from flexneedle.lab.emulators.aurora_faults import FAULTS
from flexneedle.lab.emulators.faults import Fault, FaultSchedule, damage_reply, is_order, reply_time
from flexneedle.lab.emulators.motion import (
    CIRCLE,
    ORDINARY,
    RATE_HZ,
    SENSORS,
    EmulatedPose,
    RestingTip,
    SensorNoise,
    TipSource,
    is_missing,
    sensor_pose,
)
from flexneedle.lab.emulators.orders import OrderSource, parse_position

_TICK_S = 0.005  # longest sleep of the loop
_LONGEST_STEP_S = 2 * _TICK_S
_CATCH_UP_RATE, _MOST_BEHIND_S = 1.1, 0.2
_LONGEST_LINE = 4096


@dataclass
class EmulatorSession:
    """Device and its faults over time. Times are in seconds on the device's clock, `power_on` the first.

    faults: scheduled, from when tracking first begins; tip: source of its pose; noise: errors of the tip's sensor;
    on_tracking: called with the time when tracking first begins.
    """

    device: AuroraState
    faults: Sequence[Fault]
    seed: int
    power_on: float
    tip: TipSource = CIRCLE
    noise: SensorNoise = ORDINARY
    on_tracking: Callable[[float], None] = lambda _: None

    def __post_init__(self) -> None:
        self._random = np.random.default_rng((self.seed, 1))
        self._repeated: dict[Fault, EmulatedPose] = {}
        self.schedule = FaultSchedule(FAULTS, self.faults)

    def reply(self, line: bytes, now: float) -> tuple[float, bytes]:
        """Return time and data of the reply to a command (b"": no reply)."""
        faults = self.schedule.by_kind(now)
        if "silence" in faults:
            return now, b""
        if "error" in faults:
            return now, codec.encode_text(f"ERROR{faults['error'].detail}")
        self.device, complete = aurora.reply(self.device, line, self._frame(now, faults))
        if self.device.mode == "tracking" and self.schedule.since is None:
            self.schedule.since = now
            self.on_tracking(now)
        return reply_time(now, faults), damage_reply(complete, faults, self._random)

    def _frame(self, now: float, faults: dict[str, Fault]) -> EmulatedFrame:
        taken = faults["frozen"].start if "frozen" in faults else now
        number = self.tip.newest(int((taken - self.power_on) * RATE_HZ))
        present = self.schedule.at(now)
        by_sensor = {fault.detail: fault.kind for fault in present if fault.kind in aurora.OF_STATUS}
        if is_missing(number, self.seed, self.noise):
            by_sensor.setdefault(SENSORS[0], "missing")
        poses = {name: self._pose(name, number, present) for name in SENSORS}
        system = int(faults["system"].detail, 16) if "system" in faults else 0
        return EmulatedFrame(number & 0xFFFF_FFFF, poses, by_sensor, system)

    def _pose(self, name: str, number: int, present: Sequence[Fault]) -> EmulatedPose:
        """Return the pose of a sensor in a frame, with the faults that change its values."""
        made = sensor_pose(name, number, self.seed, self.tip, self.noise)
        for fault in present:
            if fault.kind == "stuck" and fault.detail == name:
                made = self._repeated.setdefault(fault, made)
            made = with_fault(name, made, fault)
        return made


def with_fault(name: str, made: EmulatedPose, fault: Fault) -> EmulatedPose:
    """Return the pose of a sensor with the wrong values of a fault."""
    if fault.kind == "nan" and fault.detail == name:
        return EmulatedPose((nan, nan, nan), (nan, nan, nan, nan), nan)
    if fault.kind == "jump" and name == SENSORS[0]:
        x, y, z = made.position
        return replace(made, position=(x, y + float(fault.detail), z))
    if fault.kind == "indicator":
        return replace(made, indicator=float(fault.detail))
    return made


def _is_left_over(link: Path) -> bool:
    """Return whether a path is a link to a terminal that no longer exists, left by an emulator that was killed."""
    return link.is_symlink() and not link.exists() and link.readlink().parent == Path("/dev/pts")


class SerialPort:
    """Pseudo-terminal and a symbolic link to it, which can be plugged in and out. Use it as a context manager.

    link: path of the link, or None for one in a new folder. Raises InputError if the path exists.
    """

    def __init__(self, link: Path | None) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if link is None:
            self._folder = tempfile.TemporaryDirectory(prefix="flexneedle-")
            link = Path(self._folder.name) / "aurora"
        self.link = link
        if os.path.lexists(self.link) and not _is_left_over(self.link):
            raise InputError(f"{self.link}: already exists: choose another path, or remove it")
        self.ends: tuple[int, int] | None = None
        """Descriptors of the device's end and of the host's, which must stay open: the former would fail otherwise."""

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def plug(self) -> None:
        """Create the pseudo-terminal and the link. Raises InputError if the link cannot be created."""
        device, host = pty.openpty()
        self.ends = device, host
        tty.setraw(host)  # no echo, no line editing, before the first host opens it
        os.set_blocking(device, False)
        try:
            if _is_left_over(self.link):
                self.link.unlink()
            self.link.symlink_to(os.ttyname(host))
        except OSError as error:
            exists = isinstance(error, FileExistsError)
            remedy = ": remove it, unless another emulator uses it" if exists else ""
            raise InputError(f"{self.link}: the link cannot be created: {error.strerror}{remedy}") from None

    def unplug(self) -> None:
        """Close the terminal and remove the link."""
        if self.ends is not None:
            # A newer link of another process is kept.
            if self.link.is_symlink() and self.link.readlink() == Path(os.ttyname(self.ends[1])):
                self.link.unlink()
            for end in self.ends:
                os.close(end)
        self.ends = None

    @property
    def sources(self) -> list[int]:
        """The device's end to wait for, or none."""
        return [] if self.ends is None else [self.ends[0]]

    def read(self) -> bytes:
        """Return the data that the host has written, without waiting."""
        with suppress(BlockingIOError):
            return b"".join(os.read(source, _LONGEST_LINE) for source in self.sources)
        return b""

    def write(self, data: bytes) -> None:
        """Send to the host; data that it does not accept are lost, as on a wire."""
        if self.ends is not None and data:
            with suppress(BlockingIOError):
                os.write(self.ends[0], data)


def device_time(before: float, served: float, now: float) -> float:
    """Return the device's time (s) at `now`, from its time `before` at the last call, at `served` (s).

    It follows real time, but does not jump after a pause of the process: it stops during the pause, and then runs 10 %
    faster until it has caught up. Otherwise a pause of one frame period (virtual machines pause for tens of ms) would
    lose frames that a real device does not lose. After more than 0.2 s, in which the process was stopped, it jumps, so
    that frames are not stale.
    """
    stepped = before + _CATCH_UP_RATE * min(now - served, _LONGEST_STEP_S)
    return max(now - _MOST_BEHIND_S, min(now, stepped))


def serve(
    session: EmulatorSession,
    serial: SerialPort,
    orders: OrderSource,
    obey: Callable[[str], None],
    say: Callable[[str], None],
) -> NoReturn:
    """Reply to commands until interrupted.

    obey: called with each line of the orders; say: called with a line when the cable is unplugged or plugged in.
    """
    received, due = b"", list[tuple[float, bytes]]()
    now = served = monotonic()
    while True:
        unplugged = "unplug" in session.schedule.by_kind(now)
        if unplugged != (serial.ends is None):
            (serial.unplug if unplugged else serial.plug)()
            received, due = b"", []
            say("unplugged" if unplugged else f"plugged in again: {serial.link}")
        idle = max(0.0, min([_TICK_S, *(time - now for time, _ in due)]))
        ready, _, _ = select.select([*serial.sources, *orders.sources], [], [], idle)
        now, served = device_time(now, served, real := monotonic()), real
        for order in orders.read(ready):
            obey(order)
        received += serial.read()
        *lines, received = received[-_LONGEST_LINE:].split(b"\r")
        due += [session.reply(line, now) for line in lines]
        while due and due[0][0] <= now:
            serial.write(due.pop(0)[1])


def execute(session: EmulatorSession, order: str) -> str:
    """Rest the tip at the position in a line, or inject the fault in it; return a message about it, or the error."""
    try:
        if is_order(order):
            return f"{session.schedule.obey(order, monotonic())} from now on"
        session.tip = RestingTip(parse_position(order))
    except InputError as error:
        return str(error)
    return "the tip rests at {:g} {:g} {:g} mm".format(*session.tip.position)
