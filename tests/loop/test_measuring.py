"""Observations: before the needle moves, between two frames, with the tip lost, in a field in doubt."""

import math
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.loop.fusing import Watch
from flexneedle.loop.measuring import Observation, observe, observe_before_start
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.loop.monitor.sensors import SensorMonitor
from flexneedle.types import (
    VISIBLE,
    Frame,
    Measurement,
    SensorReading,
)

OK = "ok"

SCENARIO = flexneedle.load_scenario("phantom")
TIP = (30.0, 1.0, 0.0)
RATE = 40.0
STALE_AFTER = SCENARIO.control.stale_after_s


class AtRest:
    """An estimate of a tip at rest. used: readings of the last correction, None if there was none."""

    def __init__(self, used=0):
        self.used = used

    tip_sd = 0.0

    def tip_at(self, _time):
        return TIP

    def observe(self, measurements):
        return AtRest(len(measurements))

    def without_reading(self):
        return AtRest(None)


class Recorded:
    """A tracker that returns these measurements."""

    def __init__(self, *measurements, status=VISIBLE):
        self.measurements, self.status = measurements, status

    def read(self):
        return self.measurements


def measurement(time, *, measured=True, indicator=0.02):
    references = {f"ref{k}": SensorReading((0.0, 0.0, 0.0), indicator=indicator) for k in (1, 2, 3)}
    tip = SensorReading((*TIP[:2], time)) if measured else SensorReading(None, status="out of volume")
    x, y, z = TIP if measured else (None, None, None)
    return Measurement(time, x, y, z, Frame(time, round(time * RATE), {"tip": tip, **references}))


def second(end=1.0, **kind):
    """The measurements of the second before `end`."""
    return [measurement(end - k / RATE, **kind) for k in range(40, -1, -1)]


def before(now, *measurements):
    return observe_before_start(SCENARIO, AtRest(), Monitor(SCENARIO.monitor), now, Recorded(*measurements))


def during(monitor, now, *measurements, status=VISIBLE):
    return observe(SCENARIO, AtRest(), monitor, now - 0.2, now, Recorded(*measurements, status=status))


def test_before_the_start_all_readings_count_whatever_their_age():
    """Readings of a whole second: the age limit of 0.3 s applies only to the newest."""
    observation = before(1.0 + 0.9 * STALE_AFTER, *second())
    assert str(observation.verdict) == OK
    assert {str(reading.verdict) for reading in observation.readings} == {OK}


@pytest.mark.parametrize(("lost", "verdict"), [(3, OK), (6, "missing: tip not measured (out of volume)")])
def test_before_the_start_the_tip_may_be_missing_for_a_tenth_of_a_second(lost, verdict):
    """Then the last good reading is recorded."""
    measurements = second()
    good = measurements[-lost - 1]
    measurements[-lost:] = [measurement(one.time, measured=False) for one in measurements[-lost:]]
    observation = before(1.0, *measurements)
    assert str(observation.verdict) == verdict
    assert observation.measurement == (good if verdict == OK else measurements[-1])
    assert not observation.field


def test_before_the_start_a_missing_tip_does_not_hide_a_distorted_field():
    measurements = second(indicator=0.2)
    measurements[-1] = measurement(1.0, measured=False, indicator=0.2)
    observation = before(1.0, *measurements)
    assert str(observation.verdict).startswith("field distorted")
    assert observation.field


def test_before_the_start_the_newest_frame_must_not_be_stale():
    """The tracker stopped a minute ago, after good frames."""
    observation = before(61.0, *second())
    assert str(observation.verdict) == "stale: 60.000 s old, limit 0.300 s"
    blind = [*second()[:-1], measurement(1.0, measured=False)]
    assert str(before(61.0, *blind).verdict) == "stale: 60.000 s old, limit 0.300 s"
    undated = [replace(measurement(0.0), time=math.nan), *second()]
    assert str(before(61.0, *undated).verdict) == "stale: 60.000 s old, limit 0.300 s"


def test_a_repeated_frame_without_the_tip_is_no_dropout():
    monitor = before(1.0, *second()).monitor
    undated = replace(measurement(1.025, measured=False), time=math.nan)
    for again in (measurement(1.0, measured=False), undated):
        observation = during(monitor, 1.05, again)
        assert str(observation.verdict) in ("stale: frame 40 after frame 40", "not a number: time nan")
        assert observation.estimate.used is None


@pytest.mark.parametrize(
    ("indicator", "age", "verdict"),
    [
        (0.02, 0.9, OK),
        (0.2, 0.9, "field distorted"),
        (0.02, 1.1, "missing: no reading (no reply)"),
        (0.2, 1.1, "missing: no reading (no reply)"),
    ],
)
def test_between_two_frames_the_last_verdict_holds_until_it_is_stale(indicator, age, verdict):
    """The estimate is not corrected."""
    monitor = before(1.0, *second(indicator=indicator)).monitor
    observation = during(monitor, 1.0 + age * STALE_AFTER, status="no reply")
    assert str(observation.verdict).startswith(verdict)
    assert (observation.field, observation.estimate.used) == (verdict.startswith("field"), None)


def periods(monitor, *indicators):
    """Observations of control periods of 0.2 s from second 1 on, with these indicators of the references."""
    observations = []
    for k, indicator in enumerate(indicators, 1):
        now = 1.0 + 0.2 * k
        measurements = (measurement(now - n / RATE, indicator=indicator) for n in range(7, -1, -1))
        observations.append(during(observations[-1].monitor if observations else monitor, now, *measurements))
    return observations


def test_in_a_distorted_field_no_reading_corrects_the_estimate():
    """It is in doubt for half a second until the median over a second is above the limit."""
    observations = periods(before(1.0, *second()).monitor, 0.2, 0.2, 0.2, 0.2)
    kinds = [str(observation.verdict).split(":")[0] for observation in observations]
    assert kinds == [OK, OK, "field distorted", "field distorted"]
    for observation in observations:
        assert observation.estimate.used is None
        assert not observation.has_good_reading_after(0.0)
        (verdict,) = {str(reading.verdict) for reading in observation.readings}
        in_doubt = "field in doubt: ref1 0.2000, limit 0.0547 (median over 0.2 s)"
        assert verdict == (in_doubt if observation.verdict.ok else str(observation.verdict))


def test_a_field_in_doubt_for_one_period_does_not_hold_the_needle():
    observations = periods(before(1.0, *second()).monitor, 0.02, 0.2, 0.02)
    assert [str(observation.verdict) for observation in observations] == [OK] * 3
    assert [observation.estimate.used for observation in observations] == [8, None, 8]
    assert [observation.has_good_reading_after(1.0) for observation in observations] == [True, False, True]


def test_a_disabled_monitor_does_not_check_the_field():
    off = SCENARIO.with_values({"monitor.enabled": False}).monitor
    assert periods(Monitor(off), 0.2)[0].estimate.used == 8


def test_readings_in_transit_during_the_move_may_be_older_than_the_newest():
    """A move of 0.2 s: its duration is added to the age limit of all readings but the newest."""
    monitor = before(1.0, *second()).monitor
    age = STALE_AFTER + 0.1
    observation = during(monitor, 1.2 + age, measurement(1.1), measurement(1.2))
    assert [str(reading.verdict) for reading in observation.readings] == [
        OK,
        f"stale: {age:.3f} s old, limit 0.300 s",
    ]
    assert observation.estimate.used is None


def test_good_readings_of_a_period_are_used_although_the_newest_has_no_tip():
    monitor = before(1.0, *second()).monitor
    good, blind = [measurement(1.0 + k / RATE) for k in (1, 2)], measurement(1.0 + 3 / RATE, measured=False)
    observation = during(monitor, blind.time, *good, blind)
    assert (str(observation.verdict), observation.estimate.used, observation.measurement) == (OK, 2, good[-1])
    alone = during(monitor, 1.0 + 1 / RATE, measurement(1.0 + 1 / RATE, measured=False))
    assert (str(alone.verdict), alone.estimate.used, alone.measurement.time) == (OK, None, 1.0)


class Refitted(AtRest):
    """A needle at rest whose first correction shifts the tip by 1 mm."""

    tip_sd = 1.0

    def tip_at(self, _time):
        return TIP[0] + (1.0 if self.used else 0.0), *TIP[1:]

    def observe(self, measurements):
        return Refitted(self.used + len(measurements))


def test_a_correction_of_the_estimate_at_rest_does_not_make_a_noise_free_tracker_frozen():
    estimate, monitor = Refitted(), Monitor(SCENARIO.monitor)
    for k in range(8):
        observation = observe(
            SCENARIO, estimate, monitor, k / RATE - 0.2, k / RATE, Recorded(Measurement(k / RATE, *TIP[:2]))
        )
        assert str(observation.verdict) == OK
        estimate, monitor = observation.estimate, observation.monitor
    assert estimate.used == 8


def test_a_bad_last_reading_is_the_verdict_and_the_innovation_is_0():
    monitor = before(1.0, *second()).monitor
    jumped = replace(measurement(1.05), y=TIP[1] + 3.0)
    observation = during(monitor, 1.05, measurement(1.025), jumped)
    assert str(observation.verdict).startswith("innovation: 3.00 mm")
    assert observation.estimate.used is None


class Uncertain(AtRest):
    """A prediction with a standard deviation of 0.5 mm."""

    tip_sd = 0.5


def test_the_limit_of_the_innovation_grows_with_the_uncertainty_of_the_prediction():
    """By three standard deviations: the start error of a rig may exceed the limit."""
    limit = SCENARIO.control.innovation_limit_mm
    for estimate, most in ((AtRest(), limit), (Uncertain(), limit + 1.5)):
        for off, verdict in ((most - 0.01, OK), (most + 0.01, "innovation")):
            one = Measurement(1.0, TIP[0], TIP[1] + off)
            observation = observe(SCENARIO, estimate, Monitor(SCENARIO.monitor), 0.8, 1.0, Recorded(one))
            assert str(observation.readings[0].verdict).split(":")[0] == verdict


class Fusing(AtRest):
    """An estimate that sensors along the needle correct."""

    def compare(self):
        raise NotImplementedError


def test_only_a_sensor_that_corrects_the_estimate_measures_the_needle():
    scenario = SCENARIO.with_values({"sensor": [{"kind": "fbg", "sites_mm": [11.0]}]})
    watch = Watch({"fbg": SensorMonitor(heard=1.0, measured=True)})
    for estimate, sensed in ((Fusing(), True), (AtRest(), False)):
        observation = Observation(estimate, Monitor(scenario.monitor), watch=watch)
        assert observation.sensed_at(scenario, 1.1) is sensed
