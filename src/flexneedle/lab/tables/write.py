"""Writer of tables in CSV or Parquet."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError

SUFFIXES = (".csv", ".parquet")


def check_new(path: Path) -> None:
    """Raise InputError if the suffix is neither CSV nor Parquet, the file exists, or its folder does not."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: must end in {' or '.join(SUFFIXES)}")
    if path.exists():
        raise InputError(f"{path}: already exists: choose another file with --out")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")


def write_table(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write columns (n,) to a new file with one of the `SUFFIXES`, in one step; NaN becomes empty.

    Raises InputError; see `check_new`.
    """
    check_new(path)
    require_extra("em", "duckdb")
    from duckdb import IOException, connect

    values = ", ".join(_value(name, column) for name, column in columns.items())
    kind = "FORMAT csv, HEADER" if path.suffix == ".csv" else "FORMAT parquet, COMPRESSION zstd"
    draft = path.with_name(path.name + ".tmp")
    name = str(draft).replace("'", "''")
    try:
        with connect(config={"threads": 1}) as connection:  # so that the same columns give the same bytes
            connection.register("samples", dict(columns))
            connection.execute(f"COPY (SELECT {values} FROM samples) TO '{name}' ({kind})")
        draft.replace(path)
    except (OSError, IOException) as error:
        draft.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {str(error).splitlines()[0]}") from None


def _value(name: str, column: NDArray[Any]) -> str:
    if np.issubdtype(column.dtype, np.floating):
        return f"CASE WHEN isfinite({name}) THEN {name} END AS {name}"
    return name if np.issubdtype(column.dtype, np.integer) else f"{name}::VARCHAR AS {name}"
