"""Results of sensors along the needle: shares, innovations, exclusion."""

import math
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.record.fields import page_values
from flexneedle.record.results import RESULT_KEYS, insertion_result
from flexneedle.record.sensor_results import sensor_columns, sensor_results, sensor_row, tracker_silent_mm
from flexneedle.types import (
    OK,
    CheckedMeasurement,
    CheckedReading,
    Measurement,
    Reading,
    Verdict,
    VerdictKind,
)
from synthetic import make_insertion
from synthetic_sensors import EXCLUDED_FROM, FROZEN, with_sensors

SENSED = with_sensors()
OUTLIER = CheckedReading(Reading(0.0, ((1.0,),)), Verdict(VerdictKind.OUTLIER, "9 standard deviations"))
MISSING = CheckedReading(Reading(0.0, ()), Verdict(VerdictKind.MISSING, "no value"))
GOOD = CheckedReading(Reading(0.0, ((1.0,),)), OK)


def fibre_with(*readings, verdicts=None):
    """Return the result of the fibre with these readings in each period."""
    periods = []
    for one, verdict in zip(
        SENSED.periods, verdicts or [one.sensors[0].verdict for one in SENSED.periods], strict=False
    ):
        periods.append(replace(one, sensors=(replace(one.sensors[0], readings=readings, verdict=verdict),)))
    return sensor_results(replace(SENSED, periods=tuple(periods)))[0]


def test_readings_without_a_value_are_not_rejected():
    found = fibre_with(GOOD, GOOD, OUTLIER, MISSING)
    assert (found.readings, found.missing) == (4 * len(SENSED.periods), len(SENSED.periods))
    assert found.rejected == pytest.approx(1 / 3)
    assert fibre_with(MISSING).rejected == 0.0


def test_the_innovation_is_the_mean_while_the_sensor_is_used():
    found = sensor_results(SENSED)[0]
    assert found.mean_nis == pytest.approx(0.1 * (EXCLUDED_FROM + 1) / 6)
    assert found.excluded == FROZEN
    assert found.excluded_mm == SENSED.periods[EXCLUDED_FROM].estimate.x


def test_a_row_of_a_study_has_median_and_verdict_of_each_sensor():
    row = sensor_row(SENSED)
    assert row["sensor_fbg_nis"] == pytest.approx(
        0.1 * (EXCLUDED_FROM + 1) / 6
    )  # innovations that grow evenly
    assert (row["sensor_fbg_excluded"], row["sensor_slice_excluded"]) == ("frozen", "")
    assert row["sensor_fbg_excluded_mm"] == SENSED.periods[EXCLUDED_FROM].estimate.x
    assert row["sensor_slice_nis"] == 0.8
    assert row.keys() == sensor_columns(["fbg", "slice"]).keys()
    assert sensor_row(make_insertion()) == {}


def test_a_sensor_that_is_used_again_is_not_excluded():
    bad = Verdict(VerdictKind.FROZEN, "the same")
    again = fibre_with(GOOD, verdicts=[OK, bad, OK])
    assert (again.excluded, math.isnan(again.excluded_mm)) == ("", True)
    twice = fibre_with(GOOD, verdicts=[OK, bad, OK, bad, bad])
    assert twice.excluded_mm == SENSED.periods[3].estimate.x


@pytest.mark.parametrize("last", [2, None], ids=["lost", "used"])
def test_a_sensor_is_silent_from_its_last_good_reading_on(last):
    """A fibre of 100 Hz: readings a period old are stale with `control.stale_after_s` = 0.1."""
    scenario = flexneedle.load_scenario("phantom").with_values(
        {"sensor": [{"kind": "fbg", "sites_mm": [11]}], "control.stale_after_s": 0.1}
    )
    periods = []
    for k, one in enumerate(SENSED.periods):
        good = () if last is not None and k > last else (replace(GOOD, reading=Reading(one.time, ((1.0,),))),)
        tips = tuple(CheckedMeasurement(Measurement(each.reading.time, 1.0, 0.0), OK) for each in good)
        sensors = (replace(one.sensors[0], readings=(*good, MISSING)),)
        periods.append(replace(one, sensors=sensors, readings=tips))
    insertion = replace(SENSED, scenario=scenario, periods=tuple(periods))
    depth = math.nan if last is None else SENSED.periods[last].estimate.x
    (found,) = sensor_results(insertion)
    assert found.silent_mm == pytest.approx(depth, nan_ok=True)
    assert tracker_silent_mm(insertion) == pytest.approx(depth, nan_ok=True)


def test_an_image_in_which_the_needle_never_was_is_not_silent():
    scenario = flexneedle.load_scenario("phantom").with_values(
        {"sensor": [{"kind": "slice", "name": "fbg", "plane_mm": 39.0}]}
    )
    periods = [
        replace(one, sensors=(replace(one.sensors[0], readings=(MISSING,)),)) for one in SENSED.periods
    ]
    (found,) = sensor_results(replace(SENSED, scenario=scenario, periods=tuple(periods)))
    assert math.isnan(found.silent_mm)


def test_a_result_has_sensors_only_with_sensors():
    assert set(insertion_result(make_insertion())) == set(RESULT_KEYS)
    found = insertion_result(SENSED)
    assert found["tip_sd_mm"] == pytest.approx([0.01, 0.02, 0.03])
    assert [one["name"] for one in found["sensors"]] == ["fbg", "slice"]
    assert found["sensors"][1]["excluded_mm"] is None


def test_a_row_of_the_page_has_points_of_sensors_that_measure_positions():
    scenario = flexneedle.load_scenario("phantom").with_values(
        {"sensor": [{"kind": "fbg", "sites_mm": [11, 26]}, {"kind": "slice", "plane_mm": 20.0}]}
    )
    plan, last = replace(SENSED.plan, scenario=scenario), SENSED.periods[-1]
    found = page_values(last, plan)
    assert [one["points"] for one in found["sensors"]] == [[], [(20.0, last.true_tip.y + 0.1, 0.0)]]
    assert [one["verdict"] for one in found["sensors"]] == [FROZEN, "ok"]
    assert found["tip_covariance"] == last.tip_covariance
    lost = CheckedReading(Reading(0.0, ((20.0, math.nan, 0.0), (20.0, 1.0, math.nan))), OK)
    partly = replace(last, sensors=(replace(last.sensors[1], readings=(lost,)),))
    assert page_values(partly, plan)["sensors"][0]["points"] == [
        (20.0, 1.0, 0.0)
    ]  # z of a needle in the plane
    assert page_values(make_insertion().periods[0], plan)["sensors"] == []
