"""Emulated controller on TCP, with its time and faults. It runs until interrupted.

Its motors run in real time, even while this process does not run: before each command, and every few milliseconds, all
samples up to the present are computed.
"""

import os
import select
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import NoReturn, Self

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.emulators.faults import SECONDS, Fault, FaultKind, FaultSchedule, damage_reply, reply_time
from flexneedle.lab.emulators.galil import motor_axis as one
from flexneedle.lab.emulators.galil.axis_commands import ERRORS
from flexneedle.lab.emulators.galil.controller import (
    AXES,
    SAMPLES_HZ,
    ControllerState,
    advance_controller,
    reply,
)
from flexneedle.lab.emulators.galil.motor_axis import MotorAxis
from flexneedle.lab.emulators.orders import OrderSource

_TICK_S = 0.004
_SAMPLES = 5  # of the controller at once: 5 ms
_LONGEST_LINE = 4096
_MOST_CLIENTS = 8


def _fault_of_axis(text: str) -> FaultKind:
    return FaultKind(text, AXES[0], "axis", tuple(AXES))


FAULTS = {
    "stall": _fault_of_axis("a motor does not move (A, or stall=AXIS)"),
    "lag": _fault_of_axis("a motor follows late, by 0.15 s (A, or lag=AXIS)"),
    "overshoot": _fault_of_axis("a motor goes a fifth too far (A, or overshoot=AXIS)"),
    "reversed": _fault_of_axis("a motor turns the wrong way (A, or reversed=AXIS)"),
    "limit": _fault_of_axis("both limit switches of an axis are active (A, or limit=AXIS)"),
    "off": _fault_of_axis("a motor is switched off (A, or off=AXIS)"),
    "reset": _fault_of_axis("the position of an axis becomes 0 (A, or reset=AXIS)"),
    "refuse": FaultKind(
        "every command but TC is answered by ? (7, or refuse=CODE)",
        "7",
        "error code",
        tuple(map(str, ERRORS)),
    ),
    "silence": FaultKind("commands are carried out, but not answered"),
    "garbled": FaultKind("a byte of each reply is changed"),
    "cut": FaultKind("half of each reply is sent"),
    "chatter": FaultKind("an unsolicited message precedes each reply"),
    "half-open": FaultKind("nothing is received and nothing answered; the connection stays"),
    "delay": FaultKind("replies are delayed (0.2, or delay=SECONDS)", "0.2", SECONDS),
    "unplug": FaultKind("connections are closed, and refused for the duration"),
}
"""The kinds of fault of the controller; their times are since the first motion."""

_OF_MOTORS = one.FAULTS
_CHATTER = b" 17.0000\r\n"


Observer = Callable[[float, Sequence[float], bool], None]
"""Called with a time (s, monotonic), the travel of each motor since power-on (counts, independent of DP),
and whether one moves, or has been commanded to, from then on."""


@dataclass
class GalilSession:
    """Controller and its faults over time. Times are monotonic, in seconds; power_on is the first.

    faults: scheduled, from when an axis first moves; seed: of garbled replies; done: faults of one instant that have
    happened. observe: called after every few samples, and after every command.
    """

    device: ControllerState
    faults: Sequence[Fault]
    power_on: float
    seed: int = 0
    observe: Observer | None = None
    _samples: int = 0
    _done: set[Fault] = field(default_factory=set)
    _travel: tuple[float, ...] = (0.0,) * len(AXES)

    def __post_init__(self) -> None:
        self.schedule = FaultSchedule(FAULTS, self.faults)
        self._random = np.random.default_rng((self.seed, 1))

    @property
    def _sample_time(self) -> float:
        """Time of the last sample."""
        return self.power_on + self._samples / SAMPLES_HZ

    def advance(self, now: float) -> None:
        """Advance the axes to `now`, with their faults, a few samples at a time."""
        due = int((now - self.power_on) * SAMPLES_HZ) - self._samples
        while due > _SAMPLES:
            self._advance(self.power_on + (self._samples + _SAMPLES) / SAMPLES_HZ, _SAMPLES)
            due -= _SAMPLES
        self._advance(now, max(0, due))

    def _advance(self, now: float, samples: int) -> None:
        if self.schedule.since is None and any(axis.running for axis in self.device.axes):
            self.schedule.since = self._sample_time
        present = self.schedule.at(now)
        before = tuple(self._with_faults(axis, AXES[k], present) for k, axis in enumerate(self.device.axes))
        self.device = advance_controller(replace(self.device, axes=before), samples)
        self._samples += samples
        self._report_travel(
            [after.encoder - axis.encoder for axis, after in zip(before, self.device.axes, strict=True)]
        )

    def _report_travel(self, moved: Sequence[float]) -> None:
        """Report the travel after a motion (counts) to the observer."""
        self._travel = tuple(travel + step for travel, step in zip(self._travel, moved, strict=True))
        if self.observe is not None:
            moving = any(axis.running and not axis.profile.at_rest for axis in self.device.axes)
            self.observe(self._sample_time, self._travel, moving or any(moved))

    def _with_faults(self, axis: MotorAxis, name: str, present: Sequence[Fault]) -> MotorAxis:
        of_this = {fault.kind: fault for fault in present if fault.detail == name}
        for kind, change in _ONCE.items():
            if kind in of_this and of_this[kind] not in self._done:
                self._done.add(of_this[kind])
                axis = change(axis)
        return replace(axis, fault=next((kind for kind in _OF_MOTORS if kind in of_this), one.FOLLOWS))

    def reply(self, line: str, now: float) -> tuple[float, bytes]:
        """Return time and data of the reply to a line (b"": no reply)."""
        self.advance(now)
        faults = self.schedule.by_kind(now)
        if "refuse" in faults:
            self.device, answer = _refuse(self.device, line, int(faults["refuse"].detail))
        else:
            self.device, answer = reply(self.device, line)
        self._report_travel([0.0] * len(AXES))
        complete = _CHATTER * ("chatter" in faults) + answer.encode("ascii", "replace")
        return reply_time(now, faults), damage_reply(complete, faults, self._random)


def _refuse(device: ControllerState, line: str, code: int) -> tuple[ControllerState, str]:
    """Refuse every command of a line but TC with this code; return the state and the replies."""
    answers = []
    for command in line.split(";"):
        if command.strip().startswith("TC"):
            device, answer = reply(device, command)
        else:
            device, answer = replace(device, error=code), "?"
        answers.append(answer)
    return device, "".join(answers)


_ONCE: dict[str, Callable[[MotorAxis], MotorAxis]] = {
    "off": one.switch_off,
    "reset": lambda axis: one.define_position(axis, 0.0),
}
"""Faults of one instant."""


@dataclass
class _Client:
    """A connection: the begin of a line, and replies that are due."""

    socket: socket.socket
    received: bytes = b""
    due: list[tuple[float, bytes]] = field(default_factory=list)


class TcpServer:
    """Listening socket and its connections. Use it as a context manager.

    Raises InputError if the address cannot be used.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = host, port
        self._listening: socket.socket | None = None
        self.clients: list[_Client] = []

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.unplug()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port on which it listens."""
        return self._address

    @property
    def is_plugged(self) -> bool:
        """True while it listens."""
        return self._listening is not None

    def plug(self) -> None:
        """Listen. Raises InputError."""
        host, port = self._address
        try:
            self._listening = socket.create_server((host, port), reuse_port=False)
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else error
            rule = f"cannot be listened on: {reason}: end what uses it, or choose another port"
            raise InputError(f"{host}:{port}: {rule}") from None
        self._listening.setblocking(False)
        self._address = host, self._listening.getsockname()[1]

    def unplug(self) -> None:
        """Close all connections, and listen no more."""
        for client in self.clients:
            client.socket.close()
        self.clients = []
        if self._listening is not None:
            self._listening.close()
        self._listening = None

    def receive_lines(self, idle: float, *, deaf: bool) -> list[tuple[_Client, str]]:
        """Wait for at most `idle` seconds; return the lines received, by connection. deaf: nothing is received."""
        sources = [] if self._listening is None else [self._listening]
        sources += [] if deaf else [client.socket for client in self.clients]
        ready, _, _ = select.select(sources, [], [], idle)
        if self._listening in ready and self._listening is not None:
            with suppress(BlockingIOError):
                self._accept(self._listening.accept()[0])
        return [
            (client, line)
            for client in list(self.clients)
            if client.socket in ready
            for line in self._read(client)
        ]

    def _accept(self, connection: socket.socket) -> None:
        if len(self.clients) == _MOST_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.clients.append(_Client(connection))

    def _read(self, client: _Client) -> list[str]:
        try:
            data = client.socket.recv(_LONGEST_LINE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return []
        *lines, client.received = (client.received + data)[-_LONGEST_LINE:].split(b"\r")
        return [line.strip(b"\n").decode("ascii", "replace") for line in lines]

    def _drop(self, client: _Client) -> None:
        client.socket.close()
        self.clients.remove(client)

    def send_due(self, now: float) -> None:
        """Send the replies that are due; data that a connection does not accept at once are lost."""
        for client in list(self.clients):
            while client.due and client.due[0][0] <= now:
                try:
                    client.socket.send(client.due.pop(0)[1])
                except BlockingIOError:
                    continue
                except OSError:
                    self._drop(client)
                    break


def serve(
    session: GalilSession,
    tcp: TcpServer,
    orders: OrderSource,
    obey: Callable[[str], None],
    say: Callable[[str], None],
) -> NoReturn:
    """Answer commands until interrupted.

    obey: called with each line of the orders; say: called with a line when connections are closed or possible again.
    """
    while True:
        now = monotonic()
        faults = session.schedule.by_kind(now)
        if ("unplug" in faults) == tcp.is_plugged:
            (tcp.unplug if tcp.is_plugged else tcp.plug)()
            say("listens again" if tcp.is_plugged else "unplugged")
        for client, line in tcp.receive_lines(_TICK_S, deaf="half-open" in faults):
            client.due.append(session.reply(line, monotonic()))
        for order in orders.read(select.select(orders.sources, [], [], 0.0)[0]):
            obey(order)
        now = monotonic()
        session.advance(now)
        tcp.send_due(now)
