"""The web socket of a client: requests one by one, and messages as fast as the client reads them."""

import asyncio
import re
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from pydantic import ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from flexneedle.errors import make_printable
from flexneedle.lab.page.protocol import DoneMessage, RefusedMessage
from flexneedle.lab.page.requests import REQUESTS, AnyRequest, LoadRequest, RestoreRequest
from flexneedle.lab.page.server.clients import PageLimits, Refusal
from flexneedle.lab.page.server.hub import ClientOutbox
from flexneedle.lab.page.server.request_handler import RequestHandler

_TRY_LATER, _AGAINST_RULES = 1013, 1008
_LONGEST_REASON = 120  # bytes of the reason of a close frame, of which 123 are allowed
_LONGEST_NUMBER = 40
_NUMBER = re.compile(r'"request"\s*:\s*(\d{1,15})\s*\}\s*$')


class _Gone(Exception):
    """The client is gone."""


class _Closing(Exception):
    """The connection must be closed."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(code, reason)
        self.code, self.reason = code, reason


async def serve_client(socket: WebSocket, handler: RequestHandler) -> None:
    """Serve a client until it is gone or disconnected."""
    await socket.accept()
    try:
        client, outbox = handler.join()
    except Refusal as refusal:
        await _close(socket, _TRY_LATER, refusal.reason, handler.limits)
        return
    tasks = [
        asyncio.create_task(_read(socket, handler, client, outbox)),
        asyncio.create_task(_write(socket, outbox, handler.limits)),
    ]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        handler.leave(client, outbox)
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    for end in ends:
        if isinstance(end, _Closing):
            await _close(socket, end.code, end.reason, handler.limits)
        elif isinstance(end, Exception) and not isinstance(end, _Gone):
            raise end


async def _receive(socket: WebSocket) -> Mapping[str, Any]:
    with _convert_gone():
        message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise _Gone
    return message


async def _read(socket: WebSocket, handler: RequestHandler, client: int, outbox: ClientOutbox) -> None:
    while True:
        text = (await _receive(socket)).get("text")
        if outbox.waiting > handler.limits.answers:
            raise _Closing(_AGAINST_RULES, "too many requests whose answers were not read")
        _answer(handler, client, outbox, text)


def _answer(handler: RequestHandler, client: int, outbox: ClientOutbox, text: str | None) -> None:
    """Carry out a request, and answer it."""
    what, number = "message", _number(text)
    try:
        request = _parse(text, handler.limits.file_bytes)
        what, number = request.type, request.request
        if not isinstance(request, LoadRequest | RestoreRequest):
            _require_length(text, handler.limits.message_bytes)
        handler.carry_out(client, request)
    except Refusal as refusal:
        problems = refusal.problems
        outbox.answer(RefusedMessage(request=number, what=what, reason=refusal.reason, problems=problems))
    except Exception:  # noqa: BLE001  an error in a request must not disconnect other clients
        traceback.print_exc(file=sys.stderr)
        outbox.answer(
            RefusedMessage(request=number, what=what, reason="an error in the server, which has printed it")
        )
    else:
        if number is not None:
            outbox.answer(DoneMessage(request=number))


def _number(text: str | None) -> int | None:
    """Return the number at the end of a request, also of an invalid one, or None."""
    found = _NUMBER.search((text or "")[-_LONGEST_NUMBER:])
    return int(found[1]) if found else None


def _parse(text: str | None, longest: int) -> AnyRequest:
    """Return the request of a text of at most `longest` bytes. Raises Refusal for anything else."""
    _require_length(text, longest)
    try:
        return REQUESTS.validate_json(text or "")
    except ValueError as error:
        raise Refusal(_reason(error)) from None


def _require_length(text: str | None, longest: int) -> None:
    if text is None:
        raise Refusal("a message of bytes: must be text, a JSON object")
    length = len(text.encode())
    if length > longest:
        raise Refusal(f"a message of {length} bytes: must have at most {longest}")


def _reason(error: ValueError) -> str:
    """Return the first problem of a message in one line."""
    if not isinstance(error, ValidationError):
        return make_printable(str(error))
    detail = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(map(str, detail["loc"]))
    return make_printable(f"{where or 'message'}: {detail['msg']}")[:300]


@contextmanager
def _convert_gone() -> Iterator[None]:
    """Convert the errors of a socket whose client is gone to _Gone."""
    try:
        yield
    except (WebSocketDisconnect, RuntimeError, OSError) as error:
        if isinstance(error, TimeoutError):
            raise
        raise _Gone from None


async def _write(socket: WebSocket, outbox: ClientOutbox, limits: PageLimits) -> None:
    while True:
        message = await outbox.next()
        try:
            async with asyncio.timeout(limits.send_s):
                with _convert_gone():
                    if isinstance(message, str):
                        await socket.send_text(message)
                    else:
                        await socket.send_bytes(message)
        except TimeoutError:
            raise _Closing(_TRY_LATER, f"nothing was read for {limits.send_s:g} s") from None


async def _close(socket: WebSocket, code: int, reason: str, limits: PageLimits) -> None:
    if socket.application_state is WebSocketState.DISCONNECTED:
        return
    with suppress(TimeoutError, _Gone), _convert_gone():
        async with asyncio.timeout(limits.send_s):
            await socket.close(code, reason[:_LONGEST_REASON])
