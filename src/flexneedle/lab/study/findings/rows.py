"""Rows of a study by column, for the report."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

TARGET_COLUMNS = ("target_depth_mm", "target_lateral_mm", "target_lateral_z_mm")
"""x, y, z of the target; tables of earlier versions have no z."""

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class InsertionRows:
    """n insertions. The values of a missing column are unknown."""

    table: pa.Table

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.table.column_names)

    @property
    def has_worlds(self) -> bool:
        """Whether the insertions are into random worlds."""
        return not np.isnan(self.number("world")).all()

    def number(self, name: str) -> Floats:
        """Return a column as floats (n,), NaN where unknown or not a number."""
        kind = self.table.schema.field(name).type if name in self.names else pa.null()
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            return np.full(len(self), np.nan)
        return np.array(self.table.column(name).cast(pa.float64()).to_numpy())

    def values(self, name: str) -> list[Any]:
        """Return a column as numbers, text, or tuples of them; None where unknown."""
        if name not in self.names:
            return [None] * len(self)
        return [_to_plain(value) for value in self.table.column(name).to_pylist()]

    def value(self, name: str, row: int) -> Any:
        """Return one value of a column, as in `values`."""
        return _to_plain(self.table.column(name)[row].as_py()) if name in self.names else None

    def target(self, row: int) -> tuple[float, ...]:
        """Return the target of a row in mm, without z in the plane."""
        *in_plane, z = (self.value(name, row) for name in TARGET_COLUMNS)
        return (*in_plane, z) if z else tuple(in_plane)

    def text(self, name: str) -> list[str]:
        """Return a column as text, "" where unknown."""
        return ["" if value is None else str(value) for value in self.values(name)]

    def codes(self, name: str) -> Codes:
        """Return an integer code (n,) for each row, equal for equal values, in order of first appearance."""
        known: dict[Any, int] = {}
        return np.array([known.setdefault(value, len(known)) for value in self.values(name)], dtype=np.int64)


def _to_plain(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_to_plain, value))
    if value is None or value != value:
        return None
    return value if isinstance(value, int | float | str) else str(value)
