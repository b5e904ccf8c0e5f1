"""The sections with tables: groups, paired differences, endings, the worst."""

from collections.abc import Mapping

from flexneedle.study.report.findings import Findings
from flexneedle.study.report.html import Html, element, joined, table
from flexneedle.study.report.statistics import CONFIDENCE, Estimate
from flexneedle.study.report.summary import DONE, HIT_MM, Difference, Group
from flexneedle.study.report.wording import cell, code, interval, number, signed, words

_SHARE = f"{100 * CONFIDENCE:g} %"


def groups(findings: Findings) -> Html:
    factors = findings.design.factors
    heads = (
        *(factor.label for factor in factors),
        *("insertions", "finished", f"over {HIT_MM:g} mm off", "mean ± sd (mm)", "median (mm)"),
        *("95 % (mm)", "max (mm)", "mean residual (mm)", "flips (plan's)", "energy / plan's"),
        *("periods / plan's (largest)", "with unconverged periods"),
    )
    rows = [_row(group) for group in findings.groups]
    caption = (
        f"True error and effort over the finished insertions; in small print {_SHARE} bootstrap intervals."
    )
    return element("section", element("h2", "Table"), table(caption, heads, rows, names=len(factors)))


def _row(group: Group) -> list[object]:
    found = group.estimates
    spread = f"{number(found['mean_mm'].value)} ± {number(found['sd_mm'].value)}"
    return [
        *group.levels.values(),
        *(group.count, _finished(group), group.missed),
        _with(spread, found["mean_mm"]),
        *(_with(number(found[name].value), found[name]) for name in ("median_mm", "p95_mm")),
        number(group.largest_mm),
        _with(number(found["residual_mm"].value), found["residual_mm"]),
        _with(
            f"{number(found['flips'].value, 2)} ({number(found['planned_flips'].value, 2)})",
            found["flips"],
            2,
        ),
        _with(number(found["energy_ratio"].value, 2), found["energy_ratio"], 2),
        _with(
            f"{number(found['period_ratio'].value)} ({number(group.largest_period_ratio)})",
            found["period_ratio"],
        ),
        group.unconverged,
    ]


def _finished(group: Group) -> object:
    if group.known == group.finished:
        return group.finished
    return joined((str(group.finished), element("small", f"error known of {group.known}")))


def _with(text: str, estimate: Estimate, digits: int = 3) -> Html:
    return joined((text, element("small", interval(estimate, "", digits))))


def controllers(findings: Findings) -> Html | None:
    """Return the paired differences of the default controller from each other one, in all and by depth."""
    differences = findings.against
    if not differences:
        return None
    ours = differences[0].name
    return element(
        "section",
        element("h2", f"{ours} against the others"),
        table(
            f"Mean paired difference of the true error, {ours} minus the other",
            ("other", *_DIFFERENCE),
            [(d.against, *_difference(d)) for d in differences],
        ),
        _by_depth(findings, ours) if len(findings.against_by_depth) > 1 else None,
    )


def _by_depth(findings: Findings, ours: str) -> Html:
    depths = findings.against_by_depth
    rows = zip(*depths.values(), strict=True)
    return table(
        f"The same by depth of the target: {ours} minus the other (mm)",
        ("other", *(f"{depth} mm deep" for depth in depths)),
        [(row[0].against, *map(_marked, row)) for row in rows],
    )


def _marked(found: Difference) -> Html:
    """Return a difference in the colour of its verdict."""
    text = element("span", signed(found.mean_mm.value), class_=(found.verdict or "unknown").split()[0])
    return joined((text, element("small", interval(found.mean_mm, ""))))


def cases(findings: Findings) -> Html | None:
    """Return the paired differences of each case from the base case."""
    if not findings.cases:
        return None
    base = findings.design.cases.names[0]
    return element(
        "section",
        element("h2", "Cases"),
        table(
            f"Mean paired difference of the true error, the case minus {base}",
            ("controller", "case", *_DIFFERENCE),
            [(d.controller, d.name, *_difference(d)) for d in findings.cases],
            names=2,
        ),
    )


_DIFFERENCE = ("pairs", "left out", "difference (mm)", "verdict")


def _difference(found: Difference) -> tuple[object, ...]:
    verdict = found.verdict or "–"
    return (
        found.pairs,
        found.left_out,
        _with(signed(found.mean_mm.value), found.mean_mm),
        element("span", verdict, class_=verdict.split()[0]),
    )


def endings(findings: Findings, again: Mapping[int, str]) -> Html:
    kinds = findings.endings
    rows = findings.study.rows
    missing = len(rows) - findings.finished
    told = (
        "All insertions finished." if not missing else f"{missing} of {len(rows)} insertions did not finish."
    )
    listed = [
        (
            kind.outcome,
            kind.count,
            words(kind.reason or "–"),
            rows.value("index", kind.first),
            code(again[kind.first]),
        )
        for kind in kinds
    ]
    heads = ("outcome", "insertions", words("reason of the first"), "its index", words("to run it again"))
    caption = f"How insertions ended that did not finish, or finished (“{DONE}”) with a remark"
    return element(
        "section",
        element("h2", "Endings"),
        element("p", told),
        table(caption, heads, listed) if listed else None,
    )


def worst(findings: Findings, again: Mapping[int, str]) -> Html | None:
    rows = findings.study.rows
    if not findings.worst:
        return None
    factors = findings.design.factors
    listed = [
        (
            *(rows.value("index", row), *(factor.names[factor.codes[row]] for factor in factors)),
            f"{cell(rows, 'target_depth_mm', row)}, {cell(rows, 'target_lateral_mm', row)}",
            cell(rows, "seed", row),
            *(
                number(rows.number(name)[row])
                for name in ("true_error_mm", "residual_mm", "planned_error_mm")
            ),
            *(cell(rows, "outcome", row), code(again[row])),
        )
        for row in findings.worst
    ]
    heads = (
        *("index", *(factor.label for factor in factors), "target (mm)", "seed", "true error (mm)"),
        *("residual (mm)", "planned (mm)", "outcome", words("to run it again")),
    )
    caption = "Insertions with the largest true errors, finished or not"
    if findings.worlds:
        ours = findings.design.controller.names[0]
        caption = f"Insertions of {ours} with the largest true errors beyond their reach, finished or not"
    return element(
        "section",
        element("h2", "The ten worst" if len(listed) == 10 else "The worst"),
        element(
            "p", "Give the commands in the folder of this page: scenario files that they name lie beside it."
        ),
        table(caption, heads, listed),
    )
