"""Reports of a study folder: a self-contained page, its figures and its text."""

import base64
import math
import re
import shlex
import xml.etree.ElementTree as ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.study.report.page import embed_figure as data_url
from flexneedle.lab.study.report.report import write_report
from flexneedle.scenario.files import load_scenario
from report_page import Page, save_nothing
from study_rows import BASE, OURS, make_rows, unfinished, write_study

TARGETS = ((25.0, 0.0), (40.0, 5.0), (45.0, -5.0))
BOTH = (OURS, "open-loop")
EVIL = "<script>alert(1)</script> & \"'><img src=x onerror=alert(2)>"
ABOUT = {
    "format": 1,
    "command": "flexneedle study mine.toml --workers 2",
    "versions": {"flexneedle": "0.3.0"},
    "study": {
        "name": "mine",
        "title": "My study",
        "cases": {},
        "axes": {"controller": list(BOTH), "target": [list(target) for target in TARGETS]},
        "insertions": 24,
    },
}


@pytest.fixture
def drawn_on(tmp_path):
    """Return a function from rows to a report and its page."""

    def write(rows, about=None, **options):
        report = write_report(write_study(tmp_path / "study", rows, about, **options))
        return report, Page(report.page)

    return write


@pytest.fixture
def report_on(drawn_on, monkeypatch):
    """Return the same function without figures, which are slow."""
    monkeypatch.setattr("flexneedle.lab.study.report.report.draw_figures", lambda *_: [])
    return drawn_on


@pytest.fixture
def sketched_on(drawn_on, monkeypatch):
    """Return the same function with figures that are drawn, but saved as empty files: rendering is slow."""
    monkeypatch.setattr("flexneedle.lab.study.report.figures.save", save_nothing)
    return drawn_on


@pytest.fixture
def rows():
    return make_rows(BOTH, targets=TARGETS, repeats=4)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A report for read-only tests, and its page."""
    rows = make_rows(BOTH, targets=TARGETS, repeats=4)
    report = write_report(write_study(tmp_path_factory.mktemp("study"), rows, ABOUT))
    return report, Page(report.page)


def names(report):
    return [drawn.name for drawn in report.figures]


def test_a_page_is_self_contained(plain):
    report, page = plain
    assert page.open == []
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    assert all(image["src"].startswith("data:image/") for image in page.all("img"))
    assert not any("href" in attributes or "srcset" in attributes for _, attributes in page.tags)
    style = report.page.read_text(encoding="utf-8").split("<style>")[1].split("</style>")[0]
    assert not re.search(r"url\(|@import|https?:", style)
    policy = next(meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    assert policy.startswith("default-src 'none'")


def test_a_page_is_accessible(plain):
    _, page = plain
    assert page.all("html") == [{"lang": "en"}]
    assert "My study: report" in page.text
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all("meta")
    assert all(len(image["alt"]) > 40 for image in page.all("img"))
    assert len(page.all("table")) == len(page.all("caption"))
    assert [tag for tag, _ in page.tags if tag in ("h1", "main")] == ["main", "h1"]


def test_each_cell_of_a_table_has_its_heading_as_label(report_on):
    """On a narrow screen, where a row is a card, the label is the only heading."""
    cases = {"base": {}, "bent": {"phantom.initial_bend_mm": 1.0}}
    rows = make_rows((*BOTH, "ce-mpc"), cases, targets=TARGETS, repeats=4)
    rows[0] = unfinished(rows[0])
    tables = report_on(rows)[1].tables
    assert len(tables) == 7
    for table in tables.values():
        assert len(table.labels) > 0
        assert all(labels == table.headings for labels in table.labels)


def rules(page):
    """Return the style rules of a page by selector, without media queries."""
    style = page.read_text(encoding="utf-8").split("<style>")[1].split("</style>")[0]
    everywhere = re.sub(r"@(media|page)[^{]*\{(?:[^{}]|\{[^{}]*\})*\}", "", style)
    return {
        name.strip(): body
        for names, body in re.findall(r"([^{}]+)\{([^{}]*)\}", everywhere)
        for name in names.split(",")
    }


def test_a_wide_table_or_figure_scrolls_in_its_own_box(plain):
    """The page itself never scrolls sideways, at any width."""
    report, page = plain
    found = rules(report.page)
    assert "overflow-x: auto" in found[".scroll"]
    assert "overflow-x: auto" in found["pre"]
    assert "overflow-wrap: anywhere" in found["h1"]
    text = report.page.read_text(encoding="utf-8")
    assert len(re.findall(r'<div class="scroll"[^>]*><(?:table|img)\b', text)) == len(
        page.all("table") + page.all("img")
    )


def test_intervals_and_commands_wrap(plain):
    found = rules(plain[0].page)
    assert "white-space: normal" in found["td small"]
    assert "white-space: normal" in found["td.words"]
    assert "overflow-wrap: anywhere" in found["td.words"]
    assert "overflow-wrap: anywhere" in found["code"]


def test_figures_in_the_page_are_those_in_the_folder(plain):
    report, page = plain
    inside = [base64.b64decode(image["src"].split(",")[1]) for image in page.all("img")]
    assert inside == [drawn.svg.read_bytes() for drawn in report.figures]
    for data in inside:
        assert ElementTree.fromstring(data).tag.endswith("svg")
    assert all(drawn.png.read_bytes().startswith(b"\x89PNG") for drawn in report.figures)


def test_a_large_figure_is_embedded_as_png(plain, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.study.report.page._LARGEST_SVG", 1000)
    inside = [data_url(drawn).removeprefix("data:image/png;base64,") for drawn in plain[0].figures]
    assert list(map(base64.b64decode, inside)) == [drawn.png.read_bytes() for drawn in plain[0].figures]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, ["targeting", "errors-by-depth"]),
        ({"controllers": BOTH}, ["targeting", "errors-by-depth", "controllers"]),
        (
            {"axes": {"contact.spacing_mm": [0.5, 1.0], "needle.gauge": ["18G", "21G"]}},
            ["targeting", "errors-by-depth", "error-along-1", "error-along-2"],
        ),
        (
            {"cases": {"base": {}, "a": {"phantom.run_out_mm": 1.0}, "b": {"phantom.initial_bend_mm": 1.0}}},
            ["targeting", "errors-by-depth", "cases"],
        ),
        ({"targets": TARGETS[:1]}, ["targeting", "errors-by-depth"]),
        ({"targets": TARGETS[:1], "controllers": BOTH}, ["targeting", "errors-by-depth", "controllers"]),
    ],
)
def test_figures_are_those_that_the_rows_support(sketched_on, options, expected):
    rows = make_rows(**{"targets": TARGETS, "repeats": 3} | options)
    report, _ = sketched_on(rows, axes=options.get("axes", {}))
    assert [drawn.name for drawn in report.figures] == expected
    assert sorted(path.name for path in report.page.parent.glob("*.png")) == sorted(
        f"{n}.png" for n in expected
    )


def test_cases_of_one_controller_have_separate_panels(sketched_on):
    """Cases differ on purpose: pooled errors would have no meaning."""
    cases = {"base": {}, "skew": {"phantom.run_out_mm": 1.0}, "bent": {"phantom.initial_bend_mm": 1.0}}
    rows = make_rows(cases=cases, targets=TARGETS, repeats=3)
    for row in rows:
        row["true_error_mm"] = 0.7 if row["case"] == "bent" else 0.2
    drawn = {one.name: one for one in sketched_on(rows)[0].figures}
    for name in ("targeting", "errors-by-depth"):
        base, bent = drawn[name].alt.split("bent: ")
        assert "base: " in base
        assert "0.2" in base
        assert "0.7" in bent
        assert "pooled" not in drawn[name].caption


def test_the_caption_names_the_pooled_factors(sketched_on):
    axes = {"contact.spacing_mm": [0.5, 1.0], "needle.gauge": ["18G", "21G"]}
    rows = make_rows(axes=axes, targets=TARGETS, repeats=3)
    drawn = {one.name: one for one in sketched_on(rows, axes=axes)[0].figures}
    for name in ("errors-by-depth",):
        assert "contact.spacing_mm" not in drawn[name].caption
        assert "pooled over needle gauge" in drawn[name].caption


def test_a_study_without_finished_insertions_is_reported(sketched_on, rows):
    report, page = sketched_on([unfinished(row, "refused", "plan misses") for row in rows])
    assert names(report) == []
    assert "finished 0 of 24 refused 24 of 24 within 1 mm of the target 0 of 24" in page.text
    assert "24 of 24 insertions did not finish." in page.text


def test_without_finished_insertions_only_the_tips_are_drawn(sketched_on, rows):
    assert names(sketched_on([unfinished(row) for row in rows])[0]) == ["targeting"]


def test_numbers_of_the_page_are_those_of_the_summary(plain):
    report, page = plain
    group = report.values()["groups"][0]
    found = {name: estimate["value"] for name, estimate in group["estimates"].items()}
    for text in (
        f"{found['mean_mm']:.3f} ± {found['sd_mm']:.3f}",
        f"{found['p95_mm']:.3f}",
        f"{group['largest_mm']:.3f}",
        f"{found['flips']:.2f} ({found['planned_flips']:.2f})",
        f"{found['period_ratio']:.3f} ({group['largest_period_ratio']:.3f})",
        f"{group['estimates']['mean_mm']['low']:.3f} to {group['estimates']['mean_mm']['high']:.3f}",
    ):
        assert text in page.text
    assert f"{OURS} is better than open-loop in mean true error: −" in page.text


def test_a_default_that_is_worse_is_reported(report_on, rows):
    for row in rows:
        row["true_error_mm"] *= 100.0 if row["controller"] == OURS else 1.0
    assert f"{OURS} is worse than open-loop in mean true error: +" in report_on(rows)[1].text


def test_the_headline_compares_the_default_with_the_others(report_on):
    rows = make_rows((OURS, "open-loop", "bevel-only"), targets=TARGETS, repeats=8)
    assert f"{OURS} is better than every other controller in mean true error." in report_on(rows)[1].text
    for row in rows:
        if row["controller"] != "bevel-only":
            row["true_error_mm"] = 0.9 + 0.001 * row["seed"]
    _, page = report_on(rows)
    assert (
        f"{OURS} is better than 0 of 2 other controllers in mean true error; "
        "not separable from open-loop; worse than bevel-only." in page.text
    )


def test_effort_is_reported_relative_to_the_plan(report_on):
    rows = make_rows(targets=TARGETS, repeats=4)
    for row in rows:
        row |= {"flips": 3, "planned_flips": 1, "periods": 66, "planned_periods": 60}
        row |= {"strain_energy_mj": 0.006, "planned_strain_energy_mj": 0.005, "unconverged_periods": 0}
    rows[0] |= {"unconverged_periods": 2, "periods": 72}
    rows[1] |= {"unconverged_periods": 5}
    report, page = report_on(rows)
    head = page.text[: page.text.index("Figures")]
    assert "bevel flips 3.00 planned 1.00" in head
    assert "tissue energy / planned 1.20 1.20 to 1.20" in head
    assert "periods / planned 1.11 largest 1.20" in head
    assert "periods not converged 7 in 2 insertions" in head
    assert report.values()["groups"][0]["unconverged_periods"] == 7


def test_command_versions_and_definitions_are_there(report_on, rows):
    _, page = report_on(rows, ABOUT)
    for text in (
        "flexneedle study mine.toml --workers 2",
        "numba 0.68.0",
        "linear interpolation",
        "2000 resamples, seed 0",
        "phantom.run_out_mm 0.2",
    ):
        assert text in page.text


def test_columns_of_any_kind_are_shown_as_settings(report_on, rows):
    page = report_on([row | {"mine.own": {"a": 1}, "mine.raw": b"x"} for row in rows])[1]
    assert "mine.own {'a': 1}" in page.text


def test_unfinished_insertions_are_counted_and_listed(report_on, rows):
    rows[0] = unfinished(rows[0], "held", "held for 1.03 s")
    rows[5] = unfinished(rows[5], "held", "held for 2.00 s")
    rows[7] = unfinished(rows[7], "error", "ZeroDivisionError: x") | {"unconverged_periods": 2}
    report, page = report_on(rows)
    assert "3 of 24 insertions did not finish." in page.text
    assert "held 2 held for 1.03 s 0 flexneedle insert" in page.text
    assert "error 1 ZeroDivisionError: x 7 flexneedle insert" in page.text
    assert "insertions 24 of 24, 0 missing finished 21 of 24 held 2 of 24 error 1 of 24" in page.text
    values = report.values()
    assert (values["finished"], values["outcomes"]) == (21, {"done": 21, "held": 2, "error": 1})


def test_periods_that_did_not_converge_are_counted_of_all_insertions(report_on, rows):
    rows = [row | {"controller": OURS} for row in rows]
    rows[7] = unfinished(rows[7]) | {"unconverged_periods": 2}
    rows[9]["unconverged_periods"] = 1
    assert "periods not converged 3 in 2 insertions" in report_on(rows)[1].text
    assert "periods not converged 1 in 1 insertion " in report_on(rows[9:10])[1].text


def test_the_headline_includes_failures_and_misses_of_all_settings(report_on):
    """Not only those of the first setting, which has no failure and no miss here."""
    axes = {"contact.spacing_mm": [0.5, 1.0]}
    rows = make_rows(axes=axes, targets=TARGETS, repeats=5)
    for row in rows:
        row["true_error_mm"] = 0.1 if row["contact.spacing_mm"] == 0.5 else 0.5
    rows[20]["true_error_mm"] = 1.5
    rows[21] = unfinished(rows[21], "failed", "the needle broke")
    rows[22] = unfinished(rows[22], "held", "held for 1.03 s")
    report, page = report_on(rows[:28], axes=axes, insertions=30)
    assert (
        "insertions 28 of 30, 2 missing finished 26 of 28 failed 1 of 28 held 1 of 28 "
        "within 1 mm of the target 25 of 30" in page.text
    )
    assert f"{OURS}: 26 insertions finished of 28, all settings pooled" in page.text
    errors = [0.1] * 15 + [0.5] * 10 + [1.5]
    assert f"mean true error {sum(errors) / 26:.3f} mm" in page.text
    (whole,) = report.values()["whole"]
    assert (whole["count"], whole["finished"], whole["missed"], whole["largest_mm"]) == (28, 26, 1, 1.5)
    assert whole["estimates"]["mean_mm"]["value"] == pytest.approx(sum(errors) / 26)


def test_the_headline_has_a_row_for_each_controller(report_on):
    axes = {"contact.spacing_mm": [0.5, 1.0]}
    rows = make_rows(BOTH, axes=axes, targets=TARGETS, repeats=4)
    values = report_on(rows, axes=axes)[0].values()
    assert [group["levels"] for group in values["whole"]] == [{"controller": name} for name in BOTH]
    assert [group["count"] for group in values["whole"]] == [24, 24]
    assert [group["count"] for group in values["groups"]] == [12] * 4


def test_an_incomplete_study_is_reported_at_the_top(report_on, rows):
    _, page = report_on(rows[:17], ABOUT)
    alarm = "Incomplete study: 17 of 24 insertions have a result, 7 are missing."
    assert alarm in page.text
    assert page.text.index(alarm) < page.text.index("mean true error")
    assert "Incomplete" not in report_on(rows, ABOUT)[1].text


def test_the_planned_number_is_that_of_study_json(report_on, rows):
    assert report_on(rows[:17], ABOUT)[0].values()["planned"] == 24
    assert report_on(rows[:17], insertions=100)[0].values()["missing"] == 83


def test_the_worst_have_a_command_to_reproduce_them(report_on):
    rows = make_rows(("open-loop",), targets=TARGETS, repeats=5)
    report, page = report_on(rows)
    worst = report.values()["worst"]
    assert len(worst) == 10
    first = max(rows, key=lambda row: row["true_error_mm"])
    assert worst[0]["index"] == first["index"]
    assert worst[0]["command"] == (
        f"flexneedle insert phantom --target {first['target_depth_mm']:g} {first['target_lateral_mm']:g} "
        f"--seed {first['seed']} --plan-seed 0 --controller open-loop --phantom exact --strategy manipulation"
    )
    assert worst[0]["command"] in page.text


def in_space(rows, off=1.0):
    """The rows as those of a study in space: targets at z = 2 mm, tips beyond them along z by `off` of their error."""
    return [
        row
        | {"setup.axes": 2, "target.lateral_z_mm": 2.0, "target_lateral_z_mm": 2.0}
        | {"tip_z_mm": 2.0 + off * row["true_error_mm"]}
        for row in rows
    ]


def test_targets_in_space_have_three_numbers_in_page_and_command(report_on, rows):
    report, page = report_on(in_space(rows))
    depth, lateral = (
        rows[report.findings.worst[0]]["target_depth_mm"],
        rows[report.findings.worst[0]]["target_lateral_mm"],
    )
    assert f"--target {depth:g} {lateral:g} 2 --seed" in report.values()["worst"][0]["command"]
    assert f"{depth:g}, {lateral:g}, 2" in page.text


def test_differences_pair_targets_with_the_same_z(report_on, rows):
    """Rows of the other controller at other z are not compared."""
    rows = in_space(rows)
    ours = rows[0]["controller"]
    apart = [row if row["controller"] == ours else row | {"target_lateral_z_mm": -2.0} for row in rows]
    assert [found.pairs for found in report_on(rows)[0].findings.against] == [len(rows) // 2]
    assert [found.pairs for found in report_on(apart)[0].findings.against] == [0]


def sds(tip, middle):
    """Columns of the deviations (y, z) from the predictions, the same at each fraction of the depth."""
    both = {"tip": tip, "middle": middle}
    return {
        f"predicted_{fraction}_{part}_{axis}_sds": value
        for fraction in ("quarter", "half", "three_quarters")
        for part, values in both.items()
        for axis, value in zip("yz", values, strict=True)
    }


def test_coverage_counts_both_axes_of_tip_and_middle(report_on):
    """Of four insertions one is off in y, two in z of the middle; 1.95 is within, 1.97 is not."""
    rows = in_space(make_rows(targets=TARGETS[:1], repeats=4))
    deviations = [
        ((1.97, 0.1), (0.0, 3.0)),
        ((-1.95, 0.2), (0.1, -2.0)),
        ((1.0, 1.0), (1.0, 1.0)),
        ((0.0,) * 2,) * 2,
    ]
    rows = [row | sds(*of) | {"predicted_half_sd_mm": 0.1} for row, of in zip(rows, deviations, strict=True)]
    report, page = report_on(rows)
    (found,) = report.findings.predictions
    assert (found.count, found.tip_covered, found.middle_covered) == (4, (7 / 8,) * 3, (6 / 8,) * 3)
    assert "87.5 %" in page.text
    assert "75.0 %" in page.text


def test_a_controller_that_predicts_shapes_alone_warns_of_nothing(report_on):
    rows = [row | sds((0.5, None), (0.5, None)) for row in make_rows(targets=TARGETS[:1], repeats=4)]
    (found,) = report_on(rows)[0].findings.predictions
    assert (found.tip_covered, found.unwarned) == ((1.0,) * 3, None)
    assert np.isnan(found.in_vain)


def test_tables_without_predictions_have_no_coverage(report_on, rows):
    """Nor have they a second axis."""
    young = ("setup.axes", "setup.guide_axes", "setup.rotation", "entry.")
    rows = [
        {name: value for name, value in row.items() if "_z_" not in name and not name.startswith(young)}
        for row in rows
    ]
    assert not any(name.endswith("_sds") for name in rows[0])
    report, _ = report_on(rows)
    assert report.findings.predictions == []


def test_other_scenarios_are_written_for_the_commands(report_on):
    cases = {
        "base": {},
        "bent": {"phantom.initial_bend_mm": 5.0},
        "soft": {"tissue.1.shear_modulus_kpa": 2.0},
    }
    rows = make_rows(cases=cases, targets=TARGETS, repeats=2)
    for row in rows:
        row["true_error_mm"] = {"base": 0.1, "bent": 2.0, "soft": 3.0}[row["case"]] + 1e-3 * row["index"]
    report, _ = report_on(rows)
    used = [shlex.split(entry["command"])[2] for entry in report.values()["worst"]]
    assert used == ["scenario-1.toml"] * 6 + ["scenario-2.toml"] * 4
    soft, bent = (load_scenario(report.page.parent / name) for name in ("scenario-1.toml", "scenario-2.toml"))
    ours = {"target.depth_mm", "target.lateral_mm", "name"}
    for scenario, changed in ((soft, cases["soft"]), (bent, cases["bent"])):
        flat = {key: value for key, value in scenario.flat().items() if key not in ours}
        assert flat == {key: value for key, value in (BASE | changed).items() if key not in ours}


def test_settings_of_another_version_have_no_command(report_on, rows):
    report, page = report_on([row | {"phantom.no_such_key": 1.0} for row in rows])
    assert report.values()["worst"][0]["command"] == ""
    assert "settings not valid in this version" in page.text


def test_text_from_data_is_escaped(drawn_on, rows):
    about = {"command": EVIL, "study": ABOUT["study"] | {"name": EVIL, "title": EVIL}}
    evil = [row | {"controller": EVIL, "case": EVIL, "version_numpy": EVIL} for row in rows[:12]]
    evil[3] = unfinished(evil[3], EVIL, EVIL)
    report, page = drawn_on([*evil, *rows[12:]], about)
    assert not page.all("script")
    assert all(
        "onerror" not in attributes and set(attributes) <= {"src", "alt"} for attributes in page.all("img")
    )
    assert EVIL in " ".join(page.words)
    assert all(b"<script>" not in drawn.svg.read_bytes() for drawn in report.figures)


def test_two_reports_of_the_same_rows_differ_at_most_in_the_run(tmp_path, plain, rows):
    about = ABOUT | {"command": "flexneedle study mine --out elsewhere"}
    again = write_report(write_study(tmp_path / "study", rows, about), tmp_path / "elsewhere")
    pages = [report.page for report in (plain[0], again)]
    assert pages[0].read_text() != pages[1].read_text()
    run = re.compile(r'<section id="run">.*?</section>', re.DOTALL)
    first, second = (run.sub("", page.read_text()) for page in pages)
    assert first == second
    files = [sorted(path.name for path in page.parent.iterdir()) for page in pages]
    assert files[0] == files[1]
    for name in set(files[0]) - {"report.html"}:
        assert (pages[0].parent / name).read_bytes() == (pages[1].parent / name).read_bytes()


def test_rows_in_another_order_are_the_same_study(report_on, rows):
    first = report_on(rows)[0].values()["groups"]
    assert report_on(rows[::-1])[0].values()["groups"] == first


def test_a_report_is_written_to_the_given_folder(tmp_path, rows, report_on):
    folder = tmp_path / "study"
    assert report_on(rows)[0].page == folder / "report" / "report.html"
    assert write_report(folder, tmp_path / "a" / "b").page == tmp_path / "a" / "b" / "report.html"
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_report(folder, tmp_path / "file")


def lacking(folder, rows):
    write_study(folder, [{key: value for key, value in row.items() if key != "outcome"} for row in rows])


def twice(folder, rows):
    write_study(folder, [*rows, rows[3]])


def damaged(folder, rows):
    path = write_study(folder, rows) / "runs.parquet"
    path.write_bytes(path.read_bytes()[:-100])


def no_json(folder, rows):
    (write_study(folder, rows) / "study.json").write_text("{")


def no_object(folder, rows):
    (write_study(folder, rows) / "study.json").write_text("[1]")


def unfinished_study(folder, rows):
    (write_study(folder, rows) / "runs.parquet").unlink()


def without_study(folder, rows):
    (write_study(folder, rows) / "study.json").unlink()


def with_column(name, values):
    """Return a function that writes a study with this column: one value, or a list with one per row."""

    def write(folder, rows):
        given = values if isinstance(values, list) else [values] * len(rows)
        write_study(folder, [row | {name: value} for row, value in zip(rows, given, strict=True)])

    return write


def with_study(**changed):
    """Return a function that writes a study with a changed study.json."""
    return lambda folder, rows: write_study(folder, rows, ABOUT | {"study": ABOUT["study"] | changed})


def without_rows(folder, rows):
    path = write_study(folder, rows) / "runs.parquet"
    pq.write_table(pq.read_table(path).slice(0, 0), path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda *_: None, "no such folder: give the folder of"),
        (lambda folder, _: folder.mkdir(), "contains no study: there is no study.json"),
        (without_study, "contains no study: there is no study.json"),
        (unfinished_study, "the study was killed or is still running"),
        (damaged, "runs.parquet: damaged, or not a Parquet file"),
        (without_rows, "contains no insertions"),
        (lacking, "not the rows of a study: missing columns outcome"),
        (twice, "damaged: index 3 occurs more than once"),
        (no_json, "study.json: damaged"),
        (no_object, "study.json: damaged: must contain one JSON object"),
        (with_column("index", "a"), 'runs.parquet: .* row 1: index = "a": must be a whole number'),
        (with_column("index", [*range(23), None]), "row 24: index: must be a whole number"),
        (with_column("controller", 3), "row 1: controller = 3: must be text"),
        (with_column("target_depth_mm", "far"), 'row 1: target_depth_mm = "far": must be a number'),
        (with_column("target_depth_mm", None), "row 1: target_depth_mm: must be a number"),
        (with_column("target_lateral_mm", math.inf), "row 1: target_lateral_mm = inf: must be a finite"),
        (with_column("seed", 0.5), "row 1: seed = 0.5: must be a whole number"),
        (with_column("seed", True), "row 1: seed = true: must be a whole number"),
        (with_column("true_error_mm", "0.1"), 'row 1: true_error_mm = "0.1": must be a number'),
        (with_column("true_error_mm", [0.1] * 23 + [math.inf]), "row 24: true_error_mm = inf: must be a"),
        (with_column("outcome", None), "row 1: outcome: must be text"),
        (with_column("outcome", 7), "row 1: outcome = 7: must be text"),
        (with_study(cases=3), "study.json: damaged: study.cases = 3: .* dictionary"),
        (with_study(cases=["a"]), r'study.cases = \["a"\]: .* dictionary'),
        (with_study(cases={"a": 3}), "study.cases.a = 3: .* dictionary"),
        (with_study(axes=[1, 2]), r"study.json: damaged: study.axes = \[1, 2\]: .* dictionary"),
        (with_study(axes={"target": 3}), "study.axes.target = 3: .* list"),
        (with_study(insertions="x"), 'study.insertions = "x": must be a whole number'),
        (with_study(insertions=0), "study.insertions = 0: must be at least 1"),
        (lambda folder, rows: write_study(folder, rows, {"study": {}}), "study.name: missing"),
        (lambda folder, rows: write_study(folder, rows, {"study": 3}), "study = 3: "),
    ],
)
def test_an_invalid_study_folder_is_rejected_in_one_line(tmp_path, rows, spoil, message):
    folder = tmp_path / "study"
    spoil(folder, rows)
    with pytest.raises(InputError, match=message) as caught:
        write_report(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
