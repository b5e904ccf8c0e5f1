"""The newest message of each key, and the keys that each client has not received.

A client has a set of keys, not a queue: it receives the message of a key that is newest when the client is ready. Rows
of an insertion and shapes of its periods are lists; each client receives those after the last that it has.
"""

import asyncio
import json
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic_core import to_json

from flexneedle.errors import RunError
from flexneedle.lab.page.protocol import RowsMessage, ServerMessage
from flexneedle.lab.page.shape_frames import ShapeFrame, join_frames, pack_frame

_ROWS, _JOB, _FIRST = "rows", "job", "first"
_ROWS_AT_ONCE, _VALUES_AT_ONCE = 250, 1_000_000


class RowLog:
    """Rows of an insertion, as JSON. `edition` counts the insertions."""

    def __init__(self) -> None:
        self.edition, self.texts = 0, list[str]()

    def put(self, first: int, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add rows from an index on; at 0 a new insertion begins. Raises RunError if rows before them are missing."""
        if first > len(self.texts):
            raise RunError(f"rows from {first}: those from {len(self.texts)} are missing")
        if first == 0:
            self.edition += 1
        self.texts[first:] = [to_json(row, inf_nan_mode="null").decode() for row in rows]


class ShapeLog:
    """Shapes of an insertion's periods, of one kind. `edition` counts the insertions."""

    def __init__(self) -> None:
        self.edition, self.frames = 0, list[ShapeFrame]()

    def put(self, frame: ShapeFrame) -> None:
        """Add the shapes of later periods; with the shape of an earlier period a new insertion begins."""
        if self.frames and not frame.follows(self.frames[-1]):
            self.frames = []
        if not self.frames:
            self.edition += 1
        self.frames.append(frame)

    def since(self, number: int) -> ShapeFrame | None:
        """Return the shapes from a period on, at most the size of a message; None if there are none."""
        first = bisect_right(self.frames, number, key=lambda frame: frame.end)
        if first == len(self.frames):
            return None
        some = [self.frames[first].since(number)]
        size = max(some[0].values[0].size, 1)
        for frame in self.frames[first + 1 :]:
            if (frame.end - some[0].number) * size > _VALUES_AT_ONCE:
                break
            some.append(frame)
        return join_frames(some)


class ClientOutbox:
    """Pending keys of a client, and answers to it alone, in their order."""

    def __init__(self, hub: "Hub", first: ServerMessage) -> None:
        """Create the outbox of a new client, with the message that precedes all others."""
        self._hub = hub
        self._own = {_FIRST: first.model_dump_json()}
        self._keys = dict.fromkeys((_FIRST, *sorted(hub.keys, key=_is_job)))
        self._has = dict[str, tuple[int, int]]()
        self._answered = 0
        self._ready = asyncio.Event()
        self._ready.set()

    @property
    def waiting(self) -> int:
        """Number of answers that are not sent."""
        return len(self._own)

    def answer(self, message: ServerMessage) -> None:
        """Add an answer, which nothing replaces. It follows the messages that the request has caused."""
        self._answered += 1
        key = f"answer {self._answered}"
        self._own[key] = message.model_dump_json()
        self.touch(key)

    def touch(self, key: str) -> None:
        """Add a pending key. The state of a job follows the job's results."""
        if _is_job(key):
            self._keys.pop(key, None)
        self._keys[key] = None
        self._ready.set()

    def drop(self, key: str) -> None:
        """Drop a pending key; a later update goes to the back of the queue."""
        self._keys.pop(key, None)

    async def next(self) -> str | bytes:
        """Wait for the next message."""
        while True:
            await self._ready.wait()
            message = self._take()
            if message is not None:
                return message
            self._ready.clear()

    def _take(self) -> str | bytes | None:
        while self._keys:
            key = next(iter(self._keys))
            del self._keys[key]
            message = self._message(key)
            if message is not None:
                return message
        return None

    def _message(self, key: str) -> str | bytes | None:
        if key in self._own:
            return self._own.pop(key)
        if key.startswith(_ROWS):
            return self._missing_rows(key)
        shapes = self._hub.shapes.get(key)
        return self._hub.encode_newest(key) if shapes is None else self._missing_shapes(key, shapes)

    def _missing_rows(self, key: str) -> str | None:
        """Return some of the rows after the last that this client has; other keys precede the rest."""
        rows = self._hub.rows(key)
        edition, count = self._has.get(key, (0, 0))
        first = min(count, len(rows.texts)) if edition == rows.edition else 0
        some = rows.texts[first : first + _ROWS_AT_ONCE]
        self._has[key] = (rows.edition, first + len(some))
        if first + len(some) < len(rows.texts):
            self._keys[key] = None
        of = json.dumps(key.removeprefix(_ROWS).strip())
        return f'{{"type":"rows","of":{of},"first":{first},"rows":[{",".join(some)}]}}' if some else None

    def _missing_shapes(self, key: str, shapes: ShapeLog) -> bytes | None:
        """Return some of the shapes after the last that this client has."""
        edition, end = self._has.get(key, (0, 0))
        some = shapes.since(end if edition == shapes.edition else 0)
        if some is None:
            return None
        self._has[key] = (shapes.edition, some.end)
        if some.end < shapes.frames[-1].end:
            self._keys[key] = None
        return pack_frame(some)


class Hub:
    """The newest messages, and the outboxes of all clients. shapes: of periods, by key."""

    def __init__(self) -> None:
        self.shapes = dict[str, ShapeLog]()
        self._newest = dict[str, ServerMessage | ShapeFrame]()
        self._encoded = dict[str, str | bytes]()
        self._rows = dict[str, RowLog]()
        self._outboxes = set[ClientOutbox]()

    @property
    def keys(self) -> list[str]:
        """All keys with a message."""
        return [*self._newest, *self.shapes, *self._rows]

    def newest(self, key: str) -> ServerMessage | ShapeFrame | None:
        """Return the newest message of a key, None without one."""
        return self._newest.get(key)

    def encode_newest(self, key: str) -> str | bytes | None:
        """Return the newest message of a key as it is sent, None without one."""
        if key not in self._newest:
            return None
        if key not in self._encoded:  # once for all clients
            message = self._newest[key]
            if isinstance(message, ShapeFrame):
                self._encoded[key] = pack_frame(message)
            else:
                self._encoded[key] = message.model_dump_json()
        return self._encoded[key]

    def rows(self, key: str) -> RowLog:
        """Return the rows of a key."""
        return self._rows.setdefault(key, RowLog())

    def join(self, first: ServerMessage) -> ClientOutbox:
        """Return the outbox of a new client: a first message, then all keys."""
        outbox = ClientOutbox(self, first)
        self._outboxes.add(outbox)
        return outbox

    def leave(self, outbox: ClientOutbox) -> None:
        """Forget a client."""
        self._outboxes.discard(outbox)

    def publish(self, message: ServerMessage | ShapeFrame) -> None:
        """Send a message to all clients. Raises RunError for rows with a gap before them."""
        key = message.key
        if isinstance(message, RowsMessage):
            self.rows(key).put(message.first, message.rows)
        elif isinstance(message, ShapeFrame) and message.has_periods:
            self.shapes.setdefault(key, ShapeLog()).put(message)
        else:
            self._newest[key] = message
            self._encoded.pop(key, None)
        for outbox in self._outboxes:
            outbox.touch(key)

    def forget(self, keys: Iterable[str]) -> None:
        """Forget the messages of keys; clients that have not received them do not get them."""
        for key in keys:
            self._newest.pop(key, None)
            self._encoded.pop(key, None)
            if key in self.shapes:
                self.shapes[key].frames = []
            if key in self._rows:
                self._rows[key].put(0, ())
            for outbox in self._outboxes:
                outbox.drop(key)

    def forget_types(self, *types: str) -> None:
        """Forget the messages of some types."""
        self.forget([key for key in self._newest if key.split()[0] in types])

    def forget_frames(self, *sources: int) -> None:
        """Forget the frames of some sources."""
        openings = tuple(f"frame {source:d} " for source in sources)
        self.forget([key for key in (*self._newest, *self.shapes) if key.startswith(openings)])


def _is_job(key: str) -> bool:
    return key.startswith(_JOB)
