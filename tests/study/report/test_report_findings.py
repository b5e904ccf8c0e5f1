"""What a report finds in rows: what varies, groups, paired differences, endings, the worst."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexneedle.study.report.design import column_label, design_of
from flexneedle.study.report.reading import read_study
from flexneedle.study.report.summary import (
    case_differences,
    controller_differences,
    endings,
    groups_of,
    worst,
)
from study_rows import BASE, OURS, make_rows, unfinished, write_study

FIRST = [OURS]
TARGETS = ((25.0, 0.0), (40.0, 5.0))


@pytest.fixture
def read(tmp_path):
    """Return a function from rows (dicts) to the rows of a report, through the files of a study."""
    return lambda rows: read_study(write_study(tmp_path / "study", rows)).rows


def doubled(*names):
    """Return cases: the base, and each entry of [phantom] doubled."""
    cases = {f"{name} doubled": {f"phantom.{name}": 2 * BASE[f"phantom.{name}"]} for name in names}
    return {"as shipped": {}} | cases


def described(design):
    return {factor.key: factor.names for factor in design.factors}


def test_a_study_of_one_setting_varies_nothing(read):
    design = design_of(read(make_rows(targets=TARGETS, repeats=2)), FIRST)
    assert described(design) == {"controller": (OURS,)}


def test_the_default_controller_comes_first(read):
    rows = make_rows(("ce-mpc", "open-loop", OURS), targets=TARGETS, repeats=2)
    assert design_of(read(rows), FIRST).controller.names == (OURS, "ce-mpc", "open-loop")


def test_a_number_that_varies_is_an_axis_in_ascending_order(read):
    rows = make_rows(axes={"contact.spacing_mm": [2.0, 0.5, 1.0]}, targets=TARGETS, repeats=1)
    (axis,) = design_of(read(rows), FIRST).axes
    assert (axis.key, axis.label, axis.names) == (
        "contact.spacing_mm",
        "contact: spacing (mm)",
        ("0.5", "1", "2"),
    )
    assert_allclose(axis.places, [0.5, 1.0, 2.0])
    assert axis.codes.tolist() == [2, 2, 0, 0, 1, 1]


def test_settings_that_change_together_are_one_axis(read):
    pairs = [(g, g - 12.5) for g in (20.0, 41.0, 80.0)]
    rows = make_rows(axes={"setup.guide_to_skin_mm+setup.tip_to_skin_mm": pairs}, targets=TARGETS, repeats=1)
    (axis,) = design_of(read(rows), FIRST).axes
    assert (axis.key, axis.names, axis.along) == (
        "setup.guide_to_skin_mm", ("20", "41", "80"), ("setup.tip_to_skin_mm",),
    )  # fmt: skip
    assert axis.level(0) == "G = 20 mm"


def test_the_study_says_which_of_them_it_meant(read):
    pairs = [(g, g - 12.5) for g in (20.0, 41.0)]
    rows = make_rows(axes={"setup.guide_to_skin_mm+setup.tip_to_skin_mm": pairs}, targets=TARGETS, repeats=1)
    (axis,) = design_of(read(rows), FIRST, ["setup.tip_to_skin_mm"]).axes
    assert axis.key == "setup.tip_to_skin_mm"


def test_gauges_are_ordered_from_thick_to_thin(read):
    rows = make_rows(axes={"needle.gauge": ["25G", "18G", "21G"]}, targets=TARGETS, repeats=1)
    (axis,) = design_of(read(rows), FIRST).axes
    assert axis.names == ("18G", "21G", "25G")
    assert not axis.numeric


def test_a_gauge_says_more_than_what_changes_with_it(read):
    pairs = [(140.0, "18G"), (150.0, "21G")]
    rows = make_rows(axes={"needle.length_mm+needle.gauge": pairs}, targets=TARGETS, repeats=1)
    (axis,) = design_of(read(rows), FIRST).axes
    assert (axis.key, axis.along) == ("needle.gauge", ("needle.length_mm",))


def test_two_axes_stay_two(read):
    rows = make_rows(
        axes={"contact.spacing_mm": [0.5, 1.0], "tracker.jitter_mm": [0.0, 0.07, 0.14]},
        targets=TARGETS,
        repeats=1,
    )
    assert [axis.key for axis in design_of(read(rows), FIRST).axes] == [
        "contact.spacing_mm",
        "tracker.jitter_mm",
    ]


def test_cases_that_change_one_thing_each_are_cases(read):
    rows = make_rows(cases=doubled("run_out_mm", "initial_bend_mm"), targets=TARGETS, repeats=1)
    design = design_of(read(rows), FIRST)
    assert described(design) == {
        "controller": (OURS,),
        "case": ("as shipped", "run_out_mm doubled", "initial_bend_mm doubled"),
    }


def test_the_base_case_is_first_wherever_it_stands(read):
    rows = make_rows(cases=doubled("run_out_mm", "initial_bend_mm"), targets=TARGETS, repeats=1)
    design = design_of(read(rows), FIRST, base="initial_bend_mm doubled")
    assert design.cases.names[0] == "initial_bend_mm doubled"


def test_cases_named_by_a_number_are_points_of_an_axis(read):
    """As in the study `mismatch`: a case scales many values of the phantom at once."""
    cases = {
        f"s = {scale:g}": {
            "phantom.start_offset_sd_mm": 0.5 * scale,
            "phantom.start_angle_sd_mrad": 3.0 * scale,
            "phantom.bevel_factor": [1 - 0.5 * scale, 1 + 0.5 * scale],
        }
        for scale in (1.0, 0.0, 2.0, 0.5)
    }
    design = design_of(read(make_rows(cases=cases, targets=TARGETS, repeats=1)), FIRST)
    (axis,) = design.axes
    assert (axis.label, axis.names) == ("s, scale of the phantom's mismatch", ("0", "0.5", "1", "2"))
    assert axis.level(1) == "s = 0.5"
    assert len(axis.along) == 3
    assert not design.cases.varies


def test_cases_that_set_one_number_are_points_of_its_axis(read):
    cases = {name: {"setup.guide_to_skin_mm": g} for name, g in (("near", 20.0), ("far", 80.0))}
    (axis,) = design_of(read(make_rows(cases=cases, targets=TARGETS, repeats=1)), FIRST).axes
    assert (axis.key, axis.names) == ("setup.guide_to_skin_mm", ("20", "80"))


def test_many_values_are_put_into_bins_of_equal_count(read):
    values = [0.01 * k for k in range(100)]
    rows = make_rows(axes={"tracker.jitter_mm": values}, targets=TARGETS[:1], repeats=1)
    (axis,) = design_of(read(rows), FIRST).axes
    assert np.bincount(axis.codes).tolist() == [10] * 10
    assert_allclose(axis.places, 0.045 + 0.1 * np.arange(10))
    assert len(np.unique(axis.exact)) == 100


def test_lists_and_missing_values_are_levels_too(read):
    rows = make_rows(axes={"phantom.bevel_factor": [[0.5, 1.5], [0.0, 2.0]]}, targets=TARGETS, repeats=1)
    for row in rows[:2]:
        row["tissue.2.alpha"] = 8.0
    axes = design_of(read(rows), FIRST).axes
    assert axes[0].names == ("0.5 to 1.5", "0 to 2")


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("tissue.0.shear_modulus_kpa", "tissue 0: shear modulus (kPa)"),
        ("phantom.friction_mn_per_mm", "phantom: friction (mN/mm)"),
        ("setup.insertion_speed_mm_s", "setup: insertion speed (mm/s)"),
        ("phantom.delay_periods", "phantom: delay periods"),
        ("needle.gauge", "needle gauge"),
    ],
)
def test_labels_have_units(key, label):
    assert column_label(key) == label


def test_a_group_holds_what_a_hand_would_compute(read):
    rows = make_rows(targets=TARGETS[:1], repeats=5)
    for row, error in zip(rows, (0.1, 0.2, 0.3, 0.4, 2.0), strict=True):
        row |= {"true_error_mm": error, "strain_energy_mj": 3.0, "planned_strain_energy_mj": 2.0}
        row |= {
            "periods": 60,
            "planned_periods": 50,
            "flips": 2,
            "planned_flips": 1,
            "residual_mm": error + 0.1,
        }
    rows[0]["periods"], rows[1]["unconverged_periods"] = 75, 3
    found = read(rows)
    (group,) = groups_of(found, design_of(found, FIRST))
    value = {name: estimate.value for name, estimate in group.estimates.items()}
    assert (group.name, group.count, group.finished, group.known, group.missed) == (OURS, 5, 5, 5, 1)
    assert (group.unconverged, group.largest_mm, group.largest_period_ratio) == (1, 2.0, 1.5)
    expected = {
        "mean_mm": 0.6, "sd_mm": np.std([0.1, 0.2, 0.3, 0.4, 2.0], ddof=1), "median_mm": 0.3, "p95_mm": 1.68,
        "residual_mm": 0.7, "flips": 2.0, "planned_flips": 1.0, "energy_mj": 3.0, "planned_energy_mj": 2.0,
        "energy_ratio": 1.5, "period_ratio": 63 / 50,
    }  # fmt: skip
    assert value == pytest.approx(expected, rel=1e-12)


def test_unfinished_insertions_count_but_enter_no_mean(read):
    rows = make_rows(targets=TARGETS[:1], repeats=4)
    for row, error in zip(rows, (0.1, 0.2, 0.3, 50.0), strict=True):
        row["true_error_mm"] = error
    rows[3] = unfinished(rows[3])
    rows.append(unfinished({**rows[0], "index": 4, "seed": 99, "repeat": 4}, "error", "ValueError: x"))
    rows[3]["unconverged_periods"] = 7
    found = read(rows)
    (group,) = groups_of(found, design_of(found, FIRST))
    assert (group.count, group.finished, group.missed, group.unconverged) == (5, 3, 0, 1)
    assert group.estimates["mean_mm"].value == pytest.approx(0.2)
    assert group.largest_mm == 0.3


def test_a_finished_insertion_of_unknown_error_is_counted_as_such(read):
    rows = make_rows(targets=TARGETS[:1], repeats=3)
    rows[0]["true_error_mm"] = None
    rows[1]["true_error_mm"] = float("nan")
    found = read(rows)
    (group,) = groups_of(found, design_of(found, FIRST))
    assert (group.finished, group.known) == (3, 1)


def test_groups_are_every_level_of_every_factor(read):
    rows = make_rows((OURS, "open-loop"), axes={"contact.spacing_mm": [1.0, 0.5]}, targets=TARGETS, repeats=2)
    found = read(rows)
    groups = groups_of(found, design_of(found, FIRST))
    assert [group.levels for group in groups] == [
        {"controller": name, "contact.spacing_mm": spacing}
        for name in (OURS, "open-loop")
        for spacing in ("0.5", "1")
    ]
    assert sum(group.count for group in groups) == len(rows)


def compared(rows, read):
    found = read(rows)
    return controller_differences(found, design_of(found, FIRST))


def test_controllers_are_compared_pair_by_pair(read):
    """The other is 0.05 mm worse in each pair: the difference has no spread, whatever the pairs have."""
    rows = make_rows(("open-loop", OURS), targets=TARGETS, repeats=5)
    own = {(row["seed"], row["repeat"]): row["true_error_mm"] for row in rows if row["controller"] == OURS}
    for row in rows:
        if row["controller"] == "open-loop":
            row["true_error_mm"] = own[row["seed"], row["repeat"]] + 0.05
    (found,) = compared(rows, read)
    assert (found.name, found.against, found.pairs, found.left_out) == (OURS, "open-loop", 10, 0)
    assert_allclose([found.mean_mm.value, found.mean_mm.low, found.mean_mm.high], -0.05, atol=1e-12)
    assert found.verdict == "better"


def test_a_worse_default_is_called_worse(read):
    rows = make_rows(("open-loop", OURS), targets=TARGETS, repeats=20)
    for row in rows:
        row["true_error_mm"] *= 100.0 if row["controller"] == OURS else 1.0
    assert compared(rows, read)[0].verdict == "worse"


def test_controllers_alike_are_not_separable(read):
    rows = make_rows(("ce-mpc", OURS), targets=TARGETS, repeats=10)
    rng = np.random.default_rng(3)
    for row in rows:
        row["true_error_mm"] = float(rng.lognormal(-2.0, 0.5))
    assert compared(rows, read)[0].verdict == "not separable"


def test_a_pair_with_one_unfinished_is_left_out_and_counted(read):
    rows = make_rows(("open-loop", OURS), targets=TARGETS, repeats=5)
    rows[2], rows[13] = unfinished(rows[2]), unfinished(rows[13], "error", "?")
    (found,) = compared(rows, read)
    assert (found.pairs, found.left_out) == (8, 2)


def test_too_few_pairs_give_no_verdict(read):
    rows = make_rows(("open-loop", OURS), targets=TARGETS[:1], repeats=1)
    (found,) = compared(rows, read)
    assert (found.pairs, found.verdict) == (1, None)


def test_pairs_never_cross_settings(read):
    """Errors that depend on the axis alone, the same for both controllers, differ in no pair."""
    values = [0.01 * k for k in range(30)]  # so many that they are put into bins
    rows = make_rows(("open-loop", OURS), axes={"tracker.jitter_mm": values}, targets=TARGETS, repeats=5)
    shuffled = np.random.default_rng(0).permutation(len(rows)).tolist()
    for row, index in zip(rows, shuffled, strict=True):
        row |= {"true_error_mm": 0.1 + row["tracker.jitter_mm"], "index": index}
    (found,) = compared(rows, read)
    assert (found.pairs, found.mean_mm.low, found.mean_mm.high) == (300, 0.0, 0.0)


def test_cases_are_compared_with_the_base_for_each_controller(read):
    rows = make_rows((OURS, "open-loop"), cases=doubled("run_out_mm", "initial_bend_mm"), repeats=2)
    for row in rows:
        more = {"as shipped": 0.0, "run_out_mm doubled": 0.02, "initial_bend_mm doubled": -0.01}[row["case"]]
        row["true_error_mm"] += more * (3 if row["controller"] == "open-loop" else 1)
    found = read(rows)
    differences = case_differences(found, design_of(found, FIRST))
    assert [(d.controller, d.name, d.pairs, d.verdict) for d in differences] == [
        (controller, case, 30, verdict)
        for controller in (OURS, "open-loop")
        for case, verdict in (("run_out_mm doubled", "worse"), ("initial_bend_mm doubled", "better"))
    ]
    assert_allclose([d.mean_mm.value for d in differences], [0.02, -0.01, 0.06, -0.03], atol=1e-12)
    assert {d.against for d in differences} == {"as shipped"}


def test_endings_differ_in_more_than_numbers(read):
    rows = make_rows(targets=TARGETS, repeats=5)
    for k, seconds in ((1, 1.03), (4, 1.2), (7, 12.0)):
        rows[k] = unfinished(rows[k], "held", f"held for {seconds} s (limit 1 s)")
    rows[5] = unfinished(rows[5], "error", "ValueError: x")
    rows[8]["reason"] = "missed the target by 1.20 mm"
    found = endings(read(rows))
    assert [(kind.outcome, kind.count, kind.first, kind.reason) for kind in found] == [
        ("held", 3, 1, "held for 1.03 s (limit 1 s)"),
        ("error", 1, 5, "ValueError: x"),
        ("done", 1, 8, "missed the target by 1.20 mm"),
    ]


def test_the_worst_are_the_largest_errors_finished_or_not(read):
    rows = make_rows(targets=TARGETS, repeats=3)
    for row, error in zip(rows, (0.1, 0.5, 0.3, None, 0.5, 0.2), strict=True):
        row["true_error_mm"] = error
    rows[4] = unfinished(rows[4])
    assert worst(read(rows), 4) == [1, 4, 2, 5]


@settings(deadline=None, max_examples=25)
@given(st.data())
def test_nothing_is_dropped_whatever_the_outcomes(tmp_path_factory, data):
    """Every insertion is in one group, and each that did not finish is in one ending."""
    rows = make_rows((OURS, "open-loop"), targets=TARGETS, repeats=2)
    outcomes = data.draw(
        st.lists(st.sampled_from(("done", "held", "failed", "refused", "error")), min_size=8, max_size=8)
    )
    rows = [
        row if outcome == "done" else unfinished(row, outcome, "why")
        for row, outcome in zip(rows, outcomes, strict=True)
    ]
    found = read_study(write_study(tmp_path_factory.mktemp("study"), rows)).rows
    groups = groups_of(found, design_of(found, FIRST))
    assert sum(group.count for group in groups) == 8
    assert sum(group.finished for group in groups) == outcomes.count("done")
    assert sum(kind.count for kind in endings(found)) == 8 - outcomes.count("done")
