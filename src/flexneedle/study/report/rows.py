"""Rows of a study, column by column: what the report asks of them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rows:
    """n insertions. A column is an array (n,): of numbers, or of objects where values are text, lists or missing.

    A column that is not there reads as unknown in every row.
    """

    columns: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def number(self, name: str) -> Floats:
        """Return a column as floats, NaN where it is unknown or no number."""
        if name not in self.columns:
            return np.full(len(self), np.nan)
        column = self.columns[name]
        if column.dtype != object:
            return column.astype(float)
        return np.array([_float(value) for value in column], dtype=float)

    def text(self, name: str) -> list[str]:
        """Return a column as text, "" where it is unknown."""
        if name not in self.columns:
            return [""] * len(self)
        return ["" if value is None else str(value) for value in self.columns[name].tolist()]

    def value(self, name: str, row: int) -> Any:
        """Return one value as Python knows it; None if it is unknown."""
        found = self.columns[name][row] if name in self.columns else None
        found = found.item() if isinstance(found, np.generic) else found
        return None if isinstance(found, float) and found != found else found

    def codes(self, name: str) -> tuple[Codes, list[Any]]:
        """Return the level (n,) of each row in a column, and the levels in order of first appearance."""
        if name not in self.columns:
            return np.zeros(len(self), dtype=np.int64), [None]
        column = self.columns[name]
        if column.dtype == object:
            return _by_appearance(column)
        levels, codes = np.unique(column, return_inverse=True)
        codes, order = relabelled(codes)
        return codes, [None if level != level else level for level in levels[order].tolist()]


def relabelled(codes: Codes) -> tuple[Codes, Codes]:
    """Return codes numbered in order of first appearance, and the old code of each new one."""
    _, first, inverse = np.unique(codes, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[inverse], codes[first[order]]


def _by_appearance(values: Iterable[Any]) -> tuple[Codes, list[Any]]:
    known: dict[Any, int] = {}
    codes = [known.setdefault(value, len(known)) for value in values]
    return np.array(codes, dtype=np.int64), list(known)


def _float(value: Any) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else np.nan
