"""Files that are whole at any moment, since Ctrl-C waits until a record is written, and new folders for them."""

import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType

from flexneedle.errors import InputError

_RUNS = Path("runs")
_LONGEST_NAME = 60


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Put off SIGINT until the block is done; it then does what it would have done."""
    before = signal.getsignal(signal.SIGINT)
    if current_thread() is not main_thread() or not callable(before):
        yield  # no KeyboardInterrupt can arise here
        return
    pending: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _number, frame: pending.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pending:
            before(signal.SIGINT, pending[0])


def replace_file(path: Path, data: bytes) -> None:
    """Write a file; readers see the old one or the new one, whole."""
    draft = path.with_name(path.name + ".tmp")
    with uninterrupted():
        with draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)


def new_folder(*parts: str, now: datetime | None = None) -> Path:
    """Make a folder `runs/<date>-<part>-<part>` and return it; a second one in the same second gets a number.

    now: by default this moment. Raises InputError if it cannot be made.
    """
    plain = (re.sub(r"[^\w.-]+", "-", part).strip("-.")[:_LONGEST_NAME] or "unnamed" for part in parts)
    opening = "-".join((f"{now or datetime.now(UTC):%Y%m%dT%H%M%SZ}", *plain))
    for number in count(1):
        path = _RUNS / (opening if number == 1 else f"{opening}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            if not _RUNS.is_dir():
                raise InputError(f"{_RUNS}: is not a folder: give another with --out") from None
            continue
        except OSError as error:
            raise InputError(f"{path}: cannot be made: {error.strerror}") from None
        return path
    raise InputError(f"{_RUNS / opening}: no free name")
