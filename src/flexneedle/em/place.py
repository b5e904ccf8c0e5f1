"""The folder that the results of a tracker's evaluation go to."""

import re
from collections.abc import Iterable
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from flexneedle.errors import InputError


def claim(out: Path | None, name: str, results: Iterable[str]) -> Path:
    """Make the folder `out`, or a new one below `runs/` named by date and `name`, and return it.

    Raises InputError if `out` holds one of the files `results` already, or cannot be made.
    """
    path = out if out is not None else _free(name)
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


def _free(name: str) -> Path:
    plain_name = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "table"
    opening = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-em-{plain_name[:60]}"
    names = (opening if number == 1 else f"{opening}-{number}" for number in count(1))
    return next(path for path in map(Path("runs").joinpath, names) if not path.exists())
