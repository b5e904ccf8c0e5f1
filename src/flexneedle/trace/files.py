"""Files that are whole at any moment."""

import os
from pathlib import Path

from flexneedle.trace.shield import uninterrupted


def replace_file(path: Path, data: bytes) -> None:
    """Write a file; readers see the old one or the new one, whole."""
    draft = path.with_name(path.name + ".tmp")
    with uninterrupted():
        with draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
