"""Write the report of a study: one HTML page, its figures, and statistics at full precision."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.html.page import ReportFigure
from flexneedle.lab.study.findings.findings import Findings, compute_findings
from flexneedle.lab.study.findings.reading import read_study_folder
from flexneedle.lab.study.report.figures import draw_figures
from flexneedle.lab.study.report.page import render_page

REPORT_FILE = "report.html"


@dataclass(frozen=True, eq=False)
class StudyReport:
    """A written report: the page, its figures, and the findings."""

    page: Path
    figures: Sequence[ReportFigure]
    findings: Findings

    def values(self) -> dict[str, Any]:
        """Return all statistics as plain values, at full precision; NaN becomes null in JSON."""
        figures = [str(path) for drawn in self.figures for path in (drawn.png, drawn.svg)]
        return {"report": str(self.page), "figures": figures, **self.findings.values()}


def write_report(folder: Path, out: Path | None = None) -> StudyReport:
    """Write the report on the study in `folder` to `out` (default: `report` inside it), and return it.

    The same rows give identical files, except for the section on the run in the page: command and date. Raises
    InputError if the folder contains no study, is damaged, or has no insertion yet, or if `out` cannot be written.
    """
    findings = compute_findings(read_study_folder(folder))
    target = folder / "report" if out is None else out
    try:
        target.mkdir(parents=True, exist_ok=True)
        figures = draw_figures(findings, target)
        page = target / REPORT_FILE
        replace_file(page, render_page(findings, figures).encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from None
    return StudyReport(page, figures, findings)
