"""Write the report of a study: one HTML page, its figures, and statistics at full precision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.study.findings.findings import Findings, findings_of
from flexneedle.lab.study.findings.reading import read_study_folder, read_tuning
from flexneedle.lab.study.report.figures import Drawn, draw_figures
from flexneedle.lab.study.report.page import page_text
from flexneedle.lab.study.report.reproduce import commands

REPORT_FILE = "report.html"


@dataclass(frozen=True, eq=False)
class Report:
    """A written report: the page, its figures, the findings, and the commands that reproduce the listed rows."""

    page: Path
    figures: Sequence[Drawn]
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


def write_report(folder: Path, out: Path | None = None, tuning: Path | None = None) -> Report:
    """Write the report on the study in `folder` to `out` (default: `report` inside it), and return it.

    tuning: folder of tuning records (`studies/tune.py`) to show with the settings of the study (default: those of the
    package). The same rows give identical files, except for the section on the run in the page: command, date and
    times. Raises InputError if the folder contains no study, is damaged, or has no insertion yet; if `tuning` contains
    no records; or if `out` cannot be written.
    """
    tuned = read_tuning(tuning)
    findings = findings_of(read_study_folder(folder))
    target = folder / "report" if out is None else out
    try:
        target.mkdir(parents=True, exist_ok=True)
        listed = [*findings.worst, *(ending.first for ending in findings.endings)]
        found_commands = commands(findings.study.rows, listed, target)
        figures = draw_figures(findings, target)
        page = target / REPORT_FILE
        replace_file(page, page_text(findings, figures, found_commands, tuned).encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from None
    return Report(page, figures, findings, found_commands)
