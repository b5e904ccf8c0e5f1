"""Write the report of a study: one HTML page, its figures, and statistics at full precision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.study.findings.findings import Findings, compute_findings
from flexneedle.lab.study.findings.reading import read_study_folder
from flexneedle.lab.study.report.figures import ReportFigure, draw_figures
from flexneedle.lab.study.report.page import render_page
from flexneedle.lab.study.report.reproduce import write_commands

REPORT_FILE = "report.html"


@dataclass(frozen=True, eq=False)
class StudyReport:
    """A written report: the page, its figures, the findings, and the commands that reproduce the listed rows."""

    page: Path
    figures: Sequence[ReportFigure]
    findings: Findings
    commands: Mapping[int, str]

    def values(self) -> dict[str, Any]:
        """Return all statistics as plain values, at full precision; NaN becomes null in JSON."""
        rows = self.findings.study.rows
        return {
            "study": self.findings.study.definition.title,
            "report": str(self.page),
            "figures": [str(path) for drawn in self.figures for path in (drawn.png, drawn.svg)],
            **self.findings.values(),
            "worst": [
                {name: rows.value(name, row) for name in ("index", "true_error_mm", "outcome")}
                | {"command": self.commands[row]}
                for row in self.findings.worst
            ],
        }


def write_report(folder: Path, out: Path | None = None) -> StudyReport:
    """Write the report on the study in `folder` to `out` (default: `report` inside it), and return it.

    The same rows give identical files, except for the section on the run in the page: command and date. Raises
    InputError if the folder contains no study, is damaged, or has no insertion yet, or if `out` cannot be written.
    """
    findings = compute_findings(read_study_folder(folder))
    target = folder / "report" if out is None else out
    try:
        target.mkdir(parents=True, exist_ok=True)
        listed = [*findings.worst, *(ending.first for ending in findings.endings)]
        found_commands = write_commands(findings.study.rows, listed, target)
        figures = draw_figures(findings, target)
        page = target / REPORT_FILE
        replace_file(page, render_page(findings, figures, found_commands).encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from None
    return StudyReport(page, figures, findings, found_commands)
