"""Runs that are saved from the page."""

from pathlib import Path
from uuid import uuid4

from flexneedle.errors import InputError
from flexneedle.record.saving import save
from flexneedle.types import Insertion


def save_whole(insertion: Insertion, folder: str) -> None:
    """Save an insertion in a folder that has its name, by which it is listed, only once all files are written.

    Until then its name begins with a dot and is nobody else's; that of a worker that is killed stays. Raises InputError
    and RecordError as `flexneedle.save`.
    """
    whole = Path(folder)
    part = whole.with_name(f".saving-{uuid4().hex}")
    try:
        save(insertion, part)
    finally:  # a run without a figure is one
        if part.exists():
            try:
                part.rename(whole)
            except OSError as error:
                raise InputError(f"{whole}: cannot be created: {error.strerror}") from error
