"""Errors of readers: one line with the file."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from flexneedle.arguments import check_path
from flexneedle.errors import InputError, describe_error, one_line


@contextmanager
def reading(path: str | PathLike[str]) -> Iterator[Path]:
    """Yield the path of an existing file; every error in the block becomes an InputError in one line with the file."""
    file = check_path("path", path)
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    try:
        yield file
    except InputError as error:
        raise InputError(f"{file}: {one_line(error)}") from None
    except Exception as error:
        raise InputError(f"{file}: cannot be read: {describe_error(error)}") from error


def choose_suffix(path: Path, suffixes: tuple[str, ...]) -> str:
    """Return the longest suffix of a file among `suffixes`. Raises InputError for another one."""
    found = [suffix for suffix in suffixes if path.name.lower().endswith(suffix)]
    if not found:
        raise InputError(f"{path.name} must end in {', '.join(suffixes)}")
    return max(found, key=len)
