"""How much a client may ask, and how long the server waits."""

from dataclasses import dataclass

_BYTES_OF_A_MESSAGE = 4_000


@dataclass(frozen=True)
class Limits:
    """Limits of clients and waits; `_s` in seconds.

    message_bytes: of a message but a scenario file's; rate and burst: messages a second, and at once, where each
    4000 bytes count as one more; excess: refused messages after which a client is disconnected.
    """

    clients: int = 32
    message_bytes: int = 16_000
    file_bytes: int = 380_000
    rate: float = 100.0
    burst: float = 200.0
    excess: int = 1_000
    answers: int = 500
    ping_s: float = 1.0
    pong_s: float = 10.0
    silent_s: int = 10
    """A connection that is no web socket is closed when it has asked for nothing for this time, or up to twice it."""
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


class Rate:
    """The budget of a client: full at first, refilled with time."""

    def __init__(self, limits: Limits, now: float) -> None:
        self._limits, self._left, self._then = limits, limits.burst, now
        self.refused = 0

    def allows(self, size: int, now: float) -> bool:
        """Whether a message of `size` bytes at the time `now` (s) is within the budget, from which it is taken."""
        limits = self._limits
        self._left = min(limits.burst, self._left + (now - self._then) * limits.rate)
        self._then = now
        cost = 1.0 + size / _BYTES_OF_A_MESSAGE
        if cost > self._left:
            self.refused += 1
            return False
        self._left -= cost
        return True

    @property
    def exhausted(self) -> bool:
        """Whether so many messages were refused that the client is disconnected."""
        return self.refused > self._limits.excess
