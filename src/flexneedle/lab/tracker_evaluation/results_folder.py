"""Output folder of the evaluation of a tracker."""

from collections.abc import Iterable
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.files import create_folder


def make_results_folder(out: Path | None, name: str, results: Iterable[str]) -> Path:
    """Create the folder `out`, or a new one in `runs/` named by date and `name`, and return it.

    Raises InputError if `out` already contains one of the files `results` or cannot be created.
    """
    path = out if out is not None else create_folder("em", name)
    for result in results:
        if (path / result).exists():
            raise InputError(f"{path}: already contains {result}: choose another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{path}: is not a folder: choose another one with --out") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror}") from None
    return path
