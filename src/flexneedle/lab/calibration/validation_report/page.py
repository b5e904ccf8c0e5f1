"""The page of a validation: verdict, figures and tables in one HTML file."""

from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.errors import InputError
from flexneedle.figures.style import save
from flexneedle.files import replace_file
from flexneedle.lab.calibration.validation_report.figures import draw_overview, draw_paths, draw_response
from flexneedle.lab.calibration.validation_report.response import responses
from flexneedle.lab.calibration.verdicts import NAMES
from flexneedle.lab.html.page import ReportFigure, compile_page

if TYPE_CHECKING:
    from jinja2 import Template

    from flexneedle.lab.calibration.validation import Validation

PAGE_FILE = "validation.html"
_ERRORS = (
    "Errors of all predictors by distance: medians, quartiles and 95 %. Below: the share of readings inside the "
    "model's intervals of 95 %, where 90 to 98 % is right, and errors by depth and by order within the session, of the "
    "model, the best simple predictor and the regression."
)
_PATHS = (
    "Insertions in which the model's error is smaller than in 75 % of all, median, and larger than in 90 %. Each "
    "prediction has the readings up to its circle, and the motions of the guide after it."
)
_RESPONSE = (
    "Turn of the tip from a step to the next for a motion of the guide by 1 mm, by regression: recorded, and in the "
    "model's path without readings."
)


def write_page(found: "Validation", folder: Path) -> Path:
    """Write the page and its figures into a folder, and return the path of the page."""
    page = folder / PAGE_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(page, render_page(found, list(_draw(found, folder))).encode())
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}: choose another folder") from None
    return page


def _draw(found: "Validation", folder: Path) -> Iterator[ReportFigure]:
    """Write the figures that have data."""
    entries = (
        ("errors", "Errors of predictions ahead", _ERRORS, draw_overview),
        ("paths", "Predicted and measured paths", _PATHS, draw_paths),
        ("response", "Response of the slope to the guide", _RESPONSE, draw_response),
    )
    for name, title, caption, draw in entries:
        figure = draw(found)
        if figure is not None:
            png, svg = save(figure, folder, name)
            yield ReportFigure(name, title, caption, caption, png, svg)


def render_page(found: "Validation", figures: list[ReportFigure]) -> str:
    """Return the page as HTML."""
    headline, *_, coverage = found.verdict
    return _compile_template().render(
        found=found,
        headline=headline,
        coverage=coverage,
        names=NAMES,
        main=[row for row in found.rows if row.main],
        parts=[row for row in found.rows if not row.main],
        responses=list(responses(found.tested, found.deepest)),
        figures=figures,
    )


@cache
def _compile_template() -> "Template":
    source = files("flexneedle.lab.calibration.validation_report") / "page.html.jinja"
    return compile_page(source.read_text(encoding="utf-8"))
