"""Findings in the rows of a study: groups, paired differences, endings, the worst."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexneedle.lab.study.findings.design import find_design
from flexneedle.lab.study.findings.groups import (
    compare_cases,
    compare_controllers,
    count_endings,
    find_worst,
    group_rows,
)
from flexneedle.lab.study.findings.reading import read_study_folder
from study_rows import BASE, OURS, make_rows, unfinished, write_study

TARGETS = ((25.0, 0.0), (40.0, 5.0))


@pytest.fixture
def read(tmp_path):
    """Return a function from rows (dicts) and changes of study.json to the study record, through its files."""
    return lambda rows, **more: read_study_folder(write_study(tmp_path / "study", rows, **more))


def doubled(*names):
    """Return cases: the base, and each entry of [phantom] doubled."""
    cases = {f"{name} doubled": {f"phantom.{name}": 2 * BASE[f"phantom.{name}"]} for name in names}
    return {"as shipped": {}} | cases


def test_the_statistics_of_a_group_agree_with_hand_values(read):
    rows = make_rows(targets=TARGETS[:1], repeats=5)
    for row, error in zip(rows, (0.1, 0.2, 0.3, 0.4, 2.0), strict=True):
        row |= {"true_error_mm": error, "strain_energy_mj": 3.0, "planned_strain_energy_mj": 2.0}
        row |= {
            "peak_energy_uj": 8e3,
            "planned_peak_energy_uj": 2e3,
            "mean_energy_uj": 1e3,
            "energy_scale_uj": 5e3,
        }
        row |= {"planned_mean_energy_uj": 4e3, "guide_travel_mm": 6.0, "least_stretch": 0.7}
        row |= {
            "periods": 60,
            "planned_periods": 50,
            "flips": 2,
            "planned_flips": 1,
            "residual_mm": error + 0.1,
        }
    rows[0]["periods"], rows[1]["unconverged_periods"] = 75, 3
    found = read(rows)
    (group,) = group_rows(found.rows, find_design(found).factors)
    value = {name: estimate.value for name, estimate in group.estimates.items()}
    assert (group.name, group.count, group.finished, group.known, group.missed) == (OURS, 5, 5, 5, 1)
    assert (group.unconverged, group.largest_mm, group.largest_period_ratio) == (1, 2.0, 1.5)
    expected = {
        "mean_mm": 0.6, "sd_mm": np.std([0.1, 0.2, 0.3, 0.4, 2.0], ddof=1), "median_mm": 0.3, "p95_mm": 1.68,
        "residual_mm": 0.7, "flips": 2.0, "planned_flips": 1.0, "period_ratio": 63 / 50,
        "peak_energy_uj": 8e3, "mean_energy_uj": 1e3, "end_energy_uj": 3e3,
        "planned_peak_energy_uj": 2e3, "planned_mean_energy_uj": 4e3, "planned_end_energy_uj": 2e3,
        "peak_energy_ratio": 4.0, "mean_energy_ratio": 0.25, "end_energy_ratio": 1.5,
        "peak_energy_relative": 1.6, "mean_energy_relative": 0.2, "end_energy_relative": 0.6,
        "least_stretch": 0.7, "guide_travel_mm": 6.0, "planned_guide_travel_mm": 2.0,
    }  # fmt: skip
    assert value == pytest.approx(expected, rel=1e-12)


def test_unfinished_insertions_are_counted_and_not_averaged(read):
    rows = make_rows(targets=TARGETS[:1], repeats=4)
    for row, error in zip(rows, (0.1, 0.2, 0.3, 50.0), strict=True):
        row["true_error_mm"] = error
    rows[3] = unfinished(rows[3])
    rows.append(unfinished({**rows[0], "index": 4, "seed": 99, "repeat": 4}, "error", "ValueError: x"))
    rows[3]["unconverged_periods"] = 7
    found = read(rows)
    (group,) = group_rows(found.rows, find_design(found).factors)
    assert (group.count, group.finished, group.missed, group.unconverged) == (5, 3, 0, 1)
    assert group.estimates["mean_mm"].value == pytest.approx(0.2)
    assert group.largest_mm == 0.3
    rows[0]["true_error_mm"], rows[1]["true_error_mm"] = None, float("nan")
    (group,) = group_rows(read(rows).rows, find_design(found).factors)
    assert (group.finished, group.known) == (3, 1)


def test_margins_entered_are_counted_by_the_least_margin_of_the_zones_of_each_row(read):
    """Of 2 mm in common and 1.5 mm of one zone; the third row has a margin of 3 mm, the fifth no zone."""
    rows = make_rows(targets=TARGETS[:1], repeats=5)
    zones = {"zone.0.shape": "sphere", "zone.1.shape": "box", "zone.1.margin_mm": 1.5, "zones.margin_mm": 2.0}
    third = {"zone.0.shape": "sphere", "zones.margin_mm": 3.0}
    for row, clearance, more in zip(
        rows, (1.39, 1.41, 2.8, 0.7, None), (zones, zones, third, zones, {}), strict=True
    ):
        row |= more | {"true_clearance_mm": clearance}
    rows[3] = unfinished(rows[3])
    study = read(rows)
    (group,) = group_rows(study.rows, [find_design(study).controller])
    assert (group.least_clearance_mm, group.entered) == (0.7, 3)


def of_both(repeats, targets=TARGETS):
    """Rows of the open loop and of the default, and the latter's errors by seed."""
    rows = make_rows(("open-loop", OURS), targets=targets, repeats=repeats)
    return rows, {row["seed"]: row["true_error_mm"] for row in rows if row["controller"] == OURS}


@pytest.mark.parametrize(("more", "verdict"), [(0.05, "better"), (-0.05, "worse"), (0.0, "not separable")])
def test_controllers_are_compared_pair_by_pair(read, more, verdict):
    """The other controller is worse by the same in each pair: the differences have no spread."""
    rows, ours = of_both(5)
    for row in rows:
        if row["controller"] == "open-loop":
            row["true_error_mm"] = ours[row["seed"]] + more
    found = read(rows)
    (found,) = compare_controllers(found.rows, find_design(found))
    assert (found.name, found.against, found.pairs, found.left_out) == (OURS, "open-loop", 10, 0)
    assert_allclose([found.mean_mm.value, found.mean_mm.low, found.mean_mm.high], -more, atol=1e-12)
    assert found.verdict == verdict


def test_loads_of_controllers_are_compared_pair_by_pair(read):
    """Peaks twice and eight times as in open loop (one pair without energy): 4; 1 mm more of travel."""
    rows, _ = of_both(2)
    for row, factor in zip(rows[4:], (2.0, 8.0, 4.0, 0.0), strict=True):
        own = rows[row["index"] - 4]
        row |= {
            "peak_energy_uj": factor * own["peak_energy_uj"],
            "mean_energy_uj": 0.5 * own["mean_energy_uj"],
            "strain_energy_mj": 3.0 * own["strain_energy_mj"],
        }
        row["guide_travel_mm"] = own["guide_travel_mm"] + 1.0
    found = read(rows)
    (found,) = compare_controllers(found.rows, find_design(found))
    energies = found.peak_energy_ratio, found.mean_energy_ratio, found.end_energy_ratio
    assert_allclose([each.value for each in (*energies, found.guide_travel_mm)], (4.0, 0.5, 3.0, 1.0))


def test_a_pair_with_one_unfinished_is_left_out_and_few_pairs_have_no_verdict(read):
    rows, _ = of_both(5)
    rows[2], rows[13] = unfinished(rows[2]), unfinished(rows[13], "error", "?")
    for own, counts in ((rows, (8, 2)), (of_both(1, TARGETS[:1])[0], (1, 0))):
        found = read(own)
        (found,) = compare_controllers(found.rows, find_design(found))
        assert (found.pairs, found.left_out) == counts
        assert found.verdict is None


def test_groups_are_all_settings_and_pairs_never_cross_them(read):
    """Errors that depend on the axis alone, the same for both controllers, differ in no pair."""
    axes = {"tracker.jitter_mm": [0.01 * k for k in range(30)]}
    rows = make_rows(("open-loop", OURS), axes=axes, targets=TARGETS, repeats=5)
    shuffled = np.random.default_rng(0).permutation(len(rows)).tolist()
    for row, index in zip(rows, shuffled, strict=True):
        row |= {"true_error_mm": 0.1 + row["tracker.jitter_mm"], "index": index}
    found = read(rows, axes=axes)
    groups = group_rows(found.rows, find_design(found).factors)
    levels = [
        {"controller": name, "tracker.jitter_mm": f"{0.01 * k:.6g}"}
        for name in (OURS, "open-loop")
        for k in range(30)
    ]
    assert [group.levels for group in groups] == levels
    (found,) = compare_controllers(found.rows, find_design(found))
    assert (found.pairs, found.mean_mm.low, found.mean_mm.high) == (300, 0.0, 0.0)


def test_cases_are_compared_with_the_base_for_each_controller(read):
    rows = make_rows((OURS, "open-loop"), cases=doubled("run_out_mm", "initial_bend_mm"), repeats=2)
    for row in rows:
        more = {"as shipped": 0.0, "run_out_mm doubled": 0.02, "initial_bend_mm doubled": -0.01}[row["case"]]
        row["true_error_mm"] += more * (3 if row["controller"] == "open-loop" else 1)
    found = read(rows)
    differences = compare_cases(found.rows, find_design(found))
    assert [(d.controller, d.name, d.pairs, d.verdict) for d in differences] == [
        (controller, case, 30, verdict)
        for controller in (OURS, "open-loop")
        for case, verdict in (("run_out_mm doubled", "worse"), ("initial_bend_mm doubled", "better"))
    ]
    assert_allclose([d.mean_mm.value for d in differences], [0.02, -0.01, 0.06, -0.03], atol=1e-12)
    assert {d.against for d in differences} == {"as shipped"}


def test_endings_that_differ_only_in_numbers_are_grouped(read):
    rows = make_rows(targets=TARGETS, repeats=5)
    for k, seconds in ((1, 1.03), (4, 1.2), (7, 12.0)):
        rows[k] = unfinished(rows[k], "held", f"held for {seconds} s (limit 1.00 s)")
    rows[5] = unfinished(rows[5], "error", "ValueError: x")
    rows[8]["reason"] = "missed the target by 1.20 mm"
    found = count_endings(read(rows).rows)
    assert [(kind.outcome, kind.count, kind.first, kind.reason) for kind in found] == [
        ("held", 3, 1, "held for 1.03 s (limit 1.00 s)"),
        ("error", 1, 5, "ValueError: x"),
        ("done", 1, 8, "missed the target by 1.20 mm"),
    ]


def test_the_worst_are_the_largest_errors_finished_or_not(read):
    rows = make_rows(targets=TARGETS, repeats=3)
    for row, error in zip(rows, (0.1, 0.5, 0.3, None, 0.5, 0.2), strict=True):
        row["true_error_mm"] = error
    rows[4] = unfinished(rows[4])
    assert find_worst(read(rows).rows, 4) == [1, 4, 2, 5]


@settings(max_examples=25)
@given(st.data())
def test_no_insertion_is_dropped_for_any_outcomes(tmp_path_factory, data):
    """Every insertion is in one group, and each that did not finish is in one ending."""
    rows = make_rows((OURS, "open-loop"), targets=TARGETS, repeats=2)
    outcomes = data.draw(
        st.lists(st.sampled_from(("done", "held", "failed", "refused", "error")), min_size=8, max_size=8)
    )
    rows = [
        row if outcome == "done" else unfinished(row, outcome, "why")
        for row, outcome in zip(rows, outcomes, strict=True)
    ]
    found = read_study_folder(write_study(tmp_path_factory.mktemp("study"), rows))
    groups = group_rows(found.rows, find_design(found).factors)
    assert sum(group.count for group in groups) == 8
    assert sum(group.finished for group in groups) == outcomes.count("done")
    assert sum(kind.count for kind in count_endings(found.rows)) == 8 - outcomes.count("done")
