"""The page of a report: one template filled with findings. All data are inserted as escaped text."""

import base64
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from itertools import cycle
from math import isnan
from typing import TYPE_CHECKING, Any

from flexneedle.invasiveness import format_number
from flexneedle.lab.study.findings import groups, predictions, statistics, worlds
from flexneedle.lab.study.findings.findings import Findings
from flexneedle.lab.study.findings.rows import InsertionRows
from flexneedle.lab.study.findings.statistics import IntervalEstimate
from flexneedle.lab.study.report.figures import ReportFigure
from flexneedle.record.folder import STUDY_FILE

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

_LARGEST_SVG = 1_000_000  # bytes; larger figures are embedded as PNG
_TEMPLATES = files("flexneedle.lab.study.report")
_HEADING = re.compile(r'<th scope="col"[^>]*>(.*?)</th>')
_CELL = re.compile(r"<t[dh]\b")


def render_page(findings: Findings, figures: Sequence[ReportFigure]) -> str:
    """Return the page as HTML."""
    from markupsafe import Markup

    study = findings.study
    return _compile_template().render(
        style=Markup((_TEMPLATES / "report.css").read_text(encoding="utf-8")),
        found=findings,
        rows=study.rows,
        factors=findings.design.factors,
        figures=figures,
        versions=list_versions(study.rows),
        settings=list_settings(study.rows),
        written=datetime.fromtimestamp((study.folder / STUDY_FILE).stat().st_mtime, UTC),
        limits=vars(worlds) | vars(groups) | vars(predictions) | vars(statistics),
    )


@cache
def _compile_template() -> "Template":
    """Return the compiled template with its filters and functions."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "number": format_decimals,
        "digits": format_number,
        "signed": format_signed,
        "interval": format_interval,
        "value": format_value,
        "labelled": label_cells,
    }
    environment.globals["image"] = embed_figure
    return environment.from_string((_TEMPLATES / "report.html.jinja").read_text(encoding="utf-8"))


def format_decimals(value: float, digits: int = 3, unit: str = "") -> str:
    """Return a number as text, "–" if unknown."""
    return "–" if isnan(value) else f"{value:.{digits}f}{unit}"


def format_signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign as text."""
    return "–" if isnan(value) else f"{value:+.{digits}f}".replace("-", "−")


def format_interval(estimate: IntervalEstimate, digits: int = 3, unit: str = "") -> str:
    """Return the ends of an interval as text."""
    if isnan(estimate.low):
        return "no interval"
    return f"{estimate.low:.{digits}f} to {estimate.high:.{digits}f}{unit}".replace("-", "−")


def format_value(value: Any) -> str:
    """Return a value of a row or a setting as text."""
    if isinstance(value, list | tuple):
        return ", ".join(f"{item:.10g}" if isinstance(item, float) else str(item) for item in value)
    return "–" if value is None else f"{value:.10g}" if isinstance(value, float) else str(value)


def list_versions(rows: InsertionRows) -> dict[str, str]:
    """Return the versions of the packages by name, without the digest of the source."""
    names = [name for name in rows.names if name.startswith("version_") and name != "version_source"]
    return {name.removeprefix("version_"): ", ".join(sorted(set(rows.text(name)))) for name in names}


def list_settings(rows: InsertionRows) -> dict[str, str]:
    """Return the settings of the scenario as text: the value, or the number of values."""
    levels = {name: list(dict.fromkeys(rows.values(name))) for name in rows.names if "." in name}
    return {
        name: format_value(found[0]) if len(found) == 1 else f"varies: {len(found)} values"
        for name, found in levels.items()
        if found != [None]
    }


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
