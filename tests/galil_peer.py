"""A controller in a thread: the emulated one behind a line that a test may damage."""

import socket
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field

from emulated import until
from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply

CLOSE = object()
"""In place of a reply: the connection is closed."""


@dataclass
class Peer:
    """Answers lines; `damage` makes what is sent of a line and its true reply, None for nothing."""

    port: int
    device: ControllerState = field(default_factory=ControllerState)
    damage: object = None
    lines: list = field(default_factory=list)

    def answer(self, line):
        """Return the bytes that are sent in reply to a line."""
        self.lines.append(line)
        self.device, true = reply(advance_controller(self.device, 5), line)
        return true.encode() if self.damage is None else self.damage(line, true.encode())


def settled(motors):
    """The states once all channels rest."""
    found = {}

    def rest():
        found.update(motors.read())
        return not any(state.moving for state in found.values())

    until(rest)
    return found


@contextmanager
def peer(device=None):
    """Give a controller that listens at `port` of 127.0.0.1; one connection after another."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        found = Peer(listening.getsockname()[1], device or ControllerState())
        thread = threading.Thread(target=_serve, args=(listening, found), daemon=True)
        thread.start()
        yield found
        listening.shutdown(socket.SHUT_RDWR)
        thread.join(timeout=10.0)


def _serve(listening, found):
    while True:
        try:
            connection, _ = listening.accept()
        except OSError:
            return
        with connection:
            _converse(connection, found)


def _converse(connection, found):
    received = b""
    while True:
        try:
            data = connection.recv(4096)
            if not data:
                return
            *complete, received = (received + data).split(b"\r")
            for line in complete:
                sent = found.answer(line.decode("ascii", "replace"))
                if sent is CLOSE:
                    return
                if sent:
                    connection.sendall(sent)
        except OSError:
            return
