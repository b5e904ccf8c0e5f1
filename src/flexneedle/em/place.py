"""The folder that the results of a tracker's evaluation go to."""

from collections.abc import Iterable
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.trace.files import new_folder


def claim(out: Path | None, name: str, results: Iterable[str]) -> Path:
    """Make the folder `out`, or a new one below `runs/` named by date and `name`, and return it.

    Raises InputError if `out` holds one of the files `results` already, or cannot be made.
    """
    path = out if out is not None else new_folder("em", name)
    for result in results:
        if (path / result).exists():
            raise InputError(f"{path}: holds {result} already: give another folder with --out")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{path}: is no folder: give another with --out") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be made: {error.strerror}") from None
    return path
