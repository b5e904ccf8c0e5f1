"""The section on the run of a study: all that may differ between two reports on the same rows."""

from datetime import UTC, datetime

import numpy as np

from flexneedle.study.report.findings import Findings
from flexneedle.study.report.html import Html, element, table
from flexneedle.study.report.reading import STUDY_FILE
from flexneedle.study.report.rows import Floats, Rows


def times(findings: Findings) -> Html:
    """Return what differs from one run of a study to the next: command, date, and where the time went."""
    about, timing, written = findings.study.about, findings.study.timing, _written(findings)
    return element(
        "section",
        element("h2", "This run of the study"),
        element(
            "p", "The same rows may come from another command, on other days and machines.", class_="quiet"
        ),
        element("p", "Command:"),
        element("pre", element("code", str(about.get("command") or "not recorded"))),
        element("p", f"{STUDY_FILE} was written {written}.") if written else None,
        element("p", "No times are recorded.") if timing is None else _division(timing),
        id="run",
    )


def _division(timing: Rows) -> Html:
    """Return how the time divides into plan, control and plant; a plan counts once, however often it was used."""
    plans = _plan_seconds(timing)
    control, plant, total = (timing.number(name) for name in ("control_s", "plant_s", "total_s"))
    known = [plans.sum(), np.nansum(control), np.nansum(plant)]
    rest = max(0.0, float(np.nansum(total)) - known[1] - known[2])
    whole = sum(known) + rest or 1.0
    names = ("plan", "control", "plant", "rest of the insertions")
    each = (plans, control, plant, total - control - plant)
    listed = [
        (name, f"{seconds:.1f}", f"{100 * seconds / whole:.0f} %", _milliseconds(values))
        for name, seconds, values in zip(names, (*known, rest), each, strict=True)
    ]
    heads = ("part", "in all (s)", "share", "median of one (ms)")
    return table("Division of the time, all processes together", heads, listed)


def _plan_seconds(timing: Rows) -> Floats:
    seconds = timing.number("plan_s")
    if "plan" in timing.columns:
        codes, levels = timing.codes("plan")
        first = [int(np.flatnonzero(codes == k)[0]) for k in range(len(levels))]
        seconds = seconds[first]
    return seconds[~np.isnan(seconds)]


def _milliseconds(values: Floats) -> str:
    values = values[~np.isnan(values)]
    return f"{1e3 * float(np.median(values)):.0f}" if len(values) else "–"


def _written(findings: Findings) -> str:
    path = findings.study.folder / STUDY_FILE
    if not path.exists():
        return ""
    return f"{datetime.fromtimestamp(path.stat().st_mtime, UTC):%Y-%m-%d %H:%M UTC}"
