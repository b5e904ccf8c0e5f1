"""The page of a report: sections of safe HTML, made from findings."""

import base64
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from math import isnan

from flexneedle.study.report import provenance, tables
from flexneedle.study.report.figures import Drawn
from flexneedle.study.report.findings import Findings, title_of
from flexneedle.study.report.html import Html, document, element, joined
from flexneedle.study.report.predictions import prediction_table
from flexneedle.study.report.reading import Tuning
from flexneedle.study.report.statistics import LEAST_CLUSTERS
from flexneedle.study.report.summary import HIT_MM, Difference, Group
from flexneedle.study.report.times import times
from flexneedle.study.report.wording import insertions, interval, mm, number, signed
from flexneedle.study.report.worlds import world_table

_LARGEST_SVG = 1_000_000  # bytes; larger figures stand in the page as PNG


def page_text(
    findings: Findings, figures: Sequence[Drawn], again: Mapping[int, str], tuning: Sequence[Tuning] = ()
) -> str:
    """Return the whole page. again: command of each listed row; tuning: records of the controllers' tuning."""
    title = title_of(findings.study.about)
    sections = (
        _opening(findings, title),
        _figures(figures),
        world_table(findings.worlds),
        tables.groups(findings),
        prediction_table(findings.predictions),
        tables.controllers(findings),
        tables.cases(findings),
        tables.endings(findings, again),
        tables.worst(findings, again),
        provenance.made_with(findings, tuning),
        provenance.method(),
        times(findings),
    )
    style = (files("flexneedle.study.report") / "report.css").read_text(encoding="utf-8")
    main = element("main", *(Html("\n" + section) for section in sections if section is not None))
    return document(f"{title}: report", style, main)


def _opening(findings: Findings, title: str) -> Html:
    rows, planned = findings.study.rows, findings.planned
    done = findings.finished
    unfinished = planned is not None and len(rows) < planned
    return element(
        "header",
        element("p", "flexneedle study", class_="quiet"),
        element("h1", title),
        element(
            "p",
            f"This study is not complete: {len(rows)} of {planned} insertions are in. All below is about those.",
            class_="alarm",
            role="status",
        )
        if unfinished
        else None,
        element("p", f"{insertions(len(rows))}, {done} finished" + _unfinished(len(rows) - done) + "."),
        _unconverged(sum(group.unconverged for group in findings.groups)),
        _key_figures(findings.groups[0]) if findings.groups else None,
        _standing(findings.against) if findings.against else None,
    )


def _unfinished(count: int) -> str:
    return f"; {count} did not, and are counted and listed below" if count else ""


def _unconverged(count: int) -> Html | None:
    if not count:
        return None
    have = "has" if count == 1 else "have"
    line = f"{insertions(count)} {have} periods whose solve did not converge: see the table."
    return element("p", line)


def _key_figures(group: Group) -> Html:
    """Return the figures of the first group: that of the default controller at the first settings."""
    found = group.estimates
    shown = (
        ("mean true error", mm(found["mean_mm"].value), interval(found["mean_mm"], " mm")),
        ("95 % below", mm(found["p95_mm"].value), interval(found["p95_mm"], " mm")),
        ("largest", mm(group.largest_mm), _beyond(group)),
        ("finished", f"{group.finished} of {group.count}", f"{group.missed} more than {HIT_MM:g} mm off"),
        *_effort(group),
    )
    boxes = (
        element("div", element("dt", name), element("dd", value, element("small", below)))
        for name, value, below in shown
    )
    return joined((element("p", group.name, class_="quiet"), element("dl", *boxes, class_="key")))


def _effort(group: Group) -> tuple[tuple[str, str, str], ...]:
    """Return what the insertions took, beside what the plans said."""
    found = group.estimates
    return (
        (
            "bevel turns",
            number(found["flips"].value, 2),
            f"plan's {number(found['planned_flips'].value, 2)}",
        ),
        (
            "tissue energy / plan's",
            number(found["energy_ratio"].value, 2),
            interval(found["energy_ratio"], "", 2),
        ),
        (
            "periods / plan's",
            number(found["period_ratio"].value, 2),
            f"largest {number(group.largest_period_ratio, 2)}",
        ),
        ("periods not converged", str(group.unconverged_periods), f"in {insertions(group.unconverged)}"),
    )


def _beyond(group: Group) -> str:
    if isnan(group.beyond_largest):
        return ""
    return f"at most {100 * group.beyond_largest:.2g} % of all lie beyond"


def _standing(against: Sequence[Difference]) -> Html:
    """Say where the first controller stands among the others, then against each."""
    ours, better = against[0].name, [d for d in against if d.verdict == "better"]
    verdict = (
        f"{ours} is better than every other controller in mean true error."
        if len(better) == len(against)
        else f"{ours} is better than {len(better)} of {len(against)} other controllers in mean true error; "
        + "; ".join(_rest(against))
        + "."
    )
    each = element("ul", *(element("li", _sentence(d)) for d in against), class_="verdicts")
    return joined((element("p", element("strong", verdict)), each))


def _rest(against: Sequence[Difference]) -> Iterator[str]:
    """Yield those that the first controller is not better than."""
    for verdict, words in (
        ("not separable", "not separable from"),
        ("worse", "worse than"),
        (None, "not compared with"),
    ):
        names = [d.against for d in against if d.verdict == verdict]
        if names:
            yield f"{words} {', '.join(names)}"


def _sentence(difference: Difference) -> Html:
    """Say whether the first controller is better, worse or not separable from another."""
    ours, other, found = difference.name, difference.against, difference.mean_mm
    numbers = f"{signed(found.value)} mm ({interval(found, ' mm', 3)}, {difference.pairs} pairs)"
    if difference.verdict is None:
        return joined(
            (
                f"{ours} and {other} cannot be compared: fewer than {LEAST_CLUSTERS} phantoms with finished pairs.",
            )
        )
    if difference.verdict == "not separable":
        return joined((f"{ours} is not separable from {other} in mean true error: ", numbers, "."))
    mark = element("span", difference.verdict, class_=difference.verdict)
    return joined((f"{ours} is ", mark, f" than {other} in mean true error: ", numbers, "."))


def _figures(figures: Sequence[Drawn]) -> Html:
    return element("section", element("h2", "Figures"), *map(_figure, figures))


def _figure(drawn: Drawn) -> Html:
    large = drawn.svg.stat().st_size > _LARGEST_SVG
    path, kind = (drawn.png, "image/png") if large else (drawn.svg, "image/svg+xml")
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    image = element("img", src=f"data:{kind};base64,{data}", alt=drawn.alt)
    return element(
        "figure",
        element("h3", drawn.title, id=f"figure-{drawn.name}"),
        element("div", image, class_="scroll"),
        element("figcaption", f"{drawn.caption} ({drawn.png.name}, {drawn.svg.name})"),
    )
