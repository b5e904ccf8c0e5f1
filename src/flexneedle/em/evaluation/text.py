"""How a CSV file is laid out, by its first line, and whether it was cut in the middle, by its last."""

import csv
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from flexneedle.errors import InputError

_DELIMITERS = ",;\t"
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_TAIL = 1 << 16  # bytes
_FIRST_LINE = 1 << 20  # bytes; more is no header


@dataclass(frozen=True)
class Layout:
    """Names of the columns of a CSV file, and the character between them."""

    header: list[str]
    delimiter: str

    def unique_names(self) -> Iterator[str]:
        """Yield the names; one that is there a second time gets a number, since Arrow needs them to differ."""
        seen: dict[str, int] = {}
        for name in self.header:
            seen[name] = seen.get(name, 0) + 1
            yield name if seen[name] == 1 else f"{name} ({seen[name]})"

    def no_number(self, path: Path, column: int, value: str, chosen: Mapping[str, str]) -> str:
        """Return what is wrong with a field in a column (from 0) that is no number; `chosen`: their names by ours."""
        their = self.header[column]
        our = next((our for our, other in chosen.items() if other == their), their)
        row, name = self._row_of(path, column, value), our if our == their else f"{their!r} (for {our})"
        advice = ": write a decimal point, not a comma" if _DECIMAL_COMMA.fullmatch(value) else ""
        where = "" if row is None else f"row {row}: "
        return f"{where}{name}: {value[:60]!r} is no number{advice}"

    def other_length(self, path: Path) -> str:
        """Return which row has more or fewer fields than the header; "" if none has."""
        wanted = len(self.header)
        for number, row in self._rows(path):
            if len(row) != wanted:
                text = self.delimiter.join(row)
                return f"row {number}: has {len(row)} fields, the header has {wanted}: {text[:60]!r}"
        return ""

    def _row_of(self, path: Path, column: int, value: str) -> int | None:
        """Return the first row whose field in a column is `value`, None if there is none."""
        fields = ((k, row[column].strip() if column < len(row) else "") for k, row in self._rows(path))
        return next((k for k, field in fields if field == value.strip()), None)

    def _rows(self, path: Path) -> Iterator[tuple[int, list[str]]]:
        """Yield the rows below the header with their numbers, from 1."""
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            rows = (row for row in csv.reader(file, delimiter=self.delimiter) if row)
            next(rows, None)
            yield from enumerate(rows, 1)

    def refuse_cut(self, path: Path, labels: Collection[str], used: Collection[str]) -> None:
        """Raise InputError if the last line, being without a line end, seems to be a part of what was written.

        It is one if it has fewer fields than the header; or if its last field is a beginning of a name that other
        rows have, or a number with fewer decimals than any other. A cut between two digits of whole numbers,
        or of numbers written with all kinds of lengths, may pass; one at a line end cannot be seen at all.
        """
        lines = _tail(path)
        if not lines:
            return
        *before, last = list(csv.reader(lines, delimiter=self.delimiter))
        ends = [row[-1] for row in before[1:] if len(row) == len(self.header)]
        short = len(last) < len(self.header)
        if short or (self.header[-1] in used and _is_part(last[-1], ends, self.header[-1] in labels)):
            advice = "" if short else ", or add a line end if it is whole"
            raise InputError(
                f"cut in the middle: the last line has no line end and seems not to be whole ({lines[-1][:60]!r}); "
                f"write the file again, or take that line away{advice}"
            )


def read_layout(path: Path) -> Layout:
    """Return the layout of a CSV file. Raises InputError if there is no header or nothing below it."""
    with path.open("rb") as file:
        first = file.readline(_FIRST_LINE)
        more = file.read(1)
    text = first.decode("utf-8-sig", errors="replace").rstrip("\r\n")
    if (not first.endswith(b"\n") and len(first) == _FIRST_LINE) or "\0" in text:
        raise InputError("neither CSV nor Parquet")
    if not text.strip():
        raise InputError("the first line must name the columns")
    if not more:
        raise InputError(f"has no rows, only one line: {text[:60]!r}")
    delimiter = max(_DELIMITERS, key=text.count)
    return Layout([name.strip() for name in next(csv.reader([text], delimiter=delimiter))], delimiter)


def _tail(path: Path) -> list[str]:
    """Return the last lines, the first of them perhaps not whole, or none if the file ends with a line end."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _TAIL))
        data = file.read()
    return [] if data.endswith((b"\n", b"\r")) else data.decode("utf-8", errors="replace").splitlines()


def _is_part(field: str, others: list[str], label: bool) -> bool:
    if not others:
        return False
    if label:
        return field not in others and any(other.startswith(field) for other in others)
    return _decimals(field) < min(map(_decimals, others))


def _decimals(number: str) -> int:
    return len(number.partition(".")[2]) if number else -1
