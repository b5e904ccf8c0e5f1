"""Factors of a study according to `study.json`, with the level of each row."""

import pytest
from numpy.testing import assert_allclose

from flexneedle.lab.study.findings.design import find_design, label_column
from flexneedle.lab.study.findings.reading import read_study_folder
from flexneedle.scenario.files import load_scenario
from study_rows import BASE, OURS, make_rows, write_study

TARGETS = ((25.0, 0.0), (40.0, 5.0))
DISTANCE = "tracker.environment.plate.distance_mm"


@pytest.fixture
def design(tmp_path):
    """Return a function from rows (dicts) and changes of study.json to the design, through its files."""

    def read(rows, **asked):
        study = read_study_folder(write_study(tmp_path / "study", rows, **asked))
        return find_design(study)

    return read


@pytest.fixture
def along(design):
    """Return a function from axes to the design of a study with them."""
    return lambda axes: design(make_rows(axes=axes, targets=TARGETS, repeats=1), axes=axes)


@pytest.fixture
def in_cases(design):
    """Return a function from cases to the design of a study with them."""
    return lambda cases: design(make_rows(cases=cases, targets=TARGETS, repeats=1), cases=cases)


def doubled(*names):
    """Return cases: the base, and each entry of [phantom] doubled."""
    cases = {f"{name} doubled": {f"phantom.{name}": 2 * BASE[f"phantom.{name}"]} for name in names}
    return {"as shipped": {}} | cases


def described(found):
    return {factor.key: factor.names for factor in found.factors}


def test_the_controllers_are_a_factor_with_the_default_first_and_draws_seeds_and_targets_are_none(design):
    """A setting that varies for another reason than an axis of study.json is none, either."""
    rows = make_rows(("ce-mpc", "open-loop", OURS), targets=TARGETS, repeats=2)
    for row in rows:
        row |= {"phantom.run_out_mm": 0.01 * row["index"], "plan_seed": row["seed"]}
    axes = {key: [0, 1] for key in ("seed", "plan_seed", "target.depth_mm")}
    assert described(design(rows, axes=axes)) == {"controller": (OURS, "ce-mpc", "open-loop")}


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        ({"a:PID": "pid", "b:PID": "flat"}, (OURS, "pid", "flat")),
        ({"a:PID": "pid", "b:PID": "pid"}, (OURS, "a:PID", "b:PID")),
        ({"a:PID": "ce-mpc", "b:PID": "pid"}, (OURS, "a:PID", "pid")),
    ],
)
def test_custom_controllers_have_their_names_unless_another_has_the_same(design, names, shown):
    rows = make_rows((OURS, *names), targets=TARGETS, repeats=1)
    assert design(rows, names=names).controller.names == shown


def test_a_number_that_varies_is_an_axis_in_ascending_order(along):
    (axis,) = along({"contact.spacing_mm": [2.0, 0.5, 1.0]}).axes
    assert (axis.key, axis.label) == ("contact.spacing_mm", "contact: spacing (mm)")
    assert axis.names == ("0.5", "1", "2")
    assert axis.titles[0] == "contact: spacing = 0.5 mm"
    assert_allclose(axis.positions, [0.5, 1.0, 2.0])
    assert axis.codes.tolist() == [2, 2, 0, 0, 1, 1]


@pytest.mark.parametrize(
    ("key", "values", "names"),
    [
        ("needle.gauge", ["25G", "18G", "21G"], ("18G", "21G", "25G")),
        ("monitor.enabled", [True, False], ("True", "False")),
        ("plant", ["model", "exact"], ("model", "exact")),
        ("phantom.bevel_factor", [[0.5, 1.5], [0.0, 2.0]], ("0.5 to 1.5", "0 to 2")),
    ],
)
def test_levels_of_other_kinds_are_names(along, key, values, names):
    """Gauges from thick to thin, all others in the order of the rows."""
    (axis,) = along({key: values, "tracker.jitter_mm": [0.1]}).axes
    assert axis.names == axis.titles == names
    assert_allclose(axis.positions, range(len(names)))


def test_cases_that_change_one_setting_each_are_cases(in_cases):
    assert described(in_cases(doubled("run_out_mm", "initial_bend_mm"))) == {
        "controller": (OURS,),
        "case": ("as shipped", "run_out_mm doubled", "initial_bend_mm doubled"),
    }


def test_the_base_case_is_the_first_without_settings(in_cases):
    cases = dict(reversed(doubled("run_out_mm", "initial_bend_mm").items()))
    assert in_cases(cases).cases.names == ("as shipped", "initial_bend_mm doubled", "run_out_mm doubled")


def test_cases_named_by_a_number_are_points_of_an_axis(in_cases):
    """As in the study `mismatch`: a case scales many values of the phantom at once."""
    cases = {
        f"s = {scale:g}": {
            "phantom.start_offset_sd_mm": 0.5 * scale,
            "phantom.start_angle_sd_mrad": 3.0 * scale,
            "phantom.bevel_factor": [1 - 0.5 * scale, 1 + 0.5 * scale],
        }
        for scale in (1.0, 0.0, 2.0, 0.5)
    }
    found = in_cases(cases)
    (axis,) = found.axes
    assert (axis.key, axis.label, axis.names) == ("case", "s", ("0", "0.5", "1", "2"))
    assert axis.titles == ("s = 0", "s = 0.5", "s = 1", "s = 2")
    assert axis.codes.tolist() == [2, 2, 0, 0, 3, 3, 1, 1]
    assert axis.covaried == tuple(cases["s = 0"])
    assert not found.cases.varies


def test_cases_named_by_a_setting_are_points_of_its_axis(in_cases):
    """As in the study `guide-distance`: the tip is moved with the guide."""
    cases = {
        f"G = {g:g} mm": {"setup.guide_to_skin_mm": g, "setup.tip_to_skin_mm": g - 12.5} for g in (41.0, 20.0)
    }
    (axis,) = in_cases(cases).axes
    assert (axis.key, axis.label) == ("setup.guide_to_skin_mm", "setup: guide to skin (mm)")
    assert (axis.names, axis.titles) == (("20", "41"), ("G = 20 mm", "G = 41 mm"))
    assert axis.covaried == ("setup.tip_to_skin_mm",)


@pytest.mark.parametrize("names", [("base", "s = 1"), ("s = 1", "t = 2"), ("1 mm", "2 mN")])
def test_names_that_differ_in_more_than_a_number_are_cases(in_cases, names):
    found = in_cases({name: {"phantom.run_out_mm": float(k)} for k, name in enumerate(names)})
    assert (found.cases.names, found.axes) == (names, ())


def test_labels_have_units():
    labels = {
        "tissue.0.shear_modulus_kpa": "tissue 0: shear modulus (kPa)",
        "phantom.friction_mn_per_mm": "phantom: friction (mN/mm)",
        "phantom.delay_periods": "phantom: delay periods",
        "needle.gauge": "needle gauge",
        "plant": "plant",
    }
    assert {key: label_column(key) for key in labels} == labels


def environment(name):
    """Values that an environment adds to the scenario."""
    flat = load_scenario("phantom").with_values({"tracker.environment": name}).flat()
    return {key: value for key, value in flat.items() if key not in BASE}


def test_environments_are_one_axis_by_their_names_and_nameless_tables_by_their_values(design):
    """Not one factor for each of their values."""
    names = ("none", "ideal", "noisy")
    rows = make_rows(cases={name: environment(name) for name in names}, targets=TARGETS, repeats=1)
    rows = [row | {"case": ""} for row in rows]
    (axis,) = design(rows, axes={"tracker.environment": list(names)}).axes
    assert (axis.label, axis.names) == ("tracker environment", names)
    plates = [{"phantom.plate.x_mm": 1.0, "phantom.plate.y_mm": y} for y in (2.0, 3.0)]
    rows = make_rows(cases=dict(zip("ab", plates, strict=True)), targets=TARGETS, repeats=1)
    (axis,) = design([row | {"case": ""} for row in rows], axes={"phantom.plate": [{}, {}]}).axes
    assert axis.names == ("1 to 2", "1 to 3")


def test_a_value_within_an_environment_is_an_axis_beside_it(design):
    axes = {DISTANCE: [100.0, 80.0]}
    cases = {name: environment("noisy") | {"tracker.environment.name": name} for name in ("noisy", "mine")}
    rows = make_rows(cases=cases, axes=axes, targets=TARGETS, repeats=1)
    rows = [row | {"case": ""} for row in rows]
    found = design(rows, axes={"tracker.environment": ["noisy", "mine"]} | axes)
    assert described(found) | {"controller": ()} == {
        "controller": (),
        "tracker.environment": ("noisy", "mine"),
        DISTANCE: ("80", "100"),
    }
    assert found.axes[1].label == "tracker environment plate: distance (mm)"
