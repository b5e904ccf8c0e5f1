"""`report`: from the folder of a study to one HTML file, its figures, and statistics at full precision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.study.report.again import commands
from flexneedle.study.report.figures import Drawn, draw_figures
from flexneedle.study.report.findings import Findings, findings_of
from flexneedle.study.report.page import page_text
from flexneedle.study.report.reading import read_study, read_tuning

REPORT_FILE = "report.html"


@dataclass(frozen=True, eq=False)
class Report:
    """A written report: the page, its figures, the findings, and how to run the listed rows again."""

    page: Path
    figures: Sequence[Drawn]
    findings: Findings
    again: Mapping[int, str]

    def values(self) -> dict[str, Any]:
        """Return all statistics as plain values, at full precision; NaN is for the border to make null."""
        rows = self.findings.study.rows
        return {
            "study": self.findings.study.asked.title,
            "report": str(self.page),
            "figures": [str(path) for drawn in self.figures for path in (drawn.png, drawn.svg)],
            **self.findings.values(),
            "worst": [
                {name: rows.value(name, row) for name in ("index", "true_error_mm", "outcome")}
                | {"command": self.again[row]}
                for row in self.findings.worst
            ],
        }


def write_report(folder: Path, out: Path | None = None, tuning: Path | None = None) -> Report:
    """Write the report on the study in `folder` to `out` (default: `report` inside it), and return it.

    tuning: a folder with records of the controllers' tuning (`studies/tune.py`), to be shown beside the study's
    settings; by default those of the package. The same rows give the same files to the byte, but for the page's
    section on the run: command, date and times. Raises InputError if the folder holds no study, is damaged, or holds
    no insertion yet; if `tuning` holds no records; or if `out` cannot be written.
    """
    tuned = read_tuning(tuning)
    findings = findings_of(read_study(folder))
    place = folder / "report" if out is None else out
    try:
        place.mkdir(parents=True, exist_ok=True)
        listed = [*findings.worst, *(ending.first for ending in findings.endings)]
        again = commands(findings.study.rows, listed, place)
        figures = draw_figures(findings, place)
        page = place / REPORT_FILE
        page.write_text(page_text(findings, figures, again, tuned), encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(f"{place}: cannot be written: {error.strerror}") from None
    return Report(page, figures, findings, again)
