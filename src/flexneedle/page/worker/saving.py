"""Runs that are saved from the page."""

import shutil
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.runs.saving import save
from flexneedle.types import Insertion


def save_whole(insertion: Insertion, folder: str) -> None:
    """Save an insertion in a folder that has its name, by which it is listed, only once all files are written.

    Raises InputError and RecordError as `flexneedle.save`.
    """
    whole = Path(folder)
    part = whole.with_name(f".{whole.name}")
    shutil.rmtree(part, ignore_errors=True)  # of a worker that was killed
    try:
        save(insertion, part)
    finally:  # a run without a figure is one
        if part.exists():
            try:
                part.rename(whole)
            except OSError as error:
                raise InputError(f"{whole}: cannot be created: {error.strerror}") from error
