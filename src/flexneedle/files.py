"""Files that are complete at any time, and new folders."""

import hashlib
import os
import re
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from flexneedle.errors import InputError, RecordError
from flexneedle.interrupts import delay_signals

RUNS = Path("runs")
_LONGEST_NAME = 60


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file. Raises OSError if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file in one step, so that a reader finds the old or the new file, never a part of it.

    Ctrl-C is delayed until the file is complete. Raises RecordError if it cannot be written; the old file is kept.
    """
    draft = path.with_name(path.name + ".tmp")
    with delay_signals():
        try:
            with draft.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(path)
        except OSError as error:
            draft.unlink(missing_ok=True)  # frees the space on a full disk
            raise RecordError.of(path, error) from error


def create_folder(*parts: str, now: datetime | None = None, root: Path = RUNS) -> Path:
    """Create and return a folder `<root>/<date>-<part>-<part>`, with a number if that exists.

    Characters other than letters, digits, `_`, `.` and `-` are replaced; now: time in the name (default: the present).
    Raises InputError if the folder cannot be created.
    """
    plain = (re.sub(r"[^\w.-]+", "-", part).strip("-.")[:_LONGEST_NAME] or "unnamed" for part in parts)
    opening = "-".join((f"{now or datetime.now(UTC):%Y%m%dT%H%M%SZ}", *plain))
    for number in count(1):
        path = root / (opening if number == 1 else f"{opening}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            if not root.is_dir():
                raise InputError(f"{root}: is not a folder: choose another folder") from None
            continue
        except OSError as error:
            raise InputError(f"{path}: cannot be created: {error.strerror}") from None
        return path
    raise InputError(f"{root / opening}: no unused name")
