"""What a worker reports, written by a thread: who reports never waits for the server."""

from collections.abc import Callable
from contextlib import suppress
from threading import Condition, Thread

from flexneedle.lab.page import channel
from flexneedle.lab.page.frames import ShapeFrame, joined, packed
from flexneedle.lab.page.messages import Job, News, Rows

Write = Callable[[bytes], object]


class Outbox:
    """One place for each key: what has not been written by then is replaced, but for rows and the shapes of periods."""

    def __init__(self, write: Write) -> None:
        """write: called in a thread with the bytes of a message of `page/channel.py`; may wait."""
        self._write = write
        self._places: dict[str, News | ShapeFrame] = {}
        self._changed = Condition()
        self._writing = self._broken = False
        Thread(target=self._run, name="outbox", daemon=True).start()

    def put(self, news: News) -> None:
        """Report news. Rows continue those that were reported before."""
        with self._changed:
            before = self._places.get(news.key)
            if isinstance(news, Rows) and isinstance(before, Rows) and news.first > 0:
                news = before.model_copy(update={"rows": [*before.rows, *news.rows]})
            if isinstance(news, Job):  # its end is sent after its results
                self._places.pop(news.key, None)
            self._places[news.key] = news
            self._changed.notify_all()

    def show(self, frame: ShapeFrame) -> None:
        """Report a frame. The shapes of periods continue those that were reported before."""
        key = f"frame {frame.source} {frame.kind}"
        with self._changed:
            before = self._places.get(key)
            if isinstance(before, ShapeFrame) and frame.of_periods and frame.follows(before):
                frame = joined([before, frame])
            self._places[key] = frame
            self._changed.notify_all()

    def flush(self) -> None:
        """Wait until everything is written, or nothing more can be."""
        with self._changed:
            self._changed.wait_for(lambda: self._broken or not (self._places or self._writing))

    def _run(self) -> None:
        try:
            with suppress(OSError):  # the server is gone: the end of stdin ends the worker
                self._write_all()
        finally:
            with self._changed:
                self._broken = True
                self._changed.notify_all()

    def _write_all(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: bool(self._places))
                key = next(iter(self._places))
                one = self._places.pop(key)
                self._writing = True
            self._write(channel.packed(one.model_dump_json() if isinstance(one, News) else packed(one)))
