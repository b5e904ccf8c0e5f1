"""What a report makes of a study that varies the tracker's environment."""

import pytest

from flexneedle.scenario.files import load_scenario
from flexneedle.study.report.design import column_label, design_of
from flexneedle.study.report.reading import read_study
from study_rows import BASE, OURS, make_rows, write_study

TARGETS = ((25.0, 0.0),)
DISTANCE = "tracker.environment.plate.distance_mm"


def settings(name):
    """What an environment adds to the values of the scenario."""
    flat = load_scenario("phantom").with_values({"tracker.environment": name}).flat()
    return {key: value for key, value in flat.items() if key not in BASE}


def design(tmp_path, cases, axes=None):
    rows = make_rows(cases=cases, axes=axes, targets=TARGETS, repeats=2)
    return design_of(
        read_study(write_study(tmp_path / "study", [row | {"case": ""} for row in rows])).rows, [OURS]
    )


def test_environments_are_one_axis_by_their_names(tmp_path):
    """Not one more for each of their many values."""
    (axis,) = design(tmp_path, {name: settings(name) for name in ("none", "ideal", "noisy")}).axes
    assert axis.label == "environment of the tracker"
    assert axis.names == ("none", "ideal", "noisy")
    assert [axis.level(k) for k in range(3)] == ["none", "ideal", "noisy"]


@pytest.mark.parametrize("names", [("ideal", "noisy"), ("none", "noisy")])
def test_two_of_them_too(tmp_path, names):
    (axis,) = design(tmp_path, {name: settings(name) for name in names}).axes
    assert axis.names == names


def test_a_value_that_varies_within_an_environment_is_an_axis_of_its_own(tmp_path):
    (axis,) = design(tmp_path, {"": settings("noisy")}, {DISTANCE: [100.0, 80.0]}).axes
    assert axis.names == ("80", "100")
    assert axis.label == column_label(DISTANCE) == "tracker environment plate: distance (mm)"


def test_beside_the_environments_it_is_one_as_well(tmp_path):
    cases = {name: settings("noisy") | {"tracker.environment.name": name} for name in ("noisy", "mine")}
    axes = design(tmp_path, cases, {DISTANCE: [100.0, 80.0]}).axes
    assert {axis.key: axis.names for axis in axes} == {
        "tracker.environment.name": ("noisy", "mine"),
        DISTANCE: ("80", "100"),
    }
