"""Tables and numbers for the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from math import isfinite


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
