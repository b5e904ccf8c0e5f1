"""Reports on random worlds: errors relative to open loop and reach, and the worst."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexneedle.control.controllers import DEFAULT
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.plans import StudyPlans
from flexneedle.lab.study.report.report import write_report
from flexneedle.lab.study.runner import _find_reach_points
from flexneedle.lab.study.tables import write_tables
from flexneedle.record.results import RESULT_COLUMNS
from report_page import Page, save_nothing

FREE, GUIDED = (15, 16, 31), (1, 2, 3, 4)
STUDY = f"""
name = "few"
title = "A few worlds"
[[cases]]
name = "perfect"
values = {{ world_case = "perfect", plant = "model" }}
[[cases]]
name = "structure"
values = {{ world_case = "structure" }}
[[axes]]
key = "world"
values = {[*FREE, *GUIDED]}
[[axes]]
key = "controller"
values = ["{DEFAULT}", "open-loop"]
"""
ERRORS = {  # of the perfect case, by controller and world (mm)
    DEFAULT: {1: 0.02, 2: 0.5, 3: 1.6, 4: None, 15: 0.1, 16: 4.4, 31: None},
    "open-loop": {1: 0.01, 2: 0.2, 3: 1.5, 4: 0.1, 15: 0.3, 16: None, 31: 2.0},
}
REACH = {1: 0.0, 2: 0.0, 3: 0.0, 4: 0.0, 15: 0.0, 16: 4.0, 31: 3.0}


SIGMAS = {
    1: (0.5, 1.0, 1.9),
    2: (1.0, -2.1, 1.0),
    3: (3.0, -3.0, 2.0),
    15: (None, None, 0.0),
}  # of the default
WARNED = (2, 15)  # worlds of the default's perfect case with a warning


def row_of(study, index, bounded):
    insertion = study.insertion(index)
    point = insertion.point
    error = ERRORS[point.controller][point.world] if point.case == "perfect" else 0.05
    depth, lateral, _ = point.scenario.target.position
    return dict.fromkeys(RESULT_COLUMNS) | {
        "index": index,
        "true_error_mm": error,
        "tip_x_mm": depth,
        "tip_y_mm": lateral + (error or 0.0),
        **predicted(point, error),
        "strain_energy_mj": 2.0 ** (point.world % 3),
        "planned_strain_energy_mj": 1.0,
        "peak_energy_uj": 3.0 ** (point.world % 3),
        "planned_peak_energy_uj": 0.5,
        "energy_scale_uj": 9.0,
        "guide_travel_mm": float(point.world),
        "flips": point.world,
        "least_stretch": 1.0 - 0.1 * (point.world % 4),
        "planned_guide_travel_mm": 2.0,
        "unconverged_periods": 0,
        "reach_mm": REACH[point.world] if bounded else None,
        "outcome": "done" if error is not None else "held",
        "reason": "" if error is not None else "held for 1.00 s",
    }


def predicted(point, error):
    """Deviations of the tip from its predictions, half as large in the middle; y alone, as in the plane."""
    if (point.controller, point.case) != (DEFAULT, "perfect"):
        return {}
    places = zip(("quarter", "half", "three_quarters"), SIGMAS.get(point.world, [None] * 3), strict=True)
    found = {"warning": "predicted miss" if point.world in WARNED else ""}
    for place, off in places:
        if off is not None:
            found |= {f"predicted_{place}_y_mm": error + 0.1 * off, f"predicted_{place}_sd_mm": 0.1}
            found |= {f"predicted_{place}_tip_y_sds": off, f"predicted_{place}_middle_y_sds": 0.75 * off}
    return found


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("worlds")
    (folder / "few.toml").write_text(STUDY)
    study = load_study(folder / "few.toml")
    bounding = _find_reach_points(study)
    rows = {k: row_of(study, k, id(study.insertion(k).point) in bounding) for k in range(len(study))}
    write_tables(folder, study, rows, StudyPlans(folder / "plans"))
    (folder / "study.json").write_text(json.dumps({"study": study.definition}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flexneedle.lab.study.report.figures.save", save_nothing)
        return write_report(folder)


def group(report, controller, case, guide):
    levels = {"controller": controller, "case": case, "guide": guide}
    (found,) = [group for group in report.findings.worlds if group.levels == levels]
    return found


def test_groups_are_controllers_cases_and_whether_there_is_a_guide(report):
    """Not the hundred values that differ between worlds, and not the plant, which follows from the case."""
    assert [list(group.levels.values()) for group in report.findings.worlds] == [
        [controller, case, guide]
        for controller in (DEFAULT, "open-loop")
        for case, guide in (
            ("perfect", "with a guide"),
            ("perfect", "no guide"),
            ("structure", "with a guide"),
        )
    ]
    assert report.findings.planned == len(report.findings.study.rows) == 22


def test_errors_shares_and_energy_are_over_finished_insertions(report):
    """Errors 0.02, 0.5 and 1.6 mm; 2, 4 and 1 times the planned energy at the end in worlds 1, 2, 3.

    At the peak 6, 18 and 2 times, and 1/3, 1 and 1/9 E₁.
    """
    guided, free = (group(report, DEFAULT, "perfect", guide) for guide in ("with a guide", "no guide"))
    errors = [0.02, 0.5, 1.6]
    assert (guided.count, guided.finished) == (4, 3)
    expected = [np.median(errors), np.mean(errors), *np.quantile(errors, (0.95, 0.99)), 1.6, 1 / 3, 2.0]
    measured = (guided.median_mm, guided.mean_mm, guided.p95_mm, guided.p99_mm, guided.max_mm, guided.above)
    assert_allclose((*measured, guided.end_energy_ratio), expected)
    assert_allclose((guided.peak_energy_ratio, guided.peak_energy_relative), (6.0, 1.0 / 3.0))
    assert np.isnan(guided.mean_energy_ratio)
    assert (guided.guide_travel_mm, guided.planned_guide_travel_mm, guided.flips) == (2.0, 2.0, 2.0)
    assert_allclose((guided.peak_energy_uj, guided.least_stretch), (3.0, 0.7))
    assert_allclose(guided.within_twice_open_loop, 2 / 3)  # 0.02 ≤ 0.1, 0.5 > 0.4, 1.6 ≤ 3.0
    assert_allclose(guided.within_open_loop, 2 / 3)  # 0.02 ≤ 0.21, 0.5 > 0.4, 1.6 ≤ 1.7
    assert_allclose(guided.within_reach, 2 / 3)  # 0.02 and 0.5 ≤ 0.5, 1.6 above
    assert free.within_twice_open_loop == free.within_open_loop == 1.0  # open loop did not finish in world 16
    assert free.within_reach == 1.0  # 4.4 ≤ 4.0 + 0.5
    assert (guided.failures, free.failures) == (1, 0)  # world 31 is 3 mm out of reach


def test_energies_of_groups_are_geometric_means(report):
    """Peaks 3, 9, 1 µJ in worlds 1, 2, 3, planned 0.5 µJ; the mean over worlds has no ratio of means."""
    wanted = {"controller": DEFAULT, "case": "perfect", "guide": "with a guide"}
    (found,) = [each.estimates for each in report.findings.groups if each.levels == wanted]
    assert_allclose((found["peak_energy_uj"].value, found["peak_energy_ratio"].value), (3.0, 6.0))
    assert "Energies are geometric means;" in Page(report.page).text
    assert report.values()["statistics"]["energies"] == "geometric means"


def test_predictions_are_reported_for_groups_that_have_any(report):
    """Only the default in the perfect case; coverage is over insertions with a prediction at that depth."""
    guided, free = report.findings.predictions
    assert guided.levels == {"controller": DEFAULT, "case": "perfect", "guide": "with a guide"}
    assert (guided.count, free.count) == (3, 1)
    assert_allclose(guided.tip_covered, (2 / 3, 1 / 3, 2 / 3))
    assert_allclose(guided.middle_covered, (2 / 3, 2 / 3, 1.0))
    assert_allclose(free.tip_covered, (np.nan, np.nan, 1.0))
    assert (guided.in_vain, guided.unwarned) == (
        0.0,
        1,
    )  # 2 ends at 0.5 mm, not below; 3 at 1.6 without warning
    assert (free.in_vain, free.unwarned) == (1.0, 0)  # 15 ends at 0.1 mm, with a warning


def test_the_worst_have_the_largest_error_beyond_reach_of_the_default_controller(report):
    rows = report.findings.study.rows
    worst = [(rows.value("controller", row), rows.value("world", row)) for row in report.findings.worst]
    assert {name for name, _ in worst} == {DEFAULT}
    assert [number for _, number in worst[:3]] == [3, 2, 16]


def test_the_page_has_the_table_and_the_figure(report):
    text = report.page.read_text(encoding="utf-8")
    assert "within reach + 0.5 mm" in text
    assert report.figures[0].name == "shares"
    assert "targeting" not in {drawn.name for drawn in report.figures}
    assert "perfect: 7 worlds; structure: 4 worlds" in report.figures[0].alt
    levels = "</th><th [^>]*>".join((DEFAULT, "perfect", "with a guide"))
    row = re.search(rf"{levels}</th>(.*?)</tr>", text, re.S)
    cells = re.findall(r"<td [^>]*>(.*?)</td>", row[1])
    assert cells[:4] == ["4", "3", "1", "0.500"]
    assert report.values()["worlds"][0]["levels"]["controller"] == DEFAULT
    tables = Page(report.page).tables
    for start in ("Errors, shares, energy", "Finished insertions. Covered"):
        (found,) = (table for caption, table in tables.items() if caption.startswith(start))
        assert len(found.labels) > 0
        assert all(labels == found.headings for labels in found.labels)


def test_worlds_in_space_are_grouped_by_their_rigs(tmp_path, monkeypatch):
    monkeypatch.setattr("flexneedle.lab.study.report.report.draw_figures", lambda *_: [])
    (tmp_path / "few.toml").write_text(
        'name = "few"\n[[axes]]\nkey = "world"\nvalues = [3, 15]\n'
        '[[axes]]\nkey = "world_rig"\nvalues = ["two-axes", "one-axis", "no-guide"]\n'
    )
    study = load_study(tmp_path / "few.toml")
    done = dict.fromkeys(RESULT_COLUMNS) | {
        "true_error_mm": 0.1,
        "reach_mm": 0.0,
        "outcome": "done",
        "reason": "",
    }
    rows = {
        k: done | {"index": k, "tip_x_mm": 30.0, "tip_y_mm": 0.0, "tip_z_mm": 1.0} for k in range(len(study))
    }
    write_tables(tmp_path, study, rows, StudyPlans(tmp_path / "plans"))
    (tmp_path / "study.json").write_text(json.dumps({"study": study.definition}))
    found = write_report(tmp_path).findings.worlds
    assert [group.levels["world_rig"] for group in found] == ["two-axes", "one-axis", "no-guide"]
