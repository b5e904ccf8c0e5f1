"""The newest news of each key, and what each client has not got of them yet.

A client has a set of keys, not a queue: what it gets of a key is what is newest when it is ready for it. Rows of an
insertion and the shapes of its periods are lists; each client gets those after the last that it has.
"""

import asyncio
import json
from bisect import bisect_right
from collections.abc import Iterable
from typing import Any

from flexneedle.errors import RunError
from flexneedle.lab.page.channel import Message
from flexneedle.lab.page.frames import ShapeFrame, joined, packed, unpacked
from flexneedle.lab.page.messages import News

_PART = {"job": "kind", "iteration": "strategy", "plan": "strategy", "rows": "of", "insertion": "of"}
"""Type of a message and the part of it that its key has, as `News.key`."""
_ROWS, _JOB, _FIRST = "rows", "job", "first"
_ROWS_AT_ONCE, _VALUES_AT_ONCE = 250, 1_000_000


class Rows:
    """Rows of an insertion, as JSON. `edition` counts the insertions."""

    def __init__(self) -> None:
        self.edition, self.texts = 0, list[str]()

    def put(self, first: int, rows: Iterable[Any]) -> None:
        """Add rows from an index on; at 0 a new insertion begins. Raises RunError if rows before them are missing."""
        if first > len(self.texts):
            raise RunError(f"rows from {first}: those from {len(self.texts)} are missing")
        if first == 0:
            self.edition += 1
        self.texts[first:] = [json.dumps(row, separators=(",", ":")) for row in rows]


class Shapes:
    """The shapes of an insertion's periods, of one kind. `edition` counts the insertions."""

    def __init__(self) -> None:
        self.edition, self.frames = 0, list[ShapeFrame]()

    def put(self, frame: ShapeFrame) -> None:
        """Add the shapes of later periods; with those of an earlier one a new insertion begins."""
        if self.frames and not frame.follows(self.frames[-1]):
            self.frames = []
        if not self.frames:
            self.edition += 1
        self.frames.append(frame)

    def since(self, number: int) -> ShapeFrame | None:
        """Those of periods from a number on, as many as one message has; None if there are none."""
        first = bisect_right(self.frames, number, key=lambda frame: frame.end)
        if first == len(self.frames):
            return None
        some = [self.frames[first].since(number)]
        size = max(some[0].values[0].size, 1)
        for frame in self.frames[first + 1 :]:
            if (frame.end - some[0].number) * size > _VALUES_AT_ONCE:
                break
            some.append(frame)
        return joined(some)


class Outbox:
    """What a client has to get: keys with news, and answers to it alone, in the order in which they came up."""

    def __init__(self, hub: "Hub", first: News) -> None:
        """first: the message that comes before all others."""
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

    def answer(self, news: News) -> None:
        """Add an answer, which no other replaces. It comes after the news to which the request has led."""
        self._answered += 1
        self._add(f"answer {self._answered}", news)

    def touch(self, key: str) -> None:
        """Note that a key has news. The state of a job comes after what the job has sent before."""
        if _is_job(key):
            self._keys.pop(key, None)
        self._keys[key] = None
        self._ready.set()

    def drop(self, key: str) -> None:
        """Note that a key has no news any more; what comes later of it comes after what is now to be sent."""
        self._keys.pop(key, None)

    def rows_from(self, key: str, index: int) -> None:
        """Send rows of a key again, from an index on."""
        self._has[key] = (self._hub.rows(key).edition, index)
        self.touch(key)

    async def next(self) -> Message:
        """The next message; waits for one."""
        while True:
            await self._ready.wait()
            message = self._taken()
            if message is not None:
                return message
            self._ready.clear()

    def _add(self, key: str, news: News) -> None:
        self._own[key] = news.model_dump_json()
        self.touch(key)

    def _taken(self) -> Message | None:
        while self._keys:
            key = next(iter(self._keys))
            del self._keys[key]
            message = self._message(key)
            if message is not None:
                return message
        return None

    def _message(self, key: str) -> Message | None:
        if key in self._own:
            return self._own.pop(key)
        if key.startswith(_ROWS):
            return self._missing(key)
        shapes = self._hub.shapes.get(key)
        return self._hub.newest(key) if shapes is None else self._missing_of(key, shapes)

    def _missing(self, key: str) -> str | None:
        """Rows after those that this client has, some at once, so that other news get their turn."""
        rows = self._hub.rows(key)
        edition, count = self._has.get(key, (0, 0))
        first = min(count, len(rows.texts)) if edition == rows.edition else 0
        some = rows.texts[first : first + _ROWS_AT_ONCE]
        self._has[key] = (rows.edition, first + len(some))
        if first + len(some) < len(rows.texts):
            self._keys[key] = None
        of = json.dumps(key.removeprefix(_ROWS).strip())
        return f'{{"type":"rows","of":{of},"first":{first},"rows":[{",".join(some)}]}}' if some else None

    def _missing_of(self, key: str, shapes: Shapes) -> bytes | None:
        """Shapes of the periods after those that this client has, some at once."""
        edition, end = self._has.get(key, (0, 0))
        some = shapes.since(end if edition == shapes.edition else 0)
        if some is None:
            return None
        self._has[key] = (shapes.edition, some.end)
        if some.end < shapes.frames[-1].end:
            self._keys[key] = None
        return packed(some)


class Hub:
    """The newest news, and the outboxes of all clients. shapes: those of periods, by key."""

    def __init__(self) -> None:
        self.shapes = dict[str, Shapes]()
        self._newest = dict[str, Message]()
        self._rows = dict[str, Rows]()
        self._outboxes = set[Outbox]()

    @property
    def keys(self) -> list[str]:
        """All keys that have news."""
        return [*self._newest, *self.shapes, *self._rows]

    def newest(self, key: str) -> Message | None:
        """The newest message of a key, None if there is none."""
        return self._newest.get(key)

    def rows(self, key: str) -> Rows:
        """The rows of a key."""
        return self._rows.setdefault(key, Rows())

    def join(self, first: News) -> Outbox:
        """The outbox of a new client, which gets a message of its own, and then all news."""
        outbox = Outbox(self, first)
        self._outboxes.add(outbox)
        return outbox

    def leave(self, outbox: Outbox) -> None:
        """Forget a client."""
        self._outboxes.discard(outbox)

    def publish(self, news: News) -> None:
        """Send news of the server to all clients."""
        self._put(news.key, news.model_dump_json())

    def hand_on(self, message: Message, values: dict[str, Any] | None) -> None:
        """Send a worker's message to all clients as it is; values: of a text.

        Raises RunError if rows are missing, and for bytes that are no frame.
        """
        if isinstance(message, bytes):
            self._put_frame(message)
        elif values is None:
            raise RunError("a text without values")
        elif values["type"] == _ROWS:
            key = key_of(values)
            self.rows(key).put(values["first"], values["rows"])
            self._touch(key)
        else:
            self._put(key_of(values), message)

    def forget(self, keys: Iterable[str]) -> None:
        """Forget the news of keys: clients that have not got them do not get them."""
        for key in keys:
            self._newest.pop(key, None)
            if key in self.shapes:
                self.shapes[key].frames = []
            if key in self._rows:
                self._rows[key].put(0, ())
            for outbox in self._outboxes:
                outbox.drop(key)

    def forget_all_of(self, *types: str) -> None:
        """Forget the news of a type of message."""
        self.forget([key for key in self._newest if key.split()[0] in types])

    def forget_frames(self, *sources: int) -> None:
        """Forget the frames of sources."""
        openings = tuple(map(_frames_of, sources))
        self.forget([key for key in (*self._newest, *self.shapes) if key.startswith(openings)])

    def _put_frame(self, message: bytes) -> None:
        try:
            frame = unpacked(message)
        except ValueError as error:
            raise RunError(str(error)) from None
        key = frame_key(frame)
        if not frame.of_periods:
            self._put(key, message)
            return
        self.shapes.setdefault(key, Shapes()).put(frame)
        self._touch(key)

    def _put(self, key: str, message: Message) -> None:
        self._newest[key] = message
        self._touch(key)

    def _touch(self, key: str) -> None:
        for outbox in self._outboxes:
            outbox.touch(key)


def _is_job(key: str) -> bool:
    return key.startswith(_JOB)


def key_of(values: dict[str, Any]) -> str:
    """The key of a message, as `News.key`."""
    kind = values["type"]
    return f"{kind} {values[_PART[kind]]}" if kind in _PART else str(kind)


def frame_key(frame: ShapeFrame) -> str:
    """The key of a frame: its source and kind."""
    return f"{_frames_of(frame.source)}{frame.kind:d}"


def _frames_of(source: int) -> str:
    return f"frame {source:d} "
