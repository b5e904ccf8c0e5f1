"""The periods of a run as CSV: a header with units, a line for each period, numbers with all their digits."""

import csv
from collections.abc import Iterable
from typing import IO

from flexneedle.trace import Period
from flexneedle.trace.columns import COLUMNS, to_row

__all__ = ["write_csv"]


def write_csv(file: IO[str], periods: Iterable[Period]) -> None:
    """Write periods to a text file opened with newline="". Wall-clock durations stay in the trace."""
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(map(to_row, periods))
