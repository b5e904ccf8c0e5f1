"""Reports on studies: statistics, figures and one self-contained page, from the tables of a study alone."""

from flexneedle.run.report.report import Report, write_report

__all__ = ["Report", "write_report"]
