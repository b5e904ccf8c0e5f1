"""Text tables of recordings: CSV, TSV, semicolons, blanks, decimal commas, lines before the names of the columns."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.columns import locate
from flexneedle.lab.calibration.importing.map_file import TableMap
from flexneedle.lab.tables.layout import (
    BLANKS,
    COMMENT,
    CsvLayout,
    find_layout,
    has_decimal_commas,
    open_text,
    read_layout,
)
from flexneedle.lab.tables.plain_copy import EMPTY, write_copy

_EMPTY = [spelling for text in EMPTY for spelling in dict.fromkeys((text, text.upper(), text.title(), "NaN"))]


def read_text(
    path: Path, numbers: Collection[str], times: Collection[str], text: Collection[str], table: TableMap
) -> dict[str, Any]:
    """Return columns of a text table: numbers, times of a kind that their text shows, and text.

    Arrow reads a file of regular lines; another one is read line by line. Raises InputError.
    """
    require_extra("study", "pyarrow")
    data = path.read_bytes()
    try:
        data.decode()
    except UnicodeDecodeError:
        read_layout(path)  # refuses a file that is no text
        wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
        data = data.decode("utf-16" if wide else "cp1252", errors="replace").encode()
        return _with_copy(data, lambda copy: _read_utf8(copy, data, numbers, times, text, table))
    return _read_utf8(path, data, numbers, times, text, table)


def _with_copy(data: bytes, read: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        copy.write_bytes(data)
        return read(copy)


def _read_utf8(
    path: Path,
    data: bytes,
    numbers: Collection[str],
    times: Collection[str],
    text: Collection[str],
    table: TableMap,
) -> dict[str, Any]:
    """Return columns of a text table in UTF-8 with its contents; blanks between columns become semicolons."""
    names = dict.fromkeys((*numbers, *times, *text))
    layout = _layout(path, names, table)
    if layout.separator != BLANKS or b'"' in data:
        return _read_separated(path, layout, names, times, text)
    plain = b"\n".join(b";".join(line.split()) for line in data.splitlines()) + b"\n"
    separated = replace(layout, separator=";")
    return _with_copy(plain, lambda copy: _read_separated(copy, separated, names, times, text))


def _read_separated(
    path: Path, layout: CsvLayout, names: Collection[str], times: Collection[str], text: Collection[str]
) -> dict[str, Any]:
    """Return the columns of a text table with this layout."""
    from pyarrow import ArrowInvalid

    places = locate(names, layout.header)
    clocks = _clocks(path, layout, {name: places[name] for name in times})
    kinds = {places[name]: "text" if name in text else clocks.get(name, "number") for name in names}
    try:
        columns = _read_directly(path, layout, kinds)
    except ArrowInvalid:
        columns = _read_copy(path, layout, kinds)
    return {name: columns[place] for name, place in places.items()}


def _layout(path: Path, names: Collection[str], table: TableMap) -> CsvLayout:
    """Return the layout, with the lines before the first row but one as skipped."""
    if not table.columns:
        found = find_layout(path, names)
        return replace(found, skipped=found.skipped + table.lines_after_header)
    found = read_layout(path)
    if len(found.header) != len(table.columns):
        raise InputError(f"has {len(found.header)} columns, and table.columns names {len(table.columns)}")
    return CsvLayout(table.columns, found.separator, found.skipped - 1)


def _clocks(path: Path, layout: CsvLayout, places: dict[str, int]) -> dict[str, str]:
    """Return which columns of times are dates or times of day: no numbers in the first row."""
    with open_text(path) as file:
        line = next(islice(file, layout.skipped + 1, None), "").strip("\n")
    fields = dict(enumerate(line.replace('"', "").split(layout.separator)))
    return {name: "clock" for name, k in places.items() if not _is_number(fields.get(k, ""))}


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", ".") if text.strip().lower() not in EMPTY else "nan")
    except ValueError:
        return False
    return True


def _read_directly(path: Path, layout: CsvLayout, kinds: dict[int, str]) -> dict[int, Any]:
    """Return columns by place. Raises ArrowInvalid if a line has other fields than the header, or text for a number."""
    numbers = {layout.header[k] for k, kind in kinds.items() if kind == "number"}
    mark = "," if has_decimal_commas(path, layout, numbers) else "."
    names = [f"c{k}" for k in range(len(layout.header))]
    return _parse(path, layout.skipped + 1, layout.separator, names, kinds, mark)


def _read_copy(path: Path, layout: CsvLayout, kinds: dict[int, str]) -> dict[int, Any]:
    """Return columns by place of a plain copy of the file. Raises InputError for the first malformed line."""
    chosen = sorted(kinds)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.csv"
        numbers = [k for k in chosen if kinds[k] == "number"]
        if not write_copy(path, layout, chosen, numbers, copy):
            raise InputError("has no rows, only the header")
        return _parse(copy, 1, ",", [f"c{k}" for k in chosen], kinds, ".")


def _parse(
    path: Path, skipped: int, separator: str, names: Sequence[str], kinds: dict[int, str], mark: str
) -> dict[int, Any]:
    from pyarrow import csv, float64, string

    types = {f"c{k}": string() if kind != "number" else float64() for k, kind in kinds.items()}
    rows = csv.read_csv(
        path,
        csv.ReadOptions(skip_rows=skipped, column_names=names, use_threads=False),
        csv.ParseOptions(delimiter=separator, invalid_row_handler=_skip_comment),
        csv.ConvertOptions(
            include_columns=list(types), column_types=types, null_values=_EMPTY, decimal_point=mark
        ),
    )
    return {k: rows[f"c{k}"].to_numpy() for k in kinds}


def _skip_comment(row: Any) -> str:
    return "skip" if str(row.text).startswith(COMMENT) else "error"
