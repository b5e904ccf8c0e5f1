"""The monitor: the order of its rules, its window, its hysteresis; its state is immutable."""

import math
from dataclasses import replace

import pytest

from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, Measurement, SensorReading, Verdict, VerdictKind

RATE = 40.0
SETTINGS = MonitorSettings()
OK = "ok"
MISSED = Verdict(VerdictKind.MISSING, "tip not measured (out of volume)")


def frame(time, indicators=(0.02, 0.02, 0.02), tip=(1.0, 2.0, 3.0)):
    """A frame with one reference sensor for each indicator; None: not measured."""
    readings = {"tip": SensorReading(tip, status=OK if tip else "out of volume")}
    for k, indicator in enumerate(indicators, 1):
        measured = indicator is not None
        position, status = ((0.0, 0.0, 0.0), OK) if measured else (None, "out of volume")
        readings[f"ref{k}"] = SensorReading(position, indicator=indicator, status=status)
    return Frame(time, round(time * RATE), readings)


def at_rest(_time):
    return 30.0, 1.0, 0.0


def driven(speed):
    """The predicted tip (mm) of a needle that is inserted at `speed` (mm/s) from time 0 on."""
    return lambda time: (30.0 + speed * time, 1.0, 0.0)


def observed(monitor, indicators, begin, count):
    """The monitor after `count` readings at rest, and its verdicts on the field as text."""
    verdicts = []
    for k in range(count):
        time = begin + k / RATE
        measurement = Measurement(time, 30.0 + 1e-6 * k, 1.0, 0.0, frame(time, indicators))
        monitor, verdict = monitor.check(measurement, at_rest, time, 0.3, 2.0)
        assert verdict.ok
        monitor, field = monitor.check_field()
        verdicts.append(str(field))
    return monitor, verdicts


def one(measurement, monitor=None, now=None):
    monitor = monitor or Monitor(SETTINGS)
    return str(monitor.check(measurement, at_rest, measurement.time if now is None else now, 0.3, 2.0)[1])


def test_a_clean_field_is_accepted_after_half_a_window():
    _, verdicts = observed(Monitor(SETTINGS), (0.02, 0.03, 0.054), 0.0, 100)
    assert verdicts[0] == "field not known: observed for 0.00 s, 0.5 s needed"
    assert verdicts[19] == "field not known: observed for 0.47 s, 0.5 s needed"
    assert set(verdicts[20:]) == {OK}


def test_a_gap_between_frames_does_not_count_as_observed_time():
    """0.35 s of frames, then 0.65 s without: each new frame replaces one that leaves the window of 1 s."""
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 15)
    _, verdicts = observed(monitor, (0.02, 0.02, 0.02), 1.0, 24)
    assert verdicts[1] == "field not known: observed for 0.35 s, 0.5 s needed"
    known = [verdict == OK for verdict in verdicts]
    assert known == [False] * 20 + [True] * 4


def test_after_a_gap_in_a_distorted_field_one_clean_frame_is_not_enough():
    monitor, verdicts = observed(Monitor(SETTINGS), (0.09, 0.02, 0.02), 0.0, 40)
    assert verdicts[-1].startswith("field distorted")
    _, verdicts = observed(monitor, (0.052, 0.02, 0.02), 2.5, 30)
    assert verdicts[-1] == "field distorted: ref1 0.0520, must fall below 0.0492 (median over 1 s)"
    _, verdicts = observed(monitor, (0.02, 0.02, 0.02), 2.5, 30)
    assert all(verdict.startswith("field not known: observed for") for verdict in verdicts[:20])
    assert verdicts[-1] == OK


def test_a_reference_in_a_quarter_of_the_frames_does_not_count():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    for k in range(40, 120):
        monitor, verdicts = observed(monitor, (0.02, 0.02 if k % 4 == 0 else None, 0.02), k / RATE, 1)
    assert verdicts[-1].startswith("field not known: 2 of 3 reference sensors measured within 1 s")


@pytest.mark.parametrize("code", [float("nan"), float("inf"), -1.0])
def test_invalid_indicators_do_not_hide_a_distortion(code):
    """ref2 has an indicator of 0.9 in every other frame, which is enough for a verdict."""
    monitor = Monitor(SETTINGS)
    for k in range(80):
        monitor, verdicts = observed(monitor, (0.02, code if k % 2 else 0.9, 0.02), k / RATE, 1)
    assert verdicts[-1].startswith("field distorted: ref2 0.9000")
    _, verdicts = observed(Monitor(SETTINGS), (code, code, code), 0.0, 40)
    assert verdicts[-1].startswith("field not known: 0 of 3")


def after_a_second(**sensors):
    """The verdict on the field after a second of frames with these sensors."""
    monitor = Monitor(SETTINGS)
    for k in range(40):
        reported = Frame(k / RATE, k, {"tip": SensorReading((1.0 + 1e-6 * k, 2.0, 3.0)), **sensors})
        measurement = Measurement(k / RATE, 30.0, 1.0, 0.0, reported)
        monitor, _ = monitor.check(measurement, at_rest, k / RATE, 0.3, 2.0)
    return str(monitor.check_field()[1])


CLEAN = SensorReading((0.0, 0.0, 0.0), indicator=0.01)


def test_references_out_of_volume_do_not_count_whatever_their_indicator():
    outside = replace(CLEAN, status="out of volume")
    assert after_a_second(ref1=outside, ref2=outside, ref3=outside) == (
        "field not known: 0 of 3 reference sensors measured within 1 s "
        "(ref1: out of volume, ref2: out of volume, ref3: out of volume)"
    )


def test_other_sensors_do_not_replace_a_reference_but_may_show_a_distortion():
    """A second coil in the needle."""
    two, lost = {"ref1": CLEAN, "ref2": CLEAN}, SensorReading(None, status="out of volume")
    assert after_a_second(**two, ref3=CLEAN, **{"tip.2": CLEAN}) == OK
    assert after_a_second(**two, ref3=lost, **{"tip.2": CLEAN}) == (
        "field not known: 2 of 3 reference sensors measured within 1 s "
        "(ref3: out of volume, not named as a reference: tip.2)"
    )
    distorted = replace(CLEAN, indicator=0.2)
    verdict = after_a_second(**two, ref3=CLEAN, **{"tip.2": distorted})
    assert verdict.startswith("field distorted: tip.2 0.2000")


def test_only_the_last_window_is_checked():
    """0.2 for 2 s, then clean: after half a second more than half of a window of 1 s is clean, but not of 2 s."""
    monitor, _ = observed(Monitor(SETTINGS), (0.2, 0.02, 0.02), 0.0, 80)
    _, verdicts = observed(monitor, (0.02, 0.02, 0.02), 2.0, 40)
    assert verdicts[18].startswith("field distorted")
    assert verdicts[20] == OK


def verdict_at(positions, step, settings=SETTINGS):
    """The verdict on the last of readings with these x (None: missing), while the predicted tip moves by `step` (mm)
    between two of them."""
    monitor = Monitor(settings)
    for k, x in enumerate(positions):
        measurement = Measurement(k / RATE, x, None if x is None else 1.0)
        monitor, verdict = monitor.check(measurement, driven(step * RATE), k / RATE, 0.3, 1e9)
    return str(verdict)


@pytest.mark.parametrize(
    ("positions", "step", "count"),
    [
        ([29.0, *[30.0] * 4], 0.1001, 4),
        ([29.0, *[30.0] * 3], 0.1001, None),
        ([30.0] * 400, 0.0, None),
        ([30.0] * 400, 0.001, 400),  # slow, and longer than the window
        ([30.0] * 3 + [math.nextafter(30.0, 31.0)], 0.2, None),  # a change in the last digit is a new reading
        ([30.0, None] * 4 + [30.0], 0.1, 5),
    ],
)
def test_identical_readings_while_the_needle_moves_are_frozen(positions, step, count):
    for settings in (SETTINGS, SETTINGS.model_copy(update={"indicator_window_s": 0.05})):
        verdict = verdict_at(positions, step, settings)
        assert verdict == OK if count is None else verdict.startswith(f"frozen: {count} identical readings")


def test_half_a_second_of_distortion_is_rejected_with_the_sensor():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    _, verdicts = observed(monitor, (0.02, 0.09, 0.02), 1.0, 40)
    first = next(k for k, verdict in enumerate(verdicts) if verdict != OK)
    assert first in (19, 20, 21)
    assert verdicts[-1] == "field distorted: ref2 0.0900, must fall below 0.0492 (median over 1 s)"
    assert set(verdicts[:first]) == {OK}


def test_single_readings_above_the_limit_are_accepted():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    for k in range(40, 240):
        monitor, verdicts = observed(monitor, (0.5 if k % 3 == 0 else 0.02, 0.02, 0.02), k / RATE, 1)
        assert verdicts == [OK]


def test_after_a_distortion_the_indicator_must_fall_below_the_lower_limit():
    monitor, verdicts = observed(Monitor(SETTINGS), (0.06, 0.02, 0.02), 0.0, 40)
    assert verdicts[-1].startswith("field distorted")
    monitor, verdicts = observed(monitor, (0.052, 0.02, 0.02), 1.0, 80)
    assert verdicts[-1] == "field distorted: ref1 0.0520, must fall below 0.0492 (median over 1 s)"
    monitor, verdicts = observed(monitor, (0.049, 0.02, 0.02), 3.0, 80)
    assert verdicts[-1] == OK
    assert observed(monitor, (0.052, 0.02, 0.02), 6.0, 80)[1][-1] == OK


def test_a_lost_reference_is_detected_after_half_a_window():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    _, verdicts = observed(monitor, (0.02, None, 0.02), 1.0, 60)
    rejected = [verdict != OK for verdict in verdicts]
    assert rejected.index(True) in (19, 20, 21)
    assert (
        verdicts[-1] == "field not known: 2 of 3 reference sensors measured within 1 s (ref2: out of volume)"
    )


def test_the_scenario_sets_the_number_of_needed_references():
    for needed, verdict in ((2, OK), (3, "field not known: 2 of 3 reference sensors measured within 1 s")):
        monitor = Monitor(SETTINGS.model_copy(update={"references": needed}))
        assert observed(monitor, (0.02, 0.02), 0.0, 40)[1][-1] == verdict


def test_a_tracker_that_reports_only_the_tip_is_accepted():
    monitor, verdict = Monitor(SETTINGS).check(Measurement(0.0, 30.0, 1.0), at_rest, 0.0, 0.3, 2.0)
    assert verdict.ok
    assert monitor.check_field()[1].ok


@pytest.mark.parametrize(
    ("measurement", "verdict"),
    [
        (Measurement(1.0, math.nan, 1.0), "not a number: x nan"),
        (Measurement(1.0, 30.0, 1.0, direction=(0.1, math.nan)), "not a number: direction nan"),
        (Measurement(1.0, None, None), "missing: tip not measured"),
        (
            Measurement(1.0, None, None, frame=frame(1.0, tip=None)),
            "missing: tip not measured (out of volume)",
        ),
        (Measurement(1.0, 30.0, 1.0, 6.0), "out of plane: 6.00 mm, limit 5 mm"),
        (Measurement(1.0, 33.0, 1.0), "innovation: 3.00 mm, limit 2 mm"),
        (Measurement(0.5, 30.0, 1.0), "stale: 0.500 s old, limit 0.3 s"),
    ],
)
def test_each_fault_of_a_reading_is_reported(measurement, verdict):
    assert one(measurement, now=1.0) == verdict


def test_a_repeated_frame_is_rejected_and_not_stored():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    again = Measurement(0.075, 30.0, 1.0, 0.0, frame(2 / RATE))
    after, verdict = monitor.check(again, at_rest, 0.075, 0.3, 2.0)
    assert str(verdict) == "stale: frame 2 after frame 2"
    assert after == replace(monitor, rejected=True)


def test_a_jump_counts_from_the_last_good_reading():
    monitor, _ = Monitor(SETTINGS).check(Measurement(1.0, 30.0, 1.0), at_rest, 1.0, 0.3, 2.0)
    far = Measurement(1.025, 31.9, 1.0)
    monitor, verdict = monitor.check(far, at_rest, 1.025, 0.3, 2.0)
    assert str(verdict) == "jump: 1.90 mm, limit 1.50 mm"
    assert monitor.good == Measurement(1.0, 30.0, 1.0)
    # Near the jump, but still too far from the last good reading.
    assert one(Measurement(1.03, 31.8, 1.0), monitor) == "jump: 1.80 mm, limit 1.50 mm"


@pytest.mark.parametrize("axis", range(3))
def test_a_lasting_jump_is_never_accepted_and_a_revoked_jump_is_forgotten(axis):
    def reading(time, off):
        return Measurement(time, *(value + off * (k == axis) for k, value in enumerate((30.0, 1.0, 0.0))))

    monitor, _ = Monitor(SETTINGS).check(reading(1.0, 0.0), at_rest, 1.0, 0.3, 9.0)
    for k in range(1, 400):
        time = 1.0 + k / RATE
        monitor, verdict = monitor.check(reading(time, 4.9), at_rest, time, 0.3, 9.0)
        assert str(verdict) == "jump: 4.90 mm, limit 1.50 mm"
    assert one(reading(11.0, 1.4), monitor) == OK
    monitor, _ = monitor.check(reading(11.0, 0.1), at_rest, 11.0, 0.3, 9.0)
    _, verdict = monitor.check(reading(11.2, 4.9), at_rest, 11.2, 0.3, 9.0)
    assert verdict.ok  # 4.8 mm in 0.2 s, within the speed limit


def test_the_travel_that_is_predicted_after_a_jump_adds_to_its_limit():
    """Readings in transit show a needle that still moved when the jump was found."""
    monitor, _ = Monitor(SETTINGS).check(Measurement(0.0, 30.0, 1.0), driven(5.0), 0.0, 0.3, 9.0)
    monitor, verdict = monitor.check(Measurement(0.1, 35.0, 1.0), driven(5.0), 0.1, 0.3, 9.0)
    assert str(verdict) == "jump: 5.00 mm, limit 3.00 mm"
    assert one_of(monitor, Measurement(0.4, 25.6, 1.0)) == OK
    assert one_of(monitor, Measurement(0.4, 25.4, 1.0)) == "jump: 4.60 mm, limit 4.50 mm"


def test_after_a_jump_a_reading_at_its_prediction_shows_that_the_one_before_was_wrong():
    """For example after a metal plate has left, which distorted the last good readings."""
    monitor, _ = Monitor(SETTINGS).check(Measurement(0.0, 30.0, 2.9), at_rest, 0.0, 0.3, 9.0)
    monitor, verdict = monitor.check(Measurement(0.025, 30.0, 5.0), at_rest, 0.025, 0.3, 9.0)
    assert str(verdict) == "jump: 2.10 mm, limit 1.50 mm"
    assert str(monitor.check(Measurement(0.4, 30.0, 1.2), at_rest, 0.4, 0.3, 9.0)[1]) == OK


def one_of(monitor, measurement):
    return str(monitor.check(measurement, driven(5.0), measurement.time, 0.3, 9.0)[1])


def test_a_frozen_sensor_is_detected_although_the_map_to_the_tip_changes():
    monitor = Monitor(SETTINGS)
    for k in range(4):
        measurement = Measurement(k / RATE, 30.0 + 0.01 * k, 1.0, 0.0, frame(k / RATE))
        monitor, verdict = monitor.check(measurement, driven(0.125 * RATE), measurement.time, 0.3, 2.0)
    assert str(verdict) == "frozen: 4 identical readings while the tip travelled 0.38 mm"


def verdict_on_repeats(estimates):
    """The verdict on the last of identical readings, one for each predicted tip (a function of time)."""
    monitor = Monitor(SETTINGS)
    for k, tip_at in enumerate(estimates):
        measurement = Measurement(k / RATE, 30.0, 1.0)
        monitor, verdict = monitor.check(measurement, tip_at, measurement.time, 0.3, 1e9)
    return str(verdict)


@pytest.mark.parametrize("shift", [1.0, -1.0])
def test_a_correction_of_the_estimate_at_rest_does_not_count_as_travel(shift):
    assert verdict_on_repeats([at_rest] * 4 + [lambda _: (30.0 + shift, 1.0, 0.0)] * 4) == OK


def test_corrections_do_not_hide_the_motion_of_a_driven_needle():
    """3.9 mm/s: 0.0975 mm between two readings, after each of which the estimate is corrected to the reading."""

    def after(k):
        return lambda time: (30.0 + 3.9 * (time - k / RATE), 1.0, 0.0)

    assert verdict_on_repeats(after(k) for k in range(4)) == OK
    assert verdict_on_repeats(after(k) for k in range(5)) == (
        "frozen: 5 identical readings while the tip travelled 0.39 mm"
    )


@pytest.mark.parametrize("time", [1e6, -50.0, float("nan")])
def test_a_reading_with_an_invalid_time_does_not_change_the_verdict_on_the_field(time):
    monitor, _ = observed(Monitor(SETTINGS), (0.2, 0.02, 0.02), 0.0, 40)
    measurement = Measurement(time, 30.0, 1.0, 0.0, replace(frame(1.0, (0.01, 0.01, 0.01)), number=1000))
    after, verdict = monitor.check(measurement, at_rest, 1.0, 0.3, 2.0)
    assert str(verdict).startswith(("stale", "not a number"))
    assert after == replace(monitor, rejected=True)
    assert str(after.check_field()[1]).startswith("field distorted")


def test_the_last_good_reading_is_returned_until_it_is_stale_and_only_with_a_frame():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    assert monitor.last_good(0.35, 0.3) == monitor.good
    assert monitor.last_good(0.36, 0.3) is None
    bare, _ = Monitor(SETTINGS).check(Measurement(0.0, 30.0, 1.0), at_rest, 0.0, 0.3, 2.0)
    assert bare.last_good(0.0, 0.3) is None


def gone(time):
    """A frame without the tip."""
    return Measurement(time, None, None, None, frame(time, tip=None))


def checked(monitor, measurement):
    return monitor.check(measurement, at_rest, measurement.time, 0.3, 2.0)


def test_a_tip_missing_in_a_few_frames_is_accepted():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    last = monitor.good

    def accepted(measurement, verdict=MISSED, by=monitor):
        return by.last_good_before_dropout(measurement, verdict)

    assert accepted(gone(last.time + 0.1)) == last
    off = replace(monitor, settings=SETTINGS.model_copy(update={"enabled": False}))
    for refused in (
        accepted(gone(last.time + 0.125)),
        accepted(gone(last.time + 0.1), by=Monitor(SETTINGS)),  # never measured
        accepted(Measurement(last.time + 0.025, None, None)),  # no frame
        accepted(last, Verdict()),  # not lost
        accepted(gone(last.time), Verdict(VerdictKind.STALE, "old")),  # no information on the tip
        accepted(gone(last.time), Verdict(VerdictKind.NOT_A_NUMBER, "nan")),
        accepted(gone(last.time + 0.025), by=off),
    ):
        assert refused is None


@pytest.mark.parametrize(
    ("seconds", "values", "number"),
    [
        (0.025, {"y": math.nan}, 3),
        (0.025, {"time": math.nan}, 3),
        (0.025, {"time": -5.0}, 3),  # stale
        (0.025, {}, 2),  # the frame before, again
        (0.025, {"y": 9.0}, 3),  # a jump
        (1.5, {"y": 9.0}, 3),  # a jump, which the window of the indicators has left
    ],
)
def test_a_tip_missing_after_any_rejected_reading_holds_the_needle(seconds, values, number):
    settings = SETTINGS.model_copy(update={"lost_after_s": 2.0})
    monitor, _ = observed(Monitor(settings), (0.02, 0.02, 0.02), 0.0, 3)
    last = monitor.good
    time = last.time + 1.0 / RATE
    bad = replace(Measurement(time, last.x, last.y, last.z, replace(frame(time), number=number)), **values)
    monitor, verdict = monitor.check(bad, at_rest, time, 0.3, 2.0)
    assert not verdict.ok
    assert verdict.kind is not VerdictKind.MISSING
    missing = gone(time + seconds)
    monitor, verdict = checked(monitor, missing)
    assert verdict.kind is VerdictKind.MISSING
    assert monitor.last_good_before_dropout(missing, verdict) is None
    later = missing.time + 0.025
    good = Measurement(later, last.x, last.y, last.z, frame(later))
    monitor, verdict = checked(monitor, good)
    assert verdict.ok
    missing = gone(later + 0.025)
    monitor, verdict = checked(monitor, missing)
    assert monitor.last_good_before_dropout(missing, verdict) == good


def test_a_disabled_monitor_still_rejects_missing_and_improbable_readings():
    off = Monitor(SETTINGS.model_copy(update={"enabled": False}))
    assert one(Measurement(1.0, 30.0, 1.0, 60.0), off) == OK
    assert one(Measurement(1.0, None, None), off).startswith("missing")
    assert one(Measurement(1.0, 33.0, 1.0), off).startswith("innovation")
    assert observed(off, (5.0, 5.0, 5.0), 0.0, 80)[1][-1] == OK


def test_the_monitor_is_immutable():
    monitor, _ = observed(Monitor(SETTINGS), (0.02, 0.02, 0.02), 0.0, 10)
    kept = replace(monitor)
    observed(monitor, (0.9, 0.9, 0.9), 0.25, 40)
    assert monitor == kept
