"""Pages of results: templates with one style. All data are inserted as escaped text."""

import base64
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from itertools import cycle
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

_LARGEST_SVG = 1_000_000  # bytes; larger figures are embedded as PNG
_HEADING = re.compile(r'<th scope="col"[^>]*>(.*?)</th>')
_CELL = re.compile(r"<t[dh]\b")


@dataclass(frozen=True)
class ReportFigure:
    """A figure on disk with title and caption; alt: caption with the notes of the panels."""

    name: str
    title: str
    caption: str
    alt: str
    png: Path
    svg: Path


def compile_page(source: str, **filters: Callable[..., str]) -> "Template":
    """Return a compiled template with the style sheet as `style`, and filters and functions of all pages."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": format_decimals, "labelled": label_cells, **filters}
    style = (files("flexneedle.lab.html") / "page.css").read_text(encoding="utf-8")
    environment.globals |= {"image": embed_figure, "style": Markup(style)}
    return environment.from_string(source)


def format_decimals(value: float, digits: int = 3, unit: str = "") -> str:
    """Return a number as text, "–" if unknown."""
    return "–" if isnan(value) else f"{value:.{digits}f}{unit}"


def label_cells(table: str) -> "Markup":
    """Return head and body of a table with the heading of its column as `data-label` of each cell of the body.

    On a narrow screen, where a row is a card, the label is beside the value.
    """
    from markupsafe import Markup

    head, end, body = str(table).partition("</thead>")
    headings = cycle(_HEADING.findall(head))
    return Markup(head + end + _CELL.sub(lambda cell: f'{cell[0]} data-label="{next(headings)}"', body))


def embed_figure(drawn: ReportFigure) -> str:
    """Return a figure as a data URL."""
    large = drawn.svg.stat().st_size > _LARGEST_SVG
    path, kind = (drawn.png, "image/png") if large else (drawn.svg, "image/svg+xml")
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
