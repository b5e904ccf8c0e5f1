"""Connections that are no web sockets: not more than the server has descriptors for, and none that asks for nothing.

uvicorn's own limit counts those that ask for nothing, and refuses those that ask.
"""

import asyncio
import resource

from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

_MOST = 512
"""Connections at once: 32 pages of browsers that open six each are 192."""
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\ncontent-type: text/plain\r\nconnection: close\r\n\r\n"
    b"too many connections: try again in a moment\n"
)


def most_connections() -> int:
    """Number of connections at once: at most half of the descriptors of this process, which it needs for more."""
    descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return _MOST if descriptors == resource.RLIM_INFINITY else min(_MOST, descriptors // 2)


class Connection(H11Protocol):
    """A connection that is closed if it has asked for nothing during the time for which idle ones are kept."""

    _before: RequestResponseCycle | None = None
    """The newest request at the last look."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, or refuse if there are too many."""
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.write(_FULL)
            transport.close()
        else:
            self._watch()

    def _watch(self) -> None:
        self.loop.call_later(self.timeout_keep_alive, self._look)

    def _look(self) -> None:
        is_web_socket = self.transport.get_protocol() is not self
        if is_web_socket or self.transport.is_closing():
            return
        newest: RequestResponseCycle | None = self.cycle
        if newest is self._before and (newest is None or newest.response_complete):
            self.transport.close()
        else:
            self._before = newest
            self._watch()
