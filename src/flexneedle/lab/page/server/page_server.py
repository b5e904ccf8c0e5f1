"""The server of the page: listens until Ctrl-C."""

import logging
import socket
from collections.abc import Callable
from typing import Any

import uvicorn

from flexneedle.errors import InputError
from flexneedle.lab.page.server.access import AccessRules, is_loopback
from flexneedle.lab.page.server.app import make_application
from flexneedle.lab.page.server.clients import PageLimits
from flexneedle.lab.page.server.request_handler import PageSetup, RequestHandler

_SEND_BUFFER = 131_072
"""Bytes that the system buffers for a client: with more, a slow client would receive a queue of old messages."""
_LONGEST_MESSAGE = 1_000_000
"""Bytes of a request above which the connection is closed; a shorter request that is too long is refused."""


class PageServer(uvicorn.Server):
    """A server of the page; call `serve_until_interrupted`."""

    def __init__(self, setup: PageSetup, host: str, port: int) -> None:
        """Listen on a host and a port (0: any free one). Raises InputError if the address is not available."""
        self.socket = bind(host, port, setup.limits)
        self.handler = RequestHandler(setup)
        self._host, self._port = host, int(self.socket.getsockname()[1])
        rules = AccessRules.of(host, self._port)
        self._token = rules.token
        self.on_start: Callable[[], None] = lambda: None
        super().__init__(_config(make_application(self.handler, rules), setup.limits))

    @property
    def address(self) -> str:
        """Address for a browser, with the token if one is needed."""
        shown = socket.gethostname() if self._host in ("0.0.0.0", "::", "") else self._host
        shown = f"[{shown}]" if ":" in shown else shown
        return f"http://{shown}:{self._port}/{f'?token={self._token}' if self._token else ''}"

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen."""
        await super().startup(sockets)
        self.on_start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop the insertion first, then the connections."""
        self.handler.halt()
        await super().shutdown(sockets)

    def serve_until_interrupted(self) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        try:
            self.run([self.socket])
        except KeyboardInterrupt:  # which uvicorn raises again when all is ended
            return
        finally:
            self.socket.close()


def bind(host: str, port: int, limits: PageLimits) -> socket.socket:
    """Return the socket of a host and a port. Raises InputError."""
    try:
        family, kind, protocol, _name, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listening = socket.socket(family, kind, protocol)
    except OSError as error:
        raise InputError(f"--host {host}: {error.strerror or error}") from None
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # the end of a lost client must not wait for its data
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * limits.send_s))
        listening.bind(address)
    except OSError as error:
        listening.close()
        remedy = "choose another with --port" if is_loopback(host) else "choose others with --host and --port"
        raise InputError(f"cannot listen on {host}, port {port}: {error.strerror}; {remedy}") from None
    return listening


def _is_an_error(record: logging.LogRecord) -> bool:
    """Return whether a record of uvicorn reports an error. Refusing a web socket is not an error."""
    return not record.getMessage().startswith("ASGI callable returned without completing handshake")


def _config(application: Any, limits: PageLimits) -> uvicorn.Config:
    logging.getLogger("uvicorn.error").addFilter(_is_an_error)
    return uvicorn.Config(
        application,
        loop="asyncio",
        http="h11",
        ws="websockets-sansio",
        ws_max_size=_LONGEST_MESSAGE,
        ws_ping_interval=limits.ping_s,
        ws_ping_timeout=limits.pong_s,
        ws_per_message_deflate=False,
        lifespan="on",
        log_config=None,
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_keep_alive=limits.silent_s,
        timeout_graceful_shutdown=2,
    )
