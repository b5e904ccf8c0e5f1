"""Keys that give the same quantity: a change of one replaces the others, in a scenario and in a study."""

import pyarrow.parquet as pq
import pytest

from flexneedle.errors import ScenarioError
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.plans import StudyPlans
from flexneedle.lab.study.tables import write_tables
from flexneedle.record.results import RESULT_COLUMNS
from flexneedle.scenario.alternatives import override
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.plausible import find_doubts

PHANTOM = load_scenario("phantom")
TUBE = {"needle.outer_diameter_mm": 0.8, "needle.inner_diameter_mm": 0.5}
GAUGED = PHANTOM.with_values({"needle.gauge": "21G"})
MEASURED = GAUGED.with_values(TUBE)
MU, E = "tissue.1.shear_modulus_kpa", "tissue.1.youngs_modulus_kpa"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [({E: 12.0}, 4.0), ({MU: 5}, 5.0), ({"tissue[1].youngs_modulus_kpa": 6}, 2.0), ({E: None, MU: 5.0}, 5.0)],
)
def test_a_modulus_replaces_the_other(changes, expected):
    assert PHANTOM.with_values(changes).tissue[1].shear_modulus_kpa == pytest.approx(expected)


def test_a_gauge_and_both_diameters_replace_each_other():
    assert (MEASURED.needle.gauge, MEASURED.needle.outer_diameter, MEASURED.needle.inner_diameter) == (
        None, 0.8, 0.5,
    )  # fmt: skip
    again = MEASURED.with_values({"needle.gauge": "25G"}).needle
    assert (again.gauge, again.outer_diameter_mm, again.inner_diameter_mm) == ("25G", None, None)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"needle.outer_diameter_mm": 0.8}, "both diameters replace the gauge"),  # not a solid needle
        (TUBE | {"needle.gauge": "21G"}, "leave it out: gauge 21G gives it"),
        ({MU: 4.0, E: 12.0}, "leave it out: shear_modulus_kpa gives it"),
        ({MU: 4.0, "tissue[1].youngs_modulus_kpa": 12.0}, "leave it out: shear_modulus_kpa gives it"),
        ({E: None}, "tissue[1].shear_modulus_kpa: missing"),
    ],
)
def test_what_would_be_a_guess_is_refused(changes, line):
    with pytest.raises(ScenarioError) as caught:
        GAUGED.with_values(changes)
    assert line in str(caught.value)


def test_later_settings_replace_earlier_ones():
    assert override({MU: 1.0, "needle.gauge": "21G"}, {E: 9.0} | TUBE) == {E: 9.0} | TUBE
    assert override(TUBE, {"needle.gauge": "21G"}) == {"needle.gauge": "21G"}


@pytest.mark.parametrize("key", [E, "tissue[1].youngs_modulus_kpa"])
def test_a_study_varies_youngs_modulus_over_a_fixed_shear_modulus(tmp_path, key):
    path = tmp_path / "study.toml"
    path.write_text(f"name = 's'\n[values]\n{MU} = 9\n[[axes]]\nkey = '{key}'\nvalues = [6, 12]\n")
    study = load_study(path)
    points = study.points
    assert [point.scenario.tissue[1].shear_modulus_kpa for point in points] == pytest.approx([2.0, 4.0])
    assert [dict(point.varied) for point in points] == [{E: 6}, {E: 12}]
    empty = {**dict.fromkeys(RESULT_COLUMNS), "outcome": "done", "reason": ""}
    times = {"control_s": 0.1, "plant_s": 0.1, "total_s": 0.3}
    write_tables(tmp_path, study, dict.fromkeys(range(2), empty | times), StudyPlans(tmp_path / "plans"))
    assert pq.read_table(tmp_path / "runs.parquet").column(E).to_pylist() == [6.0, 12.0]


def test_a_doubt_about_a_modulus_names_both_keys():
    (line,) = find_doubts(PHANTOM.with_values({E: 12_000}))
    assert line.startswith("tissue[1].shear_modulus_kpa = 4000 (youngs_modulus_kpa = 12000, E = 3μ): ")


@pytest.mark.parametrize(
    ("right", "wrong"),
    [("tissue.1.shear_modulus_kpa", "young_modulus_kpa"),
     ("tissue.1.shear_modulus_kpa", "youngs_kpa"), ("tissue.1.engaged_width_mm", "engaged_with_mm"),
     ("setup.stroke_mm", "strok_mm"), ("tissue", "tisue"), ("needle", "needel")],
)  # fmt: skip
def test_a_misspelt_key_is_one_line_that_does_not_call_it_missing(right, wrong):
    values = PHANTOM.values()
    *parents, last = right.split(".")
    table = values
    for part in parents:
        table = table[int(part) if part.isdigit() else part]
    table[wrong] = table.pop(last)
    with pytest.raises(ScenarioError) as caught:
        type(PHANTOM).from_values(values)
    (line,) = caught.value.problems
    assert f"{wrong} = " in line
    assert f"unknown key; did you mean {last}" in line
