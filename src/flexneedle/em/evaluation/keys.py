"""Numbers for the cells of a table: each sensor, environment, grid point and bin of distance that occurs."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flexneedle.em.evaluation.checks import refuse
from flexneedle.errors import InputError

Indices = NDArray[np.int64]

_POINT_BITS, _BIN_BITS, _FEW_BITS = 32, 14, 8
_PAIR_SHIFT = _POINT_BITS + _BIN_BITS
_MOST = {"sensor": 1 << _FEW_BITS, "environment": 1 << _FEW_BITS, "point_id": 1 << _POINT_BITS}
MOST_BINS = (1 << _BIN_BITS) - 1


class Names:
    """The names that a column held, each with a number in the order of their first rows."""

    def __init__(self, column: str) -> None:
        self.column, self.names = column, list[str]()
        self._numbers: dict[str, int] = {}

    def numbers(self, labels: Any, start: int) -> Indices:
        """Return the number (r,) of each label; raises InputError where one is empty, or if there are too many."""
        own = [self._number(value) for value in labels.dictionary.to_pylist()]
        # Wide enough for the number that stands for an empty one: that of a short dictionary may not be.
        indices = labels.indices.cast("int64")
        places = indices.fill_null(len(own)) if labels.null_count else indices
        found: Indices = np.array([*own, -1], dtype=np.int64).take(places.to_numpy())
        if found.min() < 0:
            refuse(found < 0, start, f"{self.column} is empty")
        if len(self.names) > _MOST[self.column]:
            raise InputError(
                f"{self.column}: more than {_MOST[self.column]} different ones: is it the right column?"
            )
        return found

    def _number(self, value: Any) -> int:
        text = "" if value is None else str(value).strip()
        if not text:
            return -1
        if text not in self._numbers:
            self._numbers[text] = len(self.names)
            self.names.append(text)
        return self._numbers[text]


class Keys:
    """Cells in the order of their first rows, and what each is of.

    pairs: the number of each sensor and environment (their numbers) that occur together.
    """

    def __init__(self) -> None:
        self._cells: dict[int, int] = {}
        self.pairs: dict[tuple[int, int], int] = {}

    def __len__(self) -> int:
        return len(self._cells)

    def cells(
        self, sensor: Indices, environment: Indices, point: Indices, bins: Indices
    ) -> tuple[Indices, Indices]:
        """Return the number of the cell, and of sensor and environment, of each row (r,); bins: from −1."""
        code = ((sensor << _FEW_BITS | environment) << _POINT_BITS | point) << _BIN_BITS | (bins + 1)
        found = pa.array(code).dictionary_encode()
        own, places = found.dictionary.to_numpy(), found.indices.to_numpy()
        numbers = [self._cells.setdefault(value, len(self._cells)) for value in own.tolist()]
        codes, which = np.unique(own >> _PAIR_SHIFT, return_inverse=True)
        pairs = np.array([self._pair(value) for value in codes.tolist()], dtype=np.int64).take(which)
        return np.array(numbers, dtype=np.int64).take(places), pairs.take(places)

    def _pair(self, code: int) -> int:
        return self.pairs.setdefault(divmod(code, 1 << _FEW_BITS), len(self.pairs))

    def columns(self) -> tuple[Indices, Indices, Indices, Indices]:
        """Return sensor, environment, point and bin (g,) of each cell."""
        code = np.fromiter(self._cells, dtype=np.int64, count=len(self._cells))
        point = code >> _BIN_BITS & ((1 << _POINT_BITS) - 1)
        pair = code >> _PAIR_SHIFT
        few = (1 << _FEW_BITS) - 1
        return pair >> _FEW_BITS, pair & few, point, (code & ((1 << _BIN_BITS) - 1)) - 1
