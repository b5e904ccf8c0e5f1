"""The TCP line to a Galil controller: lines of commands and queries, and the replies to them, within a time limit.

A reply belongs to the line before it and to no other. If this is in doubt (no reply in time, garbled or surplus bytes,
an unsolicited message, a broken connection), the connection is closed, so that late data are attributed to no command;
every call is refused until `open`.
"""

import socket
from collections.abc import Sequence
from contextlib import suppress
from time import monotonic

from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.replies import (
    GarbledError,
    Reply,
    format_commands,
    parse_numbers,
    parse_replies,
    parse_text,
    split_lines,
)

_LARGEST_REPLY = 4096  # bytes; a reply to the longest line has a few hundred
_MOST_UNREAD = 1 << 20
_END = b"\r"
_REASON = "TC1"
_REMEDY = "check the power, the cable and the address of the controller, and start again"


class Link:
    """A connection to a controller, which `open` makes. Not for several threads.

    farewell: a line that is sent before a connection is closed because of a failure, without waiting for replies: the
    stop of motors whose state is unknown. Deadlines are times of the monotonic clock; a reply that arrives in
    time counts even if this process reads it late. Raises DriverError if the host is unknown (that look-up, and no
    later call, may take seconds).
    """

    def __init__(self, host: str, port: int) -> None:
        self.farewell = ""
        self.name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise DriverError(f"{self.name}: unknown host: {reason}") from None
        # IPv4 first, which is all that the controllers have.
        best = min(found, key=lambda each: each[0] != socket.AF_INET)
        self._family, self._address = best[0], best[4]
        self._socket: socket.socket | None = None
        self._closed = "not connected yet"

    @property
    def address(self) -> str:
        """IP address and port, also if the host was given by name."""
        return ":".join(map(str, self._address[:2]))

    @property
    def is_open(self) -> bool:
        """Whether a line can be sent."""
        return self._socket is not None

    def open(self, deadline: float) -> None:
        """Open a new connection in place of an open one. Raises DriverError."""
        self.close()
        connection = socket.socket(self._family, socket.SOCK_STREAM)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(_remaining_time(deadline))
            connection.connect(self._address)
        except OSError as error:
            connection.close()
            self._closed = f"no connection: {_reason(error)}"
            raise DriverError(f"{self.name}: {self._closed}; {_REMEDY}") from None
        self._socket = connection

    def ask(self, commands: Sequence[str], deadline: float) -> tuple[Reply, ...]:
        """Send commands, and return the reply to each. Commands that fit into a line are executed one after another.

        Raises DriverError, and closes the connection, if the replies are not there at the deadline or are not replies
        to these commands.
        """
        return tuple(
            reply for line in split_lines(tuple(commands)) for reply in self._exchange(line, deadline)
        )

    def do(self, commands: Sequence[str], deadline: float) -> None:
        """Have commands carried out. Raises DriverError, with the controller's reason if it refuses one."""
        if any(self._data(commands, deadline)):
            raise self.close_in_doubt(f"data in the reply to {format_commands(commands)}")

    def numbers(
        self, queries: Sequence[str], counts: Sequence[int], deadline: float
    ) -> list[tuple[float, ...]]:
        """Return the answers to queries, `counts` numbers each. Raises DriverError, as in `do`."""
        found = self._data(queries, deadline)
        try:
            return [parse_numbers(data, count) for data, count in zip(found, counts, strict=True)]
        except GarbledError as error:
            raise self.close_in_doubt(f"{error} (to {format_commands(queries)})") from None

    def text(self, query: str, deadline: float) -> str:
        """Return the line of text that answers a query. Raises DriverError, as in `do`."""
        (data,) = self._data([query], deadline)
        try:
            return parse_text(data)
        except GarbledError as error:
            raise self.close_in_doubt(str(error)) from None

    def _data(self, commands: Sequence[str], deadline: float) -> tuple[str, ...]:
        """Return the data in the replies to commands that are all accepted."""
        replies = self.ask(commands, deadline)
        refused = [command for command, reply in zip(commands, replies, strict=True) if not reply.accepted]
        if refused:
            why = self._reason_of(refused, deadline)
            raise DriverError(f"{self.name}: {format_commands(refused)} refused: {why}")
        return tuple(reply.data for reply in replies)

    def _reason_of(self, refused: Sequence[str], deadline: float) -> str:
        """Return the controller's reason, its code and text, for the last refused command."""
        if _REASON in refused:
            return "no reason given"
        try:
            return self.text(_REASON, deadline)
        except DriverError as error:
            return f"unknown reason: {error}"

    def _exchange(self, line: tuple[str, ...], deadline: float) -> tuple[Reply, ...]:
        if self._socket is None:
            raise DriverError(f"{self.name}: not connected: {self._closed}; {_REMEDY}")
        shown = format_commands(line)
        if monotonic() >= deadline:  # before anything is sent: later replies are not in doubt
            raise DriverError(f"{self.name}: no time left for {shown}")
        try:
            _require_silence(self._socket)
            self._socket.settimeout(_remaining_time(deadline))
            self._socket.sendall(";".join(line).encode("ascii") + _END)
        except OSError as error:  # perhaps in the middle of a line: nothing may follow
            self.close(_reason(error))
            raise DriverError(f"{self.name}: {shown} not sent: {_reason(error)}; {_REMEDY}") from None
        except GarbledError as error:
            raise self.close_in_doubt(f"{error} (before {shown})") from None
        try:
            return self._receive_replies(self._socket, len(line), deadline)
        except (OSError, GarbledError) as error:
            raise self.close_in_doubt(f"{_reason(error)} (to {shown})") from None

    def _receive_replies(self, connection: socket.socket, count: int, deadline: float) -> tuple[Reply, ...]:
        received = b""
        while (replies := parse_replies(received, count)) is None:
            connection.settimeout(max(0.0, deadline - monotonic()))
            data = connection.recv(_LARGEST_REPLY)
            if not data:
                raise ConnectionResetError
            received += data
            if len(received) > _LARGEST_REPLY:
                raise GarbledError(f"a reply of more than {_LARGEST_REPLY} bytes")
        return replies

    def close_in_doubt(self, problem: str) -> DriverError:
        """Send the farewell and close a connection whose replies are in doubt; return the error to raise."""
        if self._socket is not None and self.farewell:
            with suppress(OSError):
                self._socket.setblocking(False)
                self._socket.send(self.farewell.encode("ascii") + _END)
                self._socket.shutdown(socket.SHUT_WR)
                # With unread data, closing would be a reset, and the farewell would be lost.
                self._socket.recv(_MOST_UNREAD)
        self.close(problem)
        return DriverError(f"{self.name}: {problem}; {_REMEDY}")

    def close(self, why: str = "closed") -> None:
        """Close the connection."""
        if self._socket is None:
            return
        self._closed = why
        self._socket.close()
        self._socket = None


def _require_silence(connection: socket.socket) -> None:
    """Raise GarbledError if there is data before anything was asked: replies and commands would no longer match."""
    connection.setblocking(False)
    with suppress(BlockingIOError):
        data = connection.recv(_LARGEST_REPLY)
        if not data:
            raise ConnectionResetError
        raise GarbledError(f"unsolicited data: {data[:40]!r}")


def _remaining_time(deadline: float) -> float:
    left = deadline - monotonic()
    if left <= 0.0:
        raise TimeoutError
    return left


def _reason(error: OSError | GarbledError) -> str:
    if isinstance(error, TimeoutError | BlockingIOError):
        return "no reply in time"
    if isinstance(error, ConnectionError) and error.strerror is None:
        return "the controller closed the connection"
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)
