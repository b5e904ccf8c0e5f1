"""The page of a report: one template filled with findings. All data are inserted as escaped text."""

from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from math import isnan
from typing import TYPE_CHECKING, Any

from flexneedle.invasiveness import format_number
from flexneedle.lab.html.page import ReportFigure, compile_page
from flexneedle.lab.study.findings import groups, predictions, statistics, worlds
from flexneedle.lab.study.findings.findings import Findings
from flexneedle.lab.study.findings.rows import InsertionRows
from flexneedle.lab.study.findings.statistics import IntervalEstimate
from flexneedle.record.folder import STUDY_FILE

if TYPE_CHECKING:
    from jinja2 import Template


def render_page(findings: Findings, figures: Sequence[ReportFigure]) -> str:
    """Return the page as HTML."""
    study = findings.study
    return _compile_template().render(
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
    source = files("flexneedle.lab.study.report") / "report.html.jinja"
    return compile_page(
        source.read_text(encoding="utf-8"),
        digits=format_number,
        signed=format_signed,
        interval=format_interval,
        value=format_value,
    )


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
    names = [name for name in rows.names if "." in name and not name.startswith("sensor_")]
    levels = {name: list(dict.fromkeys(rows.values(name))) for name in names}
    return {
        name: format_value(found[0]) if len(found) == 1 else f"varies: {len(found)} values"
        for name, found in levels.items()
        if found != [None]
    }
