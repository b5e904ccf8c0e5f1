"""Reports of a study folder: a self-contained page, its figures and its text."""

import base64
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.html.page import embed_figure
from flexneedle.lab.study.report.report import write_report
from report_page import Page, save_nothing
from study_rows import OURS, make_rows, unfinished, write_study

TARGETS = ((25.0, 0.0), (40.0, 5.0), (45.0, -5.0))
BOTH = (OURS, "open-loop")
EVIL = "<script>alert(1)</script> & \"'><img src=x onerror=alert(2)>"
ABOUT = {
    "command": "flexneedle study mine.toml --workers 2",
    "study": {
        "title": "My study",
        "cases": {},
        "axes": {"controller": list(BOTH), "target": [list(target) for target in TARGETS]},
        "insertions": 24,
    },
}
AXES = {"contact.spacing_mm": [0.5, 1.0], "needle.gauge": ["18G", "21G"]}
CASES = {"base": {}, "skew": {"phantom.run_out_mm": 1.0}, "bent": {"phantom.initial_bend_mm": 1.0}}


@pytest.fixture
def sketched_on(tmp_path, monkeypatch):
    """Return a function from rows to a report and its page; figures are drawn, but saved as empty files."""
    monkeypatch.setattr("flexneedle.lab.study.report.figures.save", save_nothing)

    def write(rows, about=None, **options):
        report = write_report(write_study(tmp_path / "study", rows, about, **options))
        return report, Page(report.page)

    return write


@pytest.fixture
def report_on(sketched_on, monkeypatch):
    """Return the same function without figures."""
    monkeypatch.setattr("flexneedle.lab.study.report.report.draw_figures", lambda *_: [])
    return sketched_on


@pytest.fixture
def rows():
    return make_rows(BOTH, targets=TARGETS, repeats=4)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A report for read-only tests, and its page."""
    rows = make_rows(BOTH, targets=TARGETS, repeats=4)
    report = write_report(write_study(tmp_path_factory.mktemp("study"), rows, ABOUT))
    return report, Page(report.page)


def test_a_page_is_self_contained_and_accessible(plain):
    report, page = plain
    text = report.page.read_text(encoding="utf-8")
    assert page.open == []
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    assert not any("href" in attributes or "srcset" in attributes for _, attributes in page.tags)
    assert not re.search(r"url\(|@import|https?:", text.split("<style>")[1].split("</style>")[0])
    policy = next(meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    assert policy.startswith("default-src 'none'")
    assert page.all("html") == [{"lang": "en"}]
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all("meta")
    assert all(len(image["alt"]) > 40 for image in page.all("img"))
    assert len(page.all("table")) == len(page.all("caption"))
    boxes = re.findall(r'<div class="scroll"[^>]*><(?:table|img)\b', text)
    assert len(boxes) == len(page.all("table") + page.all("img"))  # the page never scrolls sideways
    for line in (ABOUT["command"], "My study: report", "numba 0.68.0", "phantom.run_out_mm 0.2"):
        assert line in page.text


def test_each_cell_of_a_table_has_its_heading_as_label(report_on):
    """On a narrow screen, where a row is a card, the label is the only heading."""
    rows = make_rows((*BOTH, "ce-mpc"), CASES, targets=TARGETS, repeats=2)
    rows[0] = unfinished(rows[0])
    tables = report_on(rows)[1].tables
    assert len(tables) == 7
    for table in tables.values():
        assert len(table.labels) > 0
        assert all(labels == table.headings for labels in table.labels)


def test_figures_in_the_page_are_those_in_the_folder(plain, monkeypatch):
    report, page = plain
    inside = [base64.b64decode(image["src"].split(",")[1]) for image in page.all("img")]
    assert inside == [drawn.svg.read_bytes() for drawn in report.figures]
    assert all(ElementTree.fromstring(data).tag.endswith("svg") for data in inside)
    monkeypatch.setattr("flexneedle.lab.html.page._LARGEST_SVG", 1000)
    large = embed_figure(report.figures[0]).removeprefix("data:image/png;base64,")
    assert base64.b64decode(large) == report.figures[0].png.read_bytes()


@pytest.mark.parametrize(
    ("options", "more"),
    [
        ({}, []),
        ({"controllers": BOTH}, ["front", "controllers"]),
        ({"axes": AXES}, ["error-along-1", "error-along-2"]),
        ({"cases": CASES}, ["cases"]),
        ({"targets": TARGETS[:1]}, []),
    ],
)
def test_figures_are_those_that_the_rows_support(sketched_on, options, more):
    rows = make_rows(**{"targets": TARGETS, "repeats": 3} | options)
    report, _ = sketched_on(rows, axes=options.get("axes", {}))
    drawn = {one.name: one for one in report.figures}
    assert sorted(drawn) == sorted(["targeting", "errors-by-depth", *more])
    pooled = drawn["errors-by-depth"].caption.partition("pooled over ")[2]
    assert pooled.startswith("needle gauge" if "axes" in options else "")


def test_cases_of_one_controller_have_separate_panels(sketched_on):
    """Cases differ on purpose: pooled errors would have no meaning."""
    rows = make_rows(cases=CASES, targets=TARGETS, repeats=3)
    for row in rows:
        row["true_error_mm"] = 0.7 if row["case"] == "bent" else 0.2
    drawn = {one.name: one for one in sketched_on(rows)[0].figures}
    for name in ("targeting", "errors-by-depth"):
        base, bent = drawn[name].alt.split("bent: ")
        assert "base: " in base
        assert "0.2" in base
        assert "0.7" in bent
        assert "pooled" not in drawn[name].caption


def test_the_front_has_errors_and_peaks_of_finished_insertions(sketched_on, monkeypatch):
    """Each controller's; the peak relative to E₁ of its row."""
    shown = []
    monkeypatch.setattr("flexneedle.lab.study.report.figures.draw_front", lambda panels: shown.extend(panels))
    rows = make_rows(BOTH, targets=TARGETS[:1], repeats=2)
    rows[3] = unfinished(rows[3])
    for row, error, peak in zip(rows, (0.1, 0.2, 1.1, 1.2), (3.0, 4.0, 5.0, 6.0), strict=True):
        row |= {"true_error_mm": error, "peak_energy_uj": peak, "energy_scale_uj": 2.0}
    sketched_on(rows)
    (panel,) = shown
    found = {sample.name: (sample.errors.tolist(), sample.peaks.tolist()) for sample in panel.content}
    assert found == {BOTH[0]: ([0.1, 0.2], [1.5, 2.0]), BOTH[1]: ([1.1], [2.5])}


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


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (None, "every other controller in mean true error."),
        (0.9, "0 of 2 other controllers in mean true error; not separable from open-loop; worse than"),
    ],
)
def test_the_headline_compares_the_default_with_the_others(report_on, error, verdict):
    rows = make_rows((OURS, "open-loop", "bevel-only"), targets=TARGETS, repeats=8)
    for row in rows:
        if error and row["controller"] != "bevel-only":
            row["true_error_mm"] = error + 0.001 * row["seed"]
        row["peak_energy_uj"] = {OURS: 3.0, "open-loop": 2.0, "bevel-only": 1.0}[row["controller"]]
    text = report_on(rows)[1].text
    assert f"{OURS} is better than {verdict}" in text
    assert "Its peak tissue energy is 1.5 to 3 times as large." in text
    assert "pairs); its peak tissue energy is 1.5 times as large." in text


def test_the_headline_of_few_phantoms_names_no_verdict(report_on):
    text = report_on(make_rows((OURS, "open-loop"), targets=TARGETS[:1], repeats=2))[1].text
    assert f"{OURS} cannot be compared with the other controllers in mean true error." in text
    assert "is better than" not in text


def test_effort_is_reported_relative_to_the_plan(report_on):
    rows = make_rows(targets=TARGETS, repeats=4)
    for row in rows:
        row |= {"flips": 3, "planned_flips": 1, "periods": 66, "planned_periods": 60}
        row |= {"strain_energy_mj": 0.006, "planned_strain_energy_mj": 0.005, "unconverged_periods": 0}
        row |= {"peak_energy_uj": 9.0, "planned_peak_energy_uj": 6.0, "guide_travel_mm": 3.0}
    rows[0] |= {"unconverged_periods": 2, "periods": 72}
    rows[1] |= {"unconverged_periods": 5}
    report, page = report_on(rows)
    head = page.text[: page.text.index("Figures")]
    assert "bevel rolls 3.00 planned 1.00" in head
    assert "peak tissue energy 9 µJ 0.00225 E₁" in head
    assert "peak tissue energy / planned 1.50 1.50 to 1.50" in head
    assert "end tissue energy / planned 1.20 1.20 to 1.20" in head
    assert "guide travel 3.00 mm planned 2.00 mm" in head
    assert "periods / planned 1.11 largest 1.20" in head
    assert "periods not converged 7 in 2 insertions" in head
    assert report.values()["groups"][0]["unconverged_periods"] == 7


def test_clearances_are_in_the_table_of_a_study_with_zones_alone(report_on):
    rows = make_rows(targets=TARGETS, repeats=4)
    zone = {"zone.0.shape": "sphere", "zones.margin_mm": 2.0, "true_clearance_mm": 2.25}
    for each, shown in ((rows, False), ([row | zone for row in rows], True)):
        page = report_on(each)[1]
        headings = [heading for table in page.tables.values() for heading in table.headings]
        assert ("least clearance (mm)" in headings) == ("margin entered" in headings) == shown
        assert ("2.250 mm margin entered by 0 insertions" in page.text) == shown


def test_a_study_of_an_earlier_version_has_the_energy_at_the_end_alone(report_on):
    """The columns of peak, mean, scale and stretch are missing, not the report."""
    new = re.compile("energy_uj|energy_scale|least_stretch|planned_guide")
    rows = [
        {k: v for k, v in row.items() if not new.search(k)} for row in make_rows(targets=TARGETS, repeats=4)
    ]
    for row in rows:
        row |= {"strain_energy_mj": 0.006, "planned_strain_energy_mj": 0.005}
    report, page = report_on(rows)
    assert "end tissue energy / planned 1.20" in page.text
    assert "peak tissue energy / planned –" in page.text
    assert report.values()["groups"][0]["estimates"]["end_energy_uj"]["value"] == pytest.approx(6.0)


def test_the_headline_includes_failures_and_misses_of_all_settings(report_on):
    """The first setting alone has no failure and no miss here; the study is incomplete."""
    axes = {"contact.spacing_mm": [0.5, 1.0]}
    rows = make_rows(axes=axes, targets=TARGETS, repeats=5)
    for row in rows:
        row["true_error_mm"] = 0.1 if row["contact.spacing_mm"] == 0.5 else 0.5
    rows[20]["true_error_mm"] = 1.5
    rows[21] = unfinished(rows[21], "failed", "the needle broke") | {"unconverged_periods": 2}
    rows[22] = unfinished(rows[22], "held", "held for 1.03 s")
    report, page = report_on(rows[:28], axes=axes, insertions=30)
    for text in (
        "Incomplete study: 28 of 30 insertions have a result, 2 are missing.",
        "insertions 28 of 30, 2 missing finished 26 of 28 failed 1 of 28 held 1 of 28 within 1 mm of the target 25",
        f"{OURS}: 26 insertions finished of 28, all settings pooled",
        f"mean true error {(0.1 * 15 + 0.5 * 10 + 1.5) / 26:.3f} mm",
        "2 of 28 insertions did not finish.",
        "failed 1 the needle broke 21",
        "periods not converged 2 in 1 insertion",
    ):
        assert text in page.text
    values = report.values()
    (whole,) = values["whole"]
    assert (whole["count"], whole["finished"], whole["missed"], whole["largest_mm"]) == (28, 26, 1, 1.5)
    assert (values["missing"], values["outcomes"]) == (2, {"done": 26, "failed": 1, "held": 1})
    assert values["worst"][0]["index"] == 20


def in_space(rows):
    """Return the rows with targets in space, at z = 2 mm."""
    more = {"setup.axes": 2, "target.lateral_z_mm": 2.0, "target_lateral_z_mm": 2.0}
    return [row | more | {"tip_z_mm": 2.0 + row["true_error_mm"]} for row in rows]


def test_differences_pair_targets_with_the_same_z(report_on, rows):
    """Rows of the other controller at other z are not compared."""
    rows = in_space(rows)
    apart = [row if row["controller"] == OURS else row | {"target_lateral_z_mm": -2.0} for row in rows]
    for given, pairs in ((rows, len(rows) // 2), (apart, 0)):
        report, page = report_on(given)
        assert [found.pairs for found in report.findings.against] == [pairs]
        assert re.search(r"\d+, -?\d, -?2 ", page.text)


def sds(tip, middle):
    """Columns of the deviations (y, z) from the predictions, the same at each fraction of the depth."""
    return {
        f"predicted_{fraction}_{part}_{axis}_sds": value
        for fraction in ("quarter", "half", "three_quarters")
        for part, values in {"tip": tip, "middle": middle}.items()
        for axis, value in zip("yz", values, strict=True)
    }


def test_coverage_counts_both_axes_of_tip_and_middle(report_on):
    """Of four insertions one is off in y, two in z of the middle; 1.95 is within, 1.97 is not."""
    rows = in_space(make_rows(targets=TARGETS[:1], repeats=4))
    off = [
        ((1.97, 0.1), (0.0, 3.0)),
        ((-1.95, 0.2), (0.1, -2.0)),
        ((1.0, 1.0), (1.0, 1.0)),
        ((0.0,) * 2,) * 2,
    ]
    rows = [row | sds(*of) | {"predicted_half_sd_mm": 0.1} for row, of in zip(rows, off, strict=True)]
    report, page = report_on(rows)
    (found,) = report.findings.predictions
    assert (found.count, found.tip_covered, found.middle_covered) == (4, (7 / 8,) * 3, (6 / 8,) * 3)
    assert "87.5 %" in page.text
    assert "75.0 %" in page.text
    assert report_on(make_rows(repeats=1))[0].findings.predictions == []
    rows = [row | sds((0.5, None), (0.5, None)) for row in make_rows(targets=TARGETS[:1], repeats=4)]
    (found,) = report_on(rows)[0].findings.predictions  # of shapes alone, without warnings
    assert (found.tip_covered, found.unwarned) == ((1.0,) * 3, None)
    assert np.isnan(found.in_vain)


def test_sensors_are_reported_with_medians_and_exclusions(report_on):
    rows = make_rows(targets=TARGETS[:1], repeats=4)
    assert "Sensors along the needle" not in report_on(rows)[1].text
    seen = [(0.5, "", None), (0.9, "frozen", 12.0), (None, "contradicted", 20.0), (None, None, None)]
    keys = [f"sensor_slice 1.5_{key}" for key in ("nis", "excluded", "excluded_mm")]
    rows = [row | dict(zip(keys, values, strict=True)) for row, values in zip(rows, seen, strict=True)]
    report, page = report_on(rows)
    (found,) = report.findings.sensors
    assert (found.sensor, found.count, found.median_nis, found.excluded_mm) == ("slice 1.5", 3, 0.7, 16.0)
    assert report.values()["sensors"][0]["excluded"] == {"frozen": 1, "contradicted": 1}
    assert "1 frozen, 1 contradicted" in page.text
    assert keys[0] not in page.text


def test_text_from_data_is_escaped(sketched_on, rows):
    about = {"command": EVIL, "study": ABOUT["study"] | {"title": EVIL}}
    evil = [
        row | {"controller": EVIL, "case": EVIL, "version_numpy": EVIL, "mine.raw": EVIL} for row in rows[:12]
    ]
    evil[3] = unfinished(evil[3], EVIL, EVIL)
    _, page = sketched_on([*evil, *rows[12:]], about)
    assert not page.all("script")
    assert all(set(attributes) <= {"src", "alt"} for attributes in page.all("img"))
    assert EVIL in " ".join(page.words)


def test_two_reports_of_the_same_rows_differ_at_most_in_the_run(tmp_path, plain, rows):
    about = ABOUT | {"command": "flexneedle study mine --out elsewhere"}
    again = write_report(write_study(tmp_path / "study", rows[::-1], about), tmp_path / "elsewhere")
    folders = [report.page.parent for report in (plain[0], again)]
    run = re.compile(r'<section id="run">.*?</section>', re.DOTALL)
    first, second = (run.sub("", (folder / "report.html").read_text()) for folder in folders)
    assert first == second
    files = [sorted(path.name for path in folder.iterdir()) for folder in folders]
    assert files[0] == files[1]
    for name in set(files[0]) - {"report.html"}:
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()


@pytest.mark.parametrize(("outcome", "figures"), [("refused", []), ("held", ["targeting"])])
def test_a_study_without_finished_insertions_is_reported(sketched_on, tmp_path, rows, outcome, figures):
    report, page = sketched_on([unfinished(row, outcome, "why") for row in rows])
    assert [drawn.name for drawn in report.figures] == figures
    assert f"finished 0 of 24 {outcome} 24 of 24 within 1 mm of the target 0 of 24" in page.text
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_report(tmp_path / "study", tmp_path / "file")


def rewrite(change):
    """Return a function that changes the table of the bytes of `runs.parquet`."""

    def changed(data):
        sink = pa.BufferOutputStream()
        pq.write_table(change(pq.read_table(pa.BufferReader(data))), sink)
        return sink.getvalue().to_pybytes()

    return changed


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("study.json", None, "no study.json: give the folder"),
        ("study.json", lambda _: b"[1]", "study.json: damaged"),
        ("study.json", lambda _: b'{"study": {}}', "study.json: damaged: KeyError"),
        ("study.json", lambda data: data.replace(b'"cases": {}', b'"cases": 3'), "study.json: damaged"),
        ("runs.parquet", None, "no runs.parquet: the study was killed or is still running"),
        ("runs.parquet", lambda data: data[:-100], "runs.parquet: damaged, or not a Parquet file"),
        ("runs.parquet", rewrite(lambda table: table.slice(0, 0)), "contains no insertions"),
        ("runs.parquet", rewrite(lambda table: table.drop_columns("outcome")), "missing columns outcome"),
    ],
)
def test_an_invalid_study_folder_is_rejected_in_one_line(tmp_path, rows, file, change, message):
    path = write_study(tmp_path / "study", rows) / file
    path.write_bytes(change(path.read_bytes())) if change else path.unlink()
    with pytest.raises(InputError) as caught:
        write_report(tmp_path / "study")
    (line,) = str(caught.value).splitlines()
    assert str(tmp_path / "study") in line
    assert message in line
