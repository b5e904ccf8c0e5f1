"""Replies of a Galil controller to a line of commands: pure functions, without a connection.

Each command of a line, between `;`, is answered by its data and `:`, or by `?`. Data are printable ASCII in lines that
end with CR LF. `:` and `?` do not occur in the data of the commands that the driver sends. A reply has no checksum:
data of the right form are accepted. Source: Galil, Command Reference, DMC-4103.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

LONGEST_LINE = 80
"""Characters of a line of commands that the controller accepts."""

_ACCEPTED, _REFUSED = b":", b"?"
_TERMINATOR = re.compile(rb"[:?]")
_DATA = re.compile(rb"[\x20-\x7e\r\n]*")
_NUMBER = re.compile(r"-?[0-9]{1,10}(?:\.[0-9]{1,4})?")
_SEPARATOR = re.compile(r", *| +")


class GarbledError(ValueError):
    """Bytes that are not a reply to the commands. The message has the reason."""


@dataclass(frozen=True)
class Reply:
    """The reply to one command: whether it was accepted, and its data, with the ends of their lines."""

    accepted: bool
    data: str = ""


def split_lines(commands: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Distribute commands, in their order, over lines that the controller accepts.

    Raises ValueError if a command is longer than a line.
    """
    found: list[tuple[str, ...]] = []
    length = LONGEST_LINE + 1
    for command in commands:
        if len(command) > LONGEST_LINE:
            raise ValueError(f"{command}: longer than {LONGEST_LINE} characters")
        if length + 1 + len(command) <= LONGEST_LINE:
            found[-1] = (*found[-1], command)
            length += 1 + len(command)
        else:
            found.append((command,))
            length = len(command)
    return found


def parse_replies(received: bytes, count: int) -> tuple[Reply, ...] | None:
    """Return the replies to `count` commands, or None while some are missing.

    Raises GarbledError for a byte that no reply has (a controller may set the highest bit of messages that were not
    asked for), for data before a `?`, and for more than was asked for.
    """
    found: list[Reply] = []
    start = 0
    for end in _TERMINATOR.finditer(received):
        if len(found) == count:
            break
        found.append(_reply(received[start : end.start()], end.group()))
        start = end.end()
    rest = received[start:]
    _check(rest)
    if len(found) < count:
        return None
    if rest:
        raise GarbledError(f"more than the replies to {count} commands: {_quote_data(received)}")
    return tuple(found)


def _reply(data: bytes, end: bytes) -> Reply:
    _check(data)
    if end == _REFUSED and data:
        raise GarbledError(f"data before a refusal: {_quote_data(data + end)}")
    return Reply(end == _ACCEPTED, data.decode("ascii"))


def _check(data: bytes) -> None:
    if not _DATA.fullmatch(data):
        raise GarbledError(f"not a reply: {_quote_data(data)}")


def _quote_data(data: bytes) -> str:
    text = repr(data)[1:]
    return text if len(text) <= LONGEST_LINE else text[:LONGEST_LINE] + "…"


def parse_numbers(data: str, count: int) -> tuple[float, ...]:
    r"""Return the numbers of a reply: ` 200, -10\r\n` of TP, ` 0.0000 1.0000\r\n` of MG. Raises GarbledError."""
    body = data.removesuffix("\r\n")
    texts = _SEPARATOR.split(body.strip(" "))
    if body == data or len(texts) != count or not all(_NUMBER.fullmatch(text) for text in texts):
        raise GarbledError(f"must be {count} numbers in a line: {_quote_data(data.encode())}")
    return tuple(map(float, texts))


def format_commands(commands: Sequence[str]) -> str:
    """Return commands in printable form: the control characters of the query for the firmware as ^R^V."""
    return "; ".join(commands).replace("\x12\x16", "^R^V")


def parse_text(data: str) -> str:
    """Return the one line of a reply, such as `1 Unrecognized command` of TC1. Raises GarbledError."""
    body = data.removesuffix("\r\n")
    if body == data or "\r" in body or "\n" in body or not body.strip():
        raise GarbledError(f"must be a line of text: {_quote_data(data.encode())}")
    return " ".join(body.split())
