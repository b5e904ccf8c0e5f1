"""Tables and numbers in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from math import isfinite

_WIDEST = 200


def number(value: float | None, form: str = ".3f") -> str:
    """Return a number as text, – where it is not known."""
    return "–" if value is None or not isfinite(value) else f"{value:{form}}".replace("-", "−")


def span(ends: tuple[float, float] | None, form: str = ".3f") -> str:
    """Return an interval as text, nothing where there is none."""
    if ends is None:
        return ""
    return (
        f"{number(ends[0], form)}–{number(ends[1], form)}"
        if isfinite(ends[1])
        else f"from {number(ends[0], form)}"
    )


def print_notes(notes: Iterable[str]) -> None:
    """Print what a reader of results must know about the data, on stderr, after what is on stdout already."""
    sys.stdout.flush()
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def print_rows(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; the first column is of names, a name with a leading space belongs to the one above."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False, width=_WIDEST)  # numbers are not to be cut in two
    table = Table(box=box.SIMPLE, show_header=any(heads), show_edge=False)
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    for row in rows:
        style = "dim" if row[0].startswith(" ") else ""
        table.add_row(*(Text(cell, style=style) for cell in row))
    console.print(Text(title, style="bold"))
    console.print(table)
    console.print()
