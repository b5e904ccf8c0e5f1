"""Access control: Host, Origin and token checks of every request, and headers of every response."""

import re
import secrets
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from flexneedle.arguments import shorten

_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?")
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "font-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-cache",
}


@dataclass(frozen=True)
class AccessRules:
    """Conditions of a request.

    Attributes:
        names: Host names of this server.
        literal: Whether any address is accepted as a host, too.
        token: Token of the server, "" if none is needed.
        cookie: Name of the cookie with the token.
    """

    names: frozenset[str]
    literal: bool
    token: str = ""
    cookie: str = "flexneedle"

    @classmethod
    def of(cls, host: str, port: int) -> "AccessRules":
        """Return the rules of a server on a host: with a token unless only this computer reaches it.

        A foreign page can resolve its name to this server (DNS rebinding), but not an address.
        """
        if is_loopback(host):
            return cls(frozenset((*_LOOPBACK, host.lower())), literal=False)
        here = socket.gethostname().lower()
        names = frozenset((*_LOOPBACK, host.lower(), here, f"{here}.local"))
        return cls(names, literal=True, token=secrets.token_urlsafe(24), cookie=f"flexneedle-{port}")

    def refuse(
        self, headers: Headers, query: str, *, socket: bool, page: bool = False
    ) -> tuple[int, str] | None:
        """Return status and reason of a refusal, None if the request may pass.

        page: whether the request is for the page itself, to which any site may link.
        """
        host = headers.get("host", "")
        if len(headers.getlist("host")) != 1 or not self._is_here(host):
            choices = ", ".join(sorted(self.names)) + (" or an address" if self.literal else "")
            return 403, f"Host = {shorten(host)}: must be one of {choices}"
        origin = headers.get("origin")
        if origin is None and socket:
            return 403, "Origin is missing: only the page itself may connect"
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return 403, f"Origin = {shorten(origin)}: must be http://{host}, only the page itself may connect"
        if not page and headers.get("sec-fetch-site") == "cross-site":
            return 403, "Sec-Fetch-Site = cross-site: only the page itself may ask for this"
        if self.token and not any(
            secrets.compare_digest(given.encode(), self.token.encode())
            for given in self._tokens(headers, query)
        ):
            return 401, "the token is missing or wrong: open the address that flexneedle serve has printed"
        return None

    def _is_here(self, host: str) -> bool:
        if not _HOST.fullmatch(host):
            return False
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # brackets without an address
            return False
        return name in self.names or (self.literal and _is_address(name))

    def _tokens(self, headers: Headers, query: str) -> Iterable[str]:
        yield from parse_qs(query).get("token", [])
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return
        if self.cookie in cookies:
            yield cookies[self.cookie].value


class AccessGuard:
    """An application behind access rules; adds security headers to each response."""

    def __init__(self, app: ASGIApp, rules: AccessRules) -> None:
        self._app, self._rules = app, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, or refuse it (ASGI)."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        query, is_socket = scope["query_string"].decode("latin-1"), scope["type"] == "websocket"
        page = scope["path"] == "/"
        refused = self._rules.refuse(Headers(scope=scope), query, socket=is_socket, page=page)
        if refused is None and not is_socket and self._rules.token and "token" in parse_qs(query):
            answer: Response | None = self._sign_in(scope["path"])
        else:
            answer = None if refused is None else PlainTextResponse(refused[1] + "\n", refused[0])
        if answer is None:
            await self._app(scope, receive, send if is_socket else _with_headers(send))
        elif is_socket:
            await WebSocket(scope, receive, send).send_denial_response(answer)
        else:
            await answer(scope, receive, _with_headers(send))

    def _sign_in(self, path: str) -> Response:
        """Set the cookie, and redirect to the address without the token, which a history or log would keep."""
        answer = RedirectResponse(path if path.startswith("/") and path[1:2] not in ("/", "\\") else "/", 303)
        # Not "strict": a link to the page on another site works, too. Sockets are checked by Origin.
        answer.set_cookie(self._rules.cookie, self._rules.token, httponly=True, samesite="lax")
        return answer


def is_loopback(host: str) -> bool:
    """Return whether only this computer reaches a host."""
    return host.lower() == "localhost" or (_is_address(host) and ip_address(host).is_loopback)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(_HEADERS)
        await send(message)

    return sending
