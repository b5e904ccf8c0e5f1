"""Clients, the one in control, their limits, and refusals of their requests."""

from collections.abc import Mapping
from dataclasses import dataclass

from flexneedle.lab.page.protocol import ClientsMessage


class Refusal(Exception):
    """A request is refused: the reason in one line, and problems by key of the scenario."""

    def __init__(self, reason: str, problems: Mapping[str, str] | None = None) -> None:
        super().__init__(reason)
        self.reason, self.problems = reason, dict(problems or {})


@dataclass(frozen=True)
class PageLimits:
    """Limits of clients, and times (s) that the server waits.

    Attributes:
        clients: Number of clients.
        message_bytes: Size of a request without a scenario file.
        file_bytes: Size of a request with a scenario file.
        answers: Number of unread answers, above which a client is disconnected.
        ping_s: Time between two pings of a web socket.
        pong_s: Time without an answer to a ping after which a client is disconnected.
        silent_s: Time without a further request after which an HTTP connection is closed.
        send_s: Time for which a client may not accept a message; then it is disconnected.
        rest_s: Time without an edit after which the scenario is planned.
        alone_s: Time without clients after which work is cancelled.
        armed_s: Time after which an armed rig that was not started is disarmed.
        cancel_s: Time after which a worker that has not cancelled is killed.
        close_s: The same for a job that has devices or files to close.
        stop_s: Time after which a worker that has not stopped its insertion is killed; the supervisor has stopped the
            rig before.
        record_s: Time for a worker to complete the record of an insertion when the server ends.
        runs_s: Time between two reads of the folder of runs.
    """

    clients: int = 32
    message_bytes: int = 16_000
    file_bytes: int = 380_000
    answers: int = 500
    ping_s: float = 1.0
    pong_s: float = 10.0
    silent_s: int = 10
    send_s: float = 10.0
    rest_s: float = 0.1
    alone_s: float = 5.0
    armed_s: float = 60.0
    cancel_s: float = 1.0
    close_s: float = 20.0
    stop_s: float = 5.0
    record_s: float = 30.0
    runs_s: float = 5.0


RIG_LIMITS = PageLimits(ping_s=0.5, pong_s=1.5, send_s=1.5)
"""Limits with a connected rig: a silent client is lost after at most 2 s, the sum of the first two."""


class Clients:
    """Clients by number; at most one of them is in control."""

    def __init__(self) -> None:
        self.connected = set[int]()
        self.in_control: int | None = None
        self._last = 0

    def join(self) -> int:
        """Add a client and return its number."""
        self._last += 1
        self.connected.add(self._last)
        return self._last

    def leave(self, client: int) -> None:
        """Remove a client; it loses control."""
        self.connected.discard(client)
        if self.in_control == client:
            self.in_control = None

    def steer(self, client: int, take: bool, over: int | None = None) -> None:
        """Give a client control, or take it from the client. over: client that may lose it to this one.

        Raises Refusal if another client is in control.
        """
        if self.in_control not in (None, client) and not (take and self.in_control == over):
            raise Refusal(f"person {self.in_control} is in control: take over from this person first")
        self.in_control = client if take else None

    def require_control(self, client: int) -> None:
        """Raise Refusal unless a client is in control."""
        if self.in_control is None:
            raise Refusal("nobody is in control: take control first")
        if self.in_control != client:
            raise Refusal(f"person {self.in_control} is in control: take over from this person first")

    def describe(self) -> ClientsMessage:
        """Return the message about clients and control."""
        return ClientsMessage(clients=len(self.connected), steering=self.in_control)
