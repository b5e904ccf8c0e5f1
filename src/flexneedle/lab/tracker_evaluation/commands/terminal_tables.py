"""Tables and numbers for the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from math import isfinite

_WIDEST = 200


def format_number(value: float | None, form: str = ".3f") -> str:
    """Return a number as text, – if it is unknown."""
    return "–" if value is None or not isfinite(value) else f"{value:{form}}".replace("-", "−")


def format_interval(interval: tuple[float, float] | None, form: str = ".3f") -> str:
    """Return an interval as text, empty if there is none."""
    if interval is None:
        return ""
    low, high = interval
    return (
        f"{format_number(low, form)}–{format_number(high, form)}"
        if isfinite(high)
        else f"from {format_number(low, form)}"
    )


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on the data to stderr, after all earlier output on stdout."""
    sys.stdout.flush()
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def print_rows(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column holds names; a name with a leading space belongs to the row above."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False, width=_WIDEST)  # wrapping would split numbers
    table = Table(box=box.SIMPLE, show_header=any(heads), show_edge=False)
    for index, head in enumerate(heads):
        table.add_column(head, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        style = "dim" if row[0].startswith(" ") else ""
        table.add_row(*(Text(cell, style=style) for cell in row))
    console.print(Text(title, style="bold"))
    console.print(table)
    console.print()
