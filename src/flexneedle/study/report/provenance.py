"""The sections on what a study was made with, and on what its numbers mean."""

from collections.abc import Sequence

from flexneedle.study.report.findings import Findings
from flexneedle.study.report.html import Html, element, joined, table
from flexneedle.study.report.reading import Tuning
from flexneedle.study.report.rows import Rows
from flexneedle.study.report.statistics import CONFIDENCE, LEAST_CLUSTERS, RESAMPLES, SEED
from flexneedle.study.report.wording import number, plain_value, words

_SHARE = f"{100 * CONFIDENCE:g} %"


def made_with(findings: Findings, tuning: Sequence[Tuning]) -> Html:
    """Return versions, the tuning of the controllers that took part, and all settings."""
    rows = findings.study.rows
    return element(
        "section",
        element("h2", "What it was made with"),
        table("Versions", ("package", words("version")), _versions(rows)),
        _tuning(rows, [t for t in tuning if t.method in findings.design.controller.names]),
        _settings(rows),
    )


def _versions(rows: Rows) -> list[tuple[str, Html]]:
    columns = [name for name in rows.columns if name.startswith("version_")]
    return [
        (name.removeprefix("version_"), words(", ".join(sorted(set(rows.text(name)))))) for name in columns
    ]


def _tuning(rows: Rows, tuning: Sequence[Tuning]) -> Html | None:
    """Return what tuning chose for each controller, and whether the study used it."""
    if not tuning:
        return None
    heads = ("controller", "budget (insertions)", "phantom seeds", words("note"), "best score (mm)")
    listed = [
        (
            *(tuned.method, tuned.budget, f"{tuned.seeds[0]} to {tuned.seeds[1]}"),
            *(words(tuned.note or "–"), number(tuned.score_mm)),
            words(", ".join(f"{key} = {plain_value(value)}" for key, value in tuned.chosen.items())),
            words(_used(rows, tuned)),
        )
        for tuned in tuning
    ]
    caption = "Settings chosen by tuning, on phantoms of its own"
    return joined(
        (
            element("h3", "Tuning of the controllers"),
            table(caption, (*heads, words("chosen"), words("in this study")), listed),
        )
    )


def _used(rows: Rows, tuned: Tuning) -> str:
    other = [key for key, value in tuned.chosen.items() if rows.codes(key)[1] != [value]]
    return "as chosen" if not other else f"not as chosen: {', '.join(other)}"


def _settings(rows: Rows) -> Html:
    """Return the settings of the scenario, the constant ones with their value."""
    levels = {name: rows.codes(name)[1] for name in rows.columns if "." in name}
    listed = [
        (name, words(plain_value(found[0]) if len(found) == 1 else f"varies: {len(found)} values"))
        for name, found in levels.items()
        if found != [None]
    ]
    return element(
        "details",
        element("summary", "Every setting of the scenario"),
        table("Settings by key, units in the key", ("key", words("value")), listed),
    )


def method() -> Html:
    """Return how each number is defined."""
    return element(
        "section",
        element("h2", "What the numbers mean"),
        element(
            "ul",
            element("li", "The true error is the planar distance from the true tip to the target, depth included; "
                    "the residual is the same by the tracker's last good reading."),
            element("li", "Error and effort are over finished insertions. Those that did not finish stay in the "
                    "count and are listed."),
            element("li", "95 % and the median are quantiles with linear interpolation between the order statistics; "
                    "sd has n − 1 in its denominator. Energy and periods over the plan's are ratios of means; the "
                    "energy is that stored in the tissue at the end."),
            element("li", f"Intervals hold {_SHARE}: percentile bootstrap with {RESAMPLES} resamples, seed {SEED}. "
                    "Drawn again are seeds with all their insertions, because insertions with the same seed meet "
                    f"the same virtual phantom; fewer than {LEAST_CLUSTERS} of them give no interval and no verdict. "
                    "Several intervals are not corrected for being several."),
            element("li", "A maximum has no bootstrap interval, as no resample exceeds it. Given instead is the "
                    f"share of all insertions that, with {_SHARE} confidence, at most lies beyond it."),
            element("li", "Differences are between insertions alike in seed, target, repeat and all other settings, "
                    "both finished. “Not separable”: the interval holds zero."),
        ),
    )  # fmt: skip
