"""Emulated FBGS ShapeCore: frames of the curvatures of a fibre on TCP, to several clients at once, with faults.

The layout is described in `flexneedle.lab.rig.devices.fbg.stream`. As one captured from a device, a frame has 20
values, a shape of 19 points, and spectra that make up most of its 15.8 kB.
"""

import math
import select
import socket
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import monotonic
from typing import NoReturn

import numpy as np

from flexneedle.lab.emulators.faults import SECONDS, Fault, FaultKind, FaultSchedule, damage_reply, reply_time
from flexneedle.lab.emulators.galil.galil_server import TcpServer
from flexneedle.lab.emulators.orders import OrderSource
from flexneedle.types import Floats

RATE_HZ = 100.0
POSITIONS_MM = tuple(184.8 - 10.0 * n for n in range(18))
"""Distances from the tip of the gratings of values 3 to 20."""
UNUSED = 2
"""Number of values before the first grating."""

_SPECTRA_BYTES = 15_220  # of four cores, 630 wavelengths and powers each
_TICK_S = 0.01
_MOST_UNSENT = 1 << 16

FAULTS = {
    "silence": FaultKind("nothing is sent; connections stay"),
    "frozen": FaultKind("the last frame is sent again and again"),
    "stuck": FaultKind("the values repeat, with new line numbers and timestamps"),
    "nan": FaultKind("one curvature is not a number"),
    "error": FaultKind("the error field is set (1, or error=CODE)", "1", "error code", tuple("123456789")),
    "garbled": FaultKind("a byte of each frame is changed"),
    "cut": FaultKind("half of each frame is sent"),
    "delay": FaultKind("frames are delayed (0.2, or delay=SECONDS)", "0.2", SECONDS),
    "unplug": FaultKind("connections are closed, and refused for the duration"),
}
"""The kinds of fault; their times are since the first client."""

Curvatures = Callable[[float], Floats | None]
"""Returns κy, κz (2, n), 1/mm, at the gratings at a time (s, monotonic), None if there are no new ones."""


def turning_arc(time: float) -> Floats:
    """Return an arc of 2.5 1/m whose direction turns once in 10 s."""
    angle = 0.2 * math.pi * time
    kappa = 2.5e-3 * np.array([[math.cos(angle)], [math.sin(angle)]])
    return np.tile(kappa, len(POSITIONS_MM))


def encode_frame(line: int, stamp: float, bends: Floats, *, error: int = 0, fibre: int = 0) -> bytes:
    """Return a frame. bends: κy, κz (2, n), 1/mm; stamp: time stamp, s."""
    values = np.concatenate([np.zeros((2, UNUSED)), bends], axis=1)
    arrays = (np.hypot(*values), np.arctan2(values[1], values[0]))
    fields = (
        struct.pack("<H", error),
        struct.pack("<Q", line),
        struct.pack("<d", stamp),
        *(struct.pack("<I", values.shape[1]) + one.astype("<f4").tobytes() for one in arrays),
        struct.pack("<II", 3, 19) + bytes(4 * 3 * 19),
        struct.pack("<I", values.shape[1]) + np.full(values.shape[1], 20.0, "<f4").tobytes(),
        bytes(_SPECTRA_BYTES),
    )
    payload = bytes([fibre]) + b"".join(_field(kind, content) for kind, content in enumerate(fields))
    return struct.pack("<I", len(payload)) + payload


def _field(kind: int, content: bytes) -> bytes:
    return struct.pack("<iH", len(content) + 2, kind) + content


@dataclass
class FbgsSession:
    """Frames over time, with faults. Times are monotonic (s); frames count from `power_on`, `rate_hz` a second."""

    faults: Sequence[Fault]
    power_on: float
    seed: int = 0
    curvatures: Curvatures = turning_arc
    rate_hz: float = RATE_HZ
    line: int = 0
    _waiting: list[tuple[float, bytes]] = field(default_factory=list)
    _frame: tuple[int, float, Floats] | None = None
    _bends: Floats = field(default_factory=lambda: np.zeros((2, len(POSITIONS_MM))))

    def __post_init__(self) -> None:
        self.schedule = FaultSchedule(FAULTS, self.faults)
        self._random = np.random.default_rng((self.seed, 1))

    @property
    def due(self) -> float:
        """Time of the next frame."""
        return self.power_on + (self.line + 1) / self.rate_hz

    def take_due(self, now: float) -> list[bytes]:
        """Return the bytes to send at a time. Frames that this process was too late for are left out."""
        if now >= self.due and (frame := self._next_frame(now)) is not None:
            self._waiting.append(frame)
        due = [data for time, data in self._waiting if time <= now]
        self._waiting = [one for one in self._waiting if one[0] > now]
        return due

    def _next_frame(self, now: float) -> tuple[float, bytes] | None:
        """Return the time and the bytes of the newest frame, None without new curvatures."""
        faults = self.schedule.by_kind(now)
        self.line = max(self.line + 1, int((now - self.power_on) * self.rate_hz))
        if "stuck" not in faults:
            if (found := self.curvatures(now)) is None:
                return None
            self._bends = np.array(found)
        if "frozen" not in faults or self._frame is None:
            self._frame = self.line, now, self._bends
        line, stamp, bends = self._frame
        if "nan" in faults:
            bends = np.where(np.arange(bends.shape[1]) == 0, np.nan, bends)
        error = int(faults["error"].detail) if "error" in faults else 0
        frame = encode_frame(line, stamp, bends, error=error)
        return reply_time(now, faults), damage_reply(frame, faults, self._random)


class FbgsServer(TcpServer):
    """Listening socket and its clients. A client that does not read loses whole frames, never a part of one."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self._unsent: dict[socket.socket, bytes] = {}

    def send(self, data: bytes) -> None:
        """Send a frame to each client, after what it has not accepted before."""
        kept, self._unsent = self._unsent, {}
        for client in list(self.clients):
            waiting = kept.get(client.socket, b"")
            whole = waiting if len(waiting) > _MOST_UNSENT else waiting + data
            try:
                sent = client.socket.send(whole) if whole else 0
            except BlockingIOError:
                sent = 0
            except OSError:
                self._drop(client)
                continue
            if sent < len(whole):
                self._unsent[client.socket] = whole[sent:]


def serve(
    session: FbgsSession,
    tcp: FbgsServer,
    orders: OrderSource,
    obey: Callable[[str], None],
    say: Callable[[str], None],
) -> NoReturn:
    """Send frames until interrupted.

    obey: called with each line of the orders; say: called with a line when connections are closed or possible again.
    """
    while True:
        advance(session, tcp, monotonic(), say)
        for order in orders.read(select.select(orders.sources, [], [], 0.0)[0]):
            obey(order)
        tcp.receive_lines(min(_TICK_S, max(0.0, session.due - monotonic())), deaf=False)


def advance(session: FbgsSession, tcp: FbgsServer, now: float, say: Callable[[str], None]) -> None:
    """Plug in or unplug, and send the frames that are due at a time (s)."""
    unplugged = "unplug" in session.schedule.by_kind(now)
    if unplugged == tcp.is_plugged:
        (tcp.unplug if unplugged else tcp.plug)()
        say("unplugged" if unplugged else "listens again")
    if session.schedule.since is None and tcp.clients:
        session.schedule.since = now
    for data in session.take_due(now):
        tcp.send(data)
