"""Insertions with sensors along the needle: losses, faults, holds."""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import flexneedle
from flexneedle.estimation.along import Comparison
from flexneedle.estimation.faults import Fault
from flexneedle.loop.fusing import Watch, exclude_faulty, is_sensed, judge_faults
from flexneedle.loop.monitor.sensors import SensorMonitor, check_readings
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.types import OK, Reading, SensorState, Verdict, VerdictKind

FBG = {"kind": "fbg", "sites_mm": [11, 26, 70, 105]}
SLICES = [{"kind": "slice", "name": f"slice {k}", "plane_mm": x} for k, x in ((1, 12.0), (2, 25.0))]
HOMED = {"phantom.start_axial_sd_mm": 0.0, "control.start_axial_sd_mm": 0.0}


@cache
def planned():
    """Scenario in space, and its plan."""
    scenario = flexneedle.load_scenario("phantom3d")
    return scenario, flexneedle.plan(scenario, seed=0)


def inserted(*sensors, seed=3, listeners=(), **changes):
    """An insertion with sensors along the needle."""
    scenario, plan = planned()
    changes = {key.replace("__", "."): value for key, value in changes.items()}
    scenario = scenario.with_values({"sensor": [*sensors], **changes})
    return flexneedle.insert(scenario, plan, seed=seed, listeners=listeners)


def off(insertion):
    """Lateral error of the estimate at the end (mm)."""
    last = insertion.periods[-1]
    return math.dist(last.estimate.point[1:], last.true_tip.point[1:])


def excluded(insertion, name):
    """Depth (mm) at which a sensor was excluded, and the verdict; None without."""
    for period in insertion.periods:
        for one in period.sensors:
            if one.name == name and not one.verdict.ok:
                return period.true_tip.x, one.verdict
    return None


def test_a_lost_tracker_ends_an_insertion_and_with_a_fibre_it_does_not():
    lost = {"phantom__tracker_lost_mm": 18.0}
    alone = inserted(**lost)
    assert alone.outcome == "held"
    assert "not measured" in alone.reason
    sensed = inserted(FBG, **lost)
    assert sensed.outcome == "done"
    assert off(sensed) < 0.25
    assert not any(one.verdict.ok for period in sensed.periods[-3:] for one in period.readings)


def test_without_a_tracker_and_at_a_known_depth_a_fibre_leads_to_the_target():
    insertion = inserted(FBG, tracker__enabled=False, **{k.replace(".", "__"): v for k, v in HOMED.items()})
    assert insertion.outcome == "done"
    assert insertion.true_error_mm < 0.8
    assert not any(period.readings for period in insertion.periods)


def test_two_slices_find_a_constant_error_of_the_tracker():
    changes = {"phantom__tracker_bias_mm": 2.7, "tracker__bias_sd_mm": 1.5}
    insertion = inserted(*SLICES, **changes, **{k.replace(".", "__"): v for k, v in HOMED.items()})
    assert insertion.outcome == "done"
    assert off(insertion) < 0.25


@pytest.mark.parametrize(
    ("fault", "size", "kind"), [("frozen", 1.0, "frozen"), ("drift", 0.4, "contradicted")]
)
def test_a_faulty_fibre_is_excluded_and_the_needle_comes_to_its_target(fault, size, kind):
    sensor = {**FBG, "phantom": {"fault": {"kind": fault, "depth_mm": 12.0, "size": size}}}
    insertion = inserted(sensor)
    depth, verdict = excluded(insertion, "fbg")
    assert verdict.kind is VerdictKind(kind)
    assert 12.0 < depth < 24.0
    assert insertion.outcome == "done"
    assert off(insertion) < 0.1
    readings = [one for period in insertion.periods[-3:] for state in period.sensors for one in state.good]
    assert not readings


def test_an_undeclared_error_of_the_tracker_that_grows_holds_the_needle():
    insertion = inserted(FBG, phantom__tracker_drift_mm=2.7)
    assert insertion.outcome == "held"
    assert "contradict" in insertion.reason
    assert off(insertion) < 1.1


def test_in_a_distorted_field_a_fibre_leads_to_the_target():
    """The references show how large the tracker's error is; without a fibre the needle is held in air."""
    changes = {"tracker__environment": "noisy"} | {
        key.replace(".", "__"): value for key, value in HOMED.items()
    }
    insertion = inserted(FBG, **changes)
    assert insertion.outcome == "done"
    assert off(insertion) < 0.4
    assert inserted(**changes).outcome == "held"


def test_the_needle_is_held_where_no_sensor_measures_it():
    silent = {**FBG, "phantom": {"fault": {"kind": "lost", "depth_mm": 14.0}}}
    insertion = inserted(silent, phantom__tracker_lost_mm=10.0)
    assert insertion.outcome == "held"
    assert "no good reading of any sensor" in insertion.reason
    assert insertion.periods[-1].true_tip.x < 14.0 + 3.0


DEAD = {**FBG, "phantom": {"fault": {"kind": "lost", "depth_mm": -100.0}}}


@pytest.mark.parametrize("sensor", [DEAD, SLICES[0]], ids=["a dead fibre", "an image without the needle"])
def test_without_a_tracker_the_needle_moves_only_after_a_reading(sensor):
    insertion = inserted(sensor, tracker__enabled=False)
    assert insertion.outcome == "held"
    assert insertion.reason.endswith("no good reading of any sensor")
    assert all(period.applied.db_x == 0.0 for period in insertion.periods)


def test_the_needle_is_not_awaited_for_ever_in_an_image_that_it_does_not_reach():
    insertion = inserted({"kind": "slice", "plane_mm": 45.0}, phantom__tracker_lost_mm=5.0)
    assert (insertion.outcome, insertion.reason[:20]) == ("held", "not measured at rest")
    assert insertion.periods[-1].true_tip.x == pytest.approx(40.0, abs=0.1)


@pytest.mark.parametrize("depth", [100.0, 39.6], ids=["slow", "lost at the end"])
def test_no_rest_is_longer_than_the_slowest_sensor_needs(depth):
    """A reading every 0.5 s, 0.02 s late, that may be 0.3 s more late."""
    slow = {**FBG, "rate_hz": 2.0, "phantom": {"fault": {"kind": "lost", "depth_mm": depth}}}
    homed = {key.replace(".", "__"): value for key, value in HOMED.items()}
    insertion = inserted(slow, tracker__enabled=False, **homed)
    assert insertion.outcome == ("done" if depth > 40.0 else "held")
    assert np.diff([period.time for period in insertion.periods]).max() < 1.1


def test_no_rest_before_the_target_waits_for_a_reading_that_does_not_come():
    insertion = inserted({"kind": "slice", "plane_mm": 39.0}, phantom__tracker_lost_mm=5.0)
    assert insertion.outcome == "done"
    assert np.diff([period.time for period in insertion.periods]).max() < 1.1


def test_a_slow_sensor_measures_between_its_readings():
    scenario = planned()[0].with_values({"sensor": [SLICES[0] | {"rate_hz": 2.0}]})
    watch = Watch({"slice 1": SensorMonitor(heard=10.0, measured=True)})
    assert is_sensed(scenario, watch, 10.8)
    assert not is_sensed(scenario, watch, 11.0)
    excluded = SensorMonitor(heard=10.0, measured=True, excluded=Verdict(VerdictKind.FROZEN))
    assert not is_sensed(scenario, Watch({"slice 1": excluded}), 10.1)


def test_images_that_the_needle_has_not_come_to_yet_are_no_loss():
    insertion = inserted(*SLICES, phantom__tracker_lost_mm=8.0)
    assert insertion.outcome == "done"
    assert off(insertion) < 0.5


def test_all_that_freeze_at_once_are_fitted_again_without_their_last_readings():
    frozen = {"phantom": {"fault": {"kind": "frozen", "depth_mm": 15.0}}}
    planes = [{**one, **frozen, "plane_mm": 5.0 + k} for k, one in enumerate(SLICES)]
    events = []
    inserted(*planes, listeners=[events.append])
    last = [one for one in events if isinstance(one, flexneedle.Decided)][-1].estimate
    later = last.moves[int(np.searchsorted(last.tips[1:, 0], 16.0))].motion.ended
    assert [bool((one.time[one.used] > later).any()) for one in last.along] == [False, False]


def test_a_sensor_that_jumps_is_excluded():
    """Its readings are outliers at first."""
    jump = {"kind": "drift", "depth_mm": 12.0, "size": 40.0}
    insertion = inserted({**FBG, "phantom": {"fault": jump}})
    depth, _ = excluded(insertion, "fbg")
    assert 12.0 < depth < 24.0
    assert (insertion.outcome, off(insertion) < 0.1) == ("done", True)


def test_healthy_sensors_are_not_excluded():
    insertion = inserted(FBG, *SLICES)
    assert insertion.outcome == "done"
    assert (
        excluded(insertion, "fbg") is excluded(insertion, "slice 1") is excluded(insertion, "slice 2") is None
    )
    states = [one for period in insertion.periods for one in period.sensors if one.name == "fbg"]
    assert 0.1 < np.nanmedian([one.nis for one in states]) < 2.0


def test_the_needle_is_held_where_the_tip_is_not_known_well_enough():
    slow = {"kind": "slice", "plane_mm": 12.0, "noise_mm": 5.0}
    insertion = inserted(slow, phantom__tracker_lost_mm=5.0, control__tip_sd_limit_mm=0.05)
    assert insertion.outcome == "held"
    assert "tip uncertain" in insertion.reason
    assert "limit 0.05 mm" in insertion.reason


def test_the_same_seed_gives_the_same_insertion():
    one, again = inserted(FBG), inserted(FBG)
    assert [p.estimate for p in one.periods] == [p.estimate for p in again.periods]
    assert [p.sensors for p in one.periods[1:]] == [p.sensors for p in again.periods[1:]]


def test_a_rig_without_a_sensor_of_the_scenario_is_refused():
    scenario, plan = planned()
    rig = virtual_rig(scenario, plan.roll, Seeds.of(0))
    with pytest.raises(flexneedle.RigError, match="lacks fbg"):
        flexneedle.insert(scenario.with_values({"sensor": [FBG]}), plan, rig=rig)


@pytest.mark.parametrize(
    ("odds", "error", "wrong"),
    [
        ({"tracker": 0.5, "fbg": 8.0}, 1.0, ()),
        ({"tracker": 2.0, "fbg": 10.0}, 1.0, ("fbg",)),
        ({"tracker": 12.0, "fbg": 16.0}, 1.0, ("fbg",)),
        ({"tracker": 5.0, "fbg": 6.0}, 0.6, ("tracker", "fbg")),
        ({"tracker": 5.0, "fbg": 6.0}, 0.4, ()),
        ({"tracker": 1.5, "fbg": 4.9}, 0.6, ()),  # more likely the fibre
        ({"tracker": 5.0, "fbg": 0.5}, 0.6, ("tracker",)),
        ({"tracker": 14.0, "fbg": 0.5}, 0.4, ()),
        ({"tracker": 16.0, "fbg": 0.5}, 0.4, ("tracker",)),
        ({"tracker": 1.0, "a": 2.0, "b": 10.0}, 1.0, ("b",)),
        ({"tracker": 1.0, "a": 30.0, "b": 31.0}, 1.0, ("b", "a")),
        ({"fbg": 10.0}, 0.0, ("fbg",)),
        ({}, 0.0, ()),
    ],
)
def test_the_faulty_sensor_is_the_one_whose_fault_is_likeliest(odds, error, wrong):
    """A tracker that may be wrong by a quarter of the limit of 2 mm is in doubt sooner."""
    faults = {name: Fault(one, 0.0, error) for name, one in odds.items()}
    found, verdict = judge_faults(faults, 2.0)
    assert found == wrong
    assert verdict.ok == (not wrong)


def test_a_sensor_is_excluded_if_its_fault_is_still_likely_after_a_further_advance():
    """A leap of the needle resembles a fault until the fit has followed it."""
    scenario = flexneedle.load_scenario("phantom")
    step = scenario.setup.max_advance_mm

    def judged(depth, odds, watch, other=0.0):
        faults = {"tracker": Fault(0.0, 5.0), "fbg": Fault(odds, 5.0), "slice": Fault(other, 5.0)}
        motion = SimpleNamespace(begun=0.0)
        estimate = SimpleNamespace(
            tips=np.array([[0.0], [depth]]),
            moves=[SimpleNamespace(motion=motion)] * round(4.0 * depth),
            tracked=True,
            nominal=SimpleNamespace(scenario=scenario),
            faults=lambda: faults,
            without=lambda name, _since: f"without {name}",
        )
        return exclude_faulty(estimate, watch, [SensorState("fbg")], watch)

    _, leap, (state,), verdict = judged(10.0, 30.0, Watch())
    assert (verdict, state.verdict) == (OK, OK)
    assert judged(10.0 + 0.5 * step, 30.0, leap)[2][0].verdict == OK
    found, watch, (state,), verdict = judged(10.0 + step, 30.0, leap)
    assert (found, verdict, state.verdict.ok, watch.of("fbg").excluded.ok) == (
        "without fbg",
        OK,
        False,
        False,
    )
    followed = judged(10.0 + step, 1.0, leap)[1]
    assert judged(10.0 + 2.0 * step, 30.0, followed)[2][0].verdict == OK
    _, either, _, verdict = judged(10.0, 30.0, Watch(), 31.0)
    assert verdict == OK
    _, watch, _, verdict = judged(10.0 + step, 31.0, either, 30.0)
    assert (verdict.kind, watch.of("fbg").excluded) == ("contradicted", OK)


def test_a_lost_tracker_is_doubted_as_another_sensor():
    assert judge_faults({"tracker": Fault(14.0, 0.0, 1.0), "fbg": Fault(0.0, 0.0)}, None) == ((), OK)


def test_readings_are_checked_one_by_one():
    rows = ((1.0, 0.0),)
    readings = [
        Reading(1.0, rows),
        Reading(1.0, ((9.0, 0.0),)),
        Reading(1.0, (), "missing"),
        Reading(0.1, rows),
        Reading(math.nan, rows),
    ]
    values = np.array([[1.0, 0.0], [9.0, 0.0], [np.nan, np.nan], [1.0, 0.0], [1.0, 0.0]])
    compared = Comparison(values, values - [1.0, 0.0], 0.5 * np.eye(2), 0.5)
    _, checked = check_readings(SensorMonitor(), readings, compared, 1.1, 0.3)
    kinds = [one.verdict.kind.value for one in checked]
    assert kinds == ["ok", "outlier", "missing", "stale", "not a number"]
    mean = compared.nis(np.array([True, False, False, True, False]))
    assert mean == pytest.approx(0.0)


def test_outliers_one_after_another_are_no_chance():
    readings = [Reading(1.0, ((9.0,),))] * 9
    values = np.full((9, 1), 9.0)
    state, checked = check_readings(
        SensorMonitor(), readings, Comparison(values, values, np.eye(1), 0.5), 1.1, 0.3
    )
    assert [one.verdict.ok for one in checked] == [False] * 6 + [True] * 3
    state, _ = check_readings(
        state, readings[:1], Comparison(values[:1], 0.0 * values[:1], np.eye(1), 0.5), 1.1, 0.3
    )
    assert state.outliers == 0


def test_the_normalised_square_is_one_on_average():
    rng = np.random.default_rng(0)
    covariance = np.array([[0.4, 0.1], [0.1, 0.2]])
    found = []
    for _ in range(4000):
        shared = rng.multivariate_normal([0.0, 0.0], covariance)
        residual = shared + rng.normal(0.0, 0.5, (5, 2))
        found.append(Comparison(residual, residual, covariance, 0.5).nis(np.ones(5, dtype=bool)))
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)


def test_readings_that_repeat_are_frozen_once_the_tip_has_travelled():
    same = [Reading(0.1 * k, ((1.0, 2.0),)) for k in range(12)]
    state = SensorMonitor().add(same, 5.0)
    assert state.check_frozen(5.1, 0.3, 0.0).ok
    assert state.check_frozen(5.5, 0.3, 0.0).kind is VerdictKind.FROZEN
    assert state.check_frozen(5.5, 0.3, 0.1).ok  # of a sensor with steps
    assert state.add([Reading(2.0, ((1.0, 2.1),))], 5.5).check_frozen(9.0, 0.3, 0.0).ok
