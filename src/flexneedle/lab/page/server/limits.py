"""How much a client may ask, and how long the server waits."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Limits of clients and waits; `_s` in seconds.

    message_bytes: of a message but a scenario file's; answers: unread answers before a client is disconnected.
    """

    clients: int = 32
    message_bytes: int = 16_000
    file_bytes: int = 380_000
    answers: int = 500
    ping_s: float = 1.0
    pong_s: float = 10.0
    silent_s: int = 10
    """An HTTP connection is closed when it has been idle for this time after a response."""
    send_s: float = 10.0
    """A client that does not take a message for this time is disconnected."""
    rest_s: float = 0.1
    """The scenario is planned when it has not changed for this time."""
    alone_s: float = 5.0
    """Without clients for this time, work is cancelled."""
    armed_s: float = 60.0
    """A rig that was armed and not started for this time is disarmed."""
    cancel_s: float = 1.0
    """A worker that has not cancelled by then is ended."""
    close_s: float = 20.0
    """The same where it reads devices or files, which it has to close."""
    stop_s: float = 5.0
    """A worker that has not stopped an insertion by then is ended; the supervisor has stopped its rig before."""
    record_s: float = 30.0
    """At the end of the server, a worker that has not completed the record of an insertion by then is ended."""
    runs_s: float = 5.0
    """Time between two looks at the folder of runs."""


RIG = Limits(ping_s=0.5, pong_s=1.5, send_s=1.5)
"""With a connected rig: a client that is silent is lost after 2 s at most, the sum of the first two."""
