"""Which column of a table is which: the names of flexneedle, or what others call them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.rig.tracking.table import COLUMNS
from flexneedle.scenario.library import Library

_MAPS = Library("a column map")
_HINT = "--columns THEIRS=OURS"


def column_map(given: Iterable[str]) -> dict[str, str]:
    """Return their names by ours, from pairs "theirs=ours" and paths of TOML files that hold such pairs.

    Raises InputError for what is neither, and for a column of ours that is unknown or given twice.
    """
    theirs: dict[str, str] = {}
    for text in given:
        for their, our in [_pair(text)] if "=" in text else _from_file(Path(text)):
            if our not in COLUMNS:
                raise InputError(f"{_HINT}: no column {our!r}: one of {', '.join(COLUMNS)}")
            if our in theirs:
                raise InputError(f"{_HINT}: {our} is both {theirs[our]!r} and {their!r}")
            theirs[our] = their
    return theirs


def chosen_columns(
    header: Sequence[str],
    theirs: Mapping[str, str],
    required: Iterable[str],
    optional: Iterable[str],
) -> dict[str, str]:
    """Return the columns of a table to read, their names by ours; all others are ignored.

    Raises InputError if one of `required`, or one that `theirs` names, is not in the header, or is there twice.
    """
    wanted = {our: theirs.get(our, our) for our in (*required, *optional)}
    asked = {*required, *theirs}
    missing = [_told(our, their) for our, their in wanted.items() if our in asked and their not in header]
    if missing:
        raise InputError(
            f"no column {', '.join(missing)}; there are {_listed(header)}. A column of another name: {_HINT}"
            + _constant(missing)
        )
    found = {our: their for our, their in wanted.items() if their in header}
    twice = [their for their in found.values() if header.count(their) > 1]
    if twice:
        raise InputError(f"two columns are called {twice[0]!r}")
    for their in found.values():
        shared = [our for our, other in found.items() if other == their]
        if len(shared) > 1:
            raise InputError(
                f"{_HINT}: the column {their!r} would be {' and '.join(shared)}: which is the other?"
            )
    return found


def _constant(missing: Iterable[str]) -> str:
    options = [f"--{name} NAME" for name in ("sensor", "environment") if name in missing]
    return (
        f"; a table of one {' and '.join(o[2:-5] for o in options)}: {' '.join(options)}" if options else ""
    )


def _pair(text: str) -> tuple[str, str]:
    their, _, our = text.rpartition("=")
    return their.strip(), our.strip()


def _from_file(path: Path) -> list[tuple[str, str]]:
    if not path.is_file():
        raise InputError(f"{_HINT}: {path}: neither a pair nor a file")
    values = _MAPS.read(path)
    wrong = [their for their, our in values.items() if not isinstance(our, str)]
    if wrong:
        raise InputError(f'{path}: {wrong[0]}: must be a line such as {wrong[0]} = "x_mm"')
    return list(values.items())


def _told(our: str, their: str) -> str:
    return our if our == their else f"{their!r} (for {our})"


def _listed(header: Sequence[str], most: int = 20) -> str:
    shown = ", ".join(header[:most])
    return f"{shown} and {len(header) - most} more" if len(header) > most else shown or "none"
