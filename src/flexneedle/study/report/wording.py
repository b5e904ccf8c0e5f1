"""Numbers as the page writes them; "–" is what is not known."""

from math import isnan
from typing import Any

from flexneedle.study.report.html import Html, element, joined
from flexneedle.study.report.rows import Rows
from flexneedle.study.report.statistics import Estimate


def plain_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(plain_value, value))
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def cell(rows: Rows, name: str, row: int) -> str:
    value = rows.value(name, row)
    return "–" if value is None else plain_value(value)


def words(text: str) -> Html:
    return element("span", text, class_="words")


def code(text: str) -> object:
    if not text:
        return words("its settings make no scenario of this version")
    # An option stays with its dashes and its value where the line breaks.
    parts = text.replace(" --", "\n--").split("\n")
    return element("code", joined(part for k in parts for part in (element("span", k), " ")))


def insertions(count: int) -> str:
    return f"{count} insertion" if count == 1 else f"{count} insertions"


def number(value: float, digits: int = 3) -> str:
    return "–" if isnan(value) else f"{value:.{digits}f}"


def mm(value: float) -> str:
    return "–" if isnan(value) else f"{value:.3f} mm"


def signed(value: float) -> str:
    return "–" if isnan(value) else f"{value:+.3f}".replace("-", "−")


def interval(estimate: Estimate, unit: str, digits: int = 3) -> str:
    if isnan(estimate.low):
        return "no interval"
    low, high = (f"{end:.{digits}f}".replace("-", "−") for end in (estimate.low, estimate.high))
    return f"{low} to {high}{unit}"
