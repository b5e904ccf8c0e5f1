"""The web socket of a client: its requests one after the other, and the news as fast as it takes them."""

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
from flexneedle.lab.page.messages import REQUESTS, AnyRequest, Done, Load, Refused
from flexneedle.lab.page.server.desk import Desk
from flexneedle.lab.page.server.hub import Outbox
from flexneedle.lab.page.server.limits import Limits
from flexneedle.lab.page.server.refusal import Refusal

_TRY_LATER, _AGAINST_RULES = 1013, 1008
_LONGEST_REASON = 120  # bytes of the reason of a close frame, of which 123 are allowed
_LONGEST_NUMBER = 40
_NUMBER = re.compile(r'"request"\s*:\s*(\d{1,15})\s*\}\s*$')


class _Gone(Exception):
    """The client is gone."""


class _Closing(Exception):
    """The connection is to be closed."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(code, reason)
        self.code, self.reason = code, reason


async def live(socket: WebSocket, desk: Desk) -> None:
    """Serve a client until it is gone or disconnected."""
    await socket.accept()
    try:
        client, outbox = desk.join()
    except Refusal as refusal:
        await _close(socket, _TRY_LATER, refusal.reason, desk.limits)
        return
    tasks = [
        asyncio.create_task(_read(socket, desk, client, outbox)),
        asyncio.create_task(_write(socket, outbox, desk.limits)),
    ]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        desk.leave(client, outbox)
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    for end in ends:
        if isinstance(end, _Closing):
            await _close(socket, end.code, end.reason, desk.limits)
        elif isinstance(end, Exception) and not isinstance(end, _Gone):
            raise end


async def _received(socket: WebSocket) -> Mapping[str, Any]:
    with _gone():
        received = await socket.receive()
    if received["type"] == "websocket.disconnect":
        raise _Gone
    return received


async def _read(socket: WebSocket, desk: Desk, client: int, outbox: Outbox) -> None:
    while True:
        text = (await _received(socket)).get("text")
        if outbox.waiting > desk.limits.answers:
            raise _Closing(_AGAINST_RULES, "too many requests whose answers were not read")
        _answer(desk, client, outbox, text)


def _answer(desk: Desk, client: int, outbox: Outbox, text: str | None) -> None:
    """Carry out a request, and answer it."""
    what, number = "message", _number(text)
    try:
        request = _parsed(text, desk.limits.file_bytes)
        what, number = request.type, request.request
        if not isinstance(request, Load):
            _require_length(text, desk.limits.message_bytes)
        desk.carry_out(client, outbox, request)
    except Refusal as refusal:
        problems = refusal.problems
        outbox.answer(Refused(request=number, what=what, reason=refusal.reason, problems=problems))
    except Exception:  # noqa: BLE001 - whatever a request does, the other clients stay
        traceback.print_exc(file=sys.stderr)
        outbox.answer(
            Refused(request=number, what=what, reason="an error in the server, which has printed it")
        )
    else:
        if number is not None:
            outbox.answer(Done(request=number))


def _number(text: str | None) -> int | None:
    """The number of a request of a page, which has it last, or None: for the answer where the rest is no request."""
    found = _NUMBER.search((text or "")[-_LONGEST_NUMBER:])
    return int(found[1]) if found else None


def _parsed(text: str | None, longest: int) -> AnyRequest:
    """The request of a text of at most `longest` bytes. Raises Refusal for anything else."""
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
    """The first problem of a message in one line."""
    if not isinstance(error, ValidationError):
        return make_printable(str(error))
    detail = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(map(str, detail["loc"]))
    return make_printable(f"{where or 'message'}: {detail['msg']}")[:300]


@contextmanager
def _gone() -> Iterator[None]:
    """Raise _Gone for what sockets raise when their client is gone."""
    try:
        yield
    except (WebSocketDisconnect, RuntimeError, OSError) as error:
        if isinstance(error, TimeoutError):
            raise
        raise _Gone from None


async def _write(socket: WebSocket, outbox: Outbox, limits: Limits) -> None:
    while True:
        message = await outbox.next()
        try:
            async with asyncio.timeout(limits.send_s):
                with _gone():
                    if isinstance(message, str):
                        await socket.send_text(message)
                    else:
                        await socket.send_bytes(message)
        except TimeoutError:
            raise _Closing(_TRY_LATER, f"nothing was read for {limits.send_s:g} s") from None


async def _close(socket: WebSocket, code: int, reason: str, limits: Limits) -> None:
    if socket.application_state is WebSocketState.DISCONNECTED:
        return
    with suppress(TimeoutError, _Gone), _gone():
        async with asyncio.timeout(limits.send_s):
            await socket.close(code, reason[:_LONGEST_REASON])
