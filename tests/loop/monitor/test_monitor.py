"""The monitor: the order of its rules, its window, its hysteresis; its state is immutable."""

import math
from dataclasses import replace
from itertools import repeat

import pytest

from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, Measurement, SensorReading, Verdict, VerdictKind

RATE = 40.0
SETTINGS = MonitorSettings()
OK = "ok"
CLEAN = (0.02, 0.02, 0.02)  # indicators of three references
MISSED = Verdict(VerdictKind.MISSING, "tip not measured (out of volume)")
TOO_SHORT = "field not known: observed for "


def frame(time, indicators=CLEAN, tip=(1.0, 2.0, 3.0)):
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


def observed(frames, begin=0.0, monitor=None):
    """The monitor after good readings at rest with these indicators, and its verdicts on the field as text."""
    monitor, verdicts = monitor or Monitor(SETTINGS), []
    for k, indicators in enumerate(frames):
        time = begin + k / RATE
        measurement = Measurement(time, 30.0 + 1e-6 * k, 1.0, 0.0, frame(time, indicators))
        monitor, verdict = checked(monitor, measurement)
        assert verdict.ok
        monitor, field = monitor.check_field()
        verdicts.append(str(field))
    return monitor, verdicts


def checked(monitor, measurement, tip_at=at_rest, limit=2.0, now=None):
    """The monitor after a reading, and the verdict."""
    return monitor.check(measurement, tip_at, measurement.time if now is None else now, 0.3, limit)


def verdict_of(*given, **options):
    return str(checked(*given, **options)[1])


# ---- the field


def test_a_clean_field_is_accepted_after_half_a_window():
    _, verdicts = observed([(0.02, 0.03, 0.054)] * 100)
    assert verdicts[19] == f"{TOO_SHORT}0.47 s, 0.5 s needed"
    assert all(one.startswith(TOO_SHORT) for one in verdicts[:20])
    assert set(verdicts[20:]) == {OK}


@pytest.mark.parametrize(
    ("indicators", "verdict"),
    [
        ((0.02, 0.09, 0.02), "field distorted: ref2 0.0900, must fall below 0.0492 (median over 1 s)"),
        ((0.02, None, 0.02), "field not known: 2 of 3 reference sensors measured within 1 s (ref2: out of volume)"),
    ],
)  # fmt: skip
def test_a_distortion_or_a_lost_reference_is_detected_after_half_a_window(indicators, verdict):
    _, verdicts = observed([CLEAN] * 40 + [indicators] * 60)
    assert next(k for k, one in enumerate(verdicts[40:]) if one != OK) in (19, 20, 21)
    assert verdicts[-1] == verdict


def test_a_gap_between_frames_does_not_count_as_observed_time():
    """0.35 s of frames, then 0.65 s without: each new frame replaces one that leaves the window of 1 s."""
    monitor, _ = observed([CLEAN] * 15)
    _, verdicts = observed([CLEAN] * 24, 1.0, monitor)
    assert verdicts[1] == f"{TOO_SHORT}0.35 s, 0.5 s needed"
    assert [verdict == OK for verdict in verdicts] == [False] * 20 + [True] * 4


def test_after_a_gap_in_a_distorted_field_one_clean_frame_is_not_enough():
    monitor, _ = observed([(0.09, 0.02, 0.02)] * 40)
    _, verdicts = observed([(0.052, 0.02, 0.02)] * 30, 2.5, monitor)
    assert verdicts[-1].startswith("field distorted: ref1 0.0520")
    _, verdicts = observed([CLEAN] * 30, 2.5, monitor)
    assert all(verdict.startswith(TOO_SHORT) for verdict in verdicts[:20])
    assert verdicts[-1] == OK


BAD_CODES = (math.nan, math.inf, -1.0)


@pytest.mark.parametrize(
    ("frames", "verdict"),
    [
        ([CLEAN] * 40 + [(0.02, None if k % 4 else 0.02, 0.02) for k in range(80)], "field not known: 2 of 3"),
        # An indicator that is invalid in every other frame does not hide a distortion in the others.
        *(
            ([(0.02, code if k % 2 else 0.9, 0.02) for k in range(80)], "field distorted: ref2 0.9")
            for code in BAD_CODES
        ),
        *(([(code, code, code)] * 40, "field not known: 0 of 3") for code in BAD_CODES),
    ],
)  # fmt: skip
def test_a_reference_counts_by_its_valid_indicators_in_half_of_the_frames(frames, verdict):
    assert observed(frames)[1][-1].startswith(verdict)


def test_single_readings_above_the_limit_are_accepted():
    _, verdicts = observed([CLEAN] * 40 + [(0.5 if k % 3 == 0 else 0.02, 0.02, 0.02) for k in range(200)])
    assert set(verdicts[40:]) == {OK}


def test_only_the_last_window_is_checked():
    """0.2 for 2 s, then clean: after half a second more than half of a window of 1 s is clean, but not of 2 s."""
    _, verdicts = observed([(0.2, 0.02, 0.02)] * 80 + [CLEAN] * 40)
    assert verdicts[98].startswith("field distorted")
    assert verdicts[100] == OK


def test_after_a_distortion_the_indicator_must_fall_below_the_lower_limit():
    levels = (0.06, 0.052, 0.049, 0.052)
    _, verdicts = observed([(level, 0.02, 0.02) for level in levels for _ in range(80)])
    assert [one.split(":")[0] for one in verdicts[79::80]] == ["field distorted", "field distorted", OK, OK]


def after_a_second(**sensors):
    """The verdict on the field after a second of frames with these sensors."""
    monitor = Monitor(SETTINGS)
    for k in range(40):
        tip = SensorReading(
            (1.0 + 1e-6 * k, 2.0, 3.0), indicator=0.9
        )  # an indicator of the tip does not count
        reported = Frame(k / RATE, k, {"tip": tip, **sensors})
        monitor, _ = checked(monitor, Measurement(k / RATE, 30.0, 1.0, 0.0, reported))
    return str(monitor.check_field()[1])


def test_other_sensors_do_not_replace_a_reference_but_may_show_a_distortion():
    """A second coil in the needle, and references out of volume, which never count."""
    clean = SensorReading((0.0, 0.0, 0.0), indicator=0.01)
    outside, distorted = replace(clean, status="out of volume"), replace(clean, indicator=0.2)
    two = {"ref1": clean, "ref2": clean, "tip.2": clean}
    assert after_a_second(**two, ref3=clean) == OK
    assert after_a_second(**two, ref3=outside) == (
        "field not known: 2 of 3 reference sensors measured within 1 s "
        "(ref3: out of volume, not named as a reference: tip.2)"
    )
    assert after_a_second(**two | {"tip.2": distorted}, ref3=clean).startswith("field distorted: tip.2 0.2")


def test_the_scenario_sets_the_number_of_needed_references():
    for needed, verdict in ((2, OK), (3, "field not known: 2 of 3 reference sensors measured within 1 s")):
        monitor = Monitor(SETTINGS.model_copy(update={"references": needed}))
        assert observed([(0.02, 0.02)] * 40, monitor=monitor)[1][-1] == verdict


def test_a_tracker_that_reports_only_the_tip_is_accepted():
    monitor, verdict = checked(Monitor(SETTINGS), Measurement(0.0, 30.0, 1.0))
    assert verdict.ok
    assert monitor.check_field()[1].ok


# ---- readings


@pytest.mark.parametrize(
    ("measurement", "verdict"),
    [
        (Measurement(1.0, math.nan, 1.0), "not a number: x nan"),
        (Measurement(1.0, 30.0, 1.0, direction=(0.1, math.nan)), "not a number: direction nan"),
        (Measurement(1.0, None, None, frame=frame(1.0, tip=None)), str(MISSED)),
        (Measurement(1.0, 30.0, 1.0, 6.0), "out of plane: 6.00 mm, limit 5.00 mm"),
        (Measurement(1.0, 33.0, 1.0), "innovation: 3.00 mm, limit 2.00 mm"),
        (Measurement(0.5, 30.0, 1.0), "stale: 0.500 s old, limit 0.300 s"),
    ],
)
def test_each_fault_of_a_reading_is_reported(measurement, verdict):
    assert verdict_of(Monitor(SETTINGS), measurement, now=1.0) == verdict


def test_a_repeated_frame_is_rejected_and_not_stored():
    monitor, _ = observed([CLEAN] * 3)
    after, verdict = checked(monitor, Measurement(0.075, 30.0, 1.0, 0.0, frame(2 / RATE)))
    assert verdict.kind is VerdictKind.STALE
    assert after == replace(monitor, rejected=True)


@pytest.mark.parametrize("time", [1e6, -50.0, float("nan")])
def test_a_reading_with_an_invalid_time_does_not_change_the_verdict_on_the_field(time):
    monitor, _ = observed([(0.2, 0.02, 0.02)] * 40)
    measurement = Measurement(time, 30.0, 1.0, 0.0, replace(frame(1.0, (0.01, 0.01, 0.01)), number=1000))
    after, verdict = checked(monitor, measurement, now=1.0)
    assert verdict.kind in (VerdictKind.STALE, VerdictKind.NOT_A_NUMBER)
    assert after == replace(monitor, rejected=True)
    assert str(after.check_field()[1]).startswith("field distorted")


def test_a_disabled_monitor_still_rejects_missing_and_improbable_readings():
    off = Monitor(SETTINGS.model_copy(update={"enabled": False}))
    assert verdict_of(off, Measurement(1.0, 30.0, 1.0, 60.0)) == OK
    assert verdict_of(off, Measurement(1.0, None, None)).startswith("missing")
    assert verdict_of(off, Measurement(1.0, 33.0, 1.0)).startswith("innovation")
    assert observed([(5.0, 5.0, 5.0)] * 80, monitor=off)[1][-1] == OK


def test_the_monitor_is_immutable():
    monitor, _ = observed([CLEAN] * 10)
    kept = replace(monitor)
    observed([(0.9, 0.9, 0.9)] * 40, 0.25, monitor)
    assert monitor == kept


# ---- jumps


@pytest.mark.parametrize("axis", range(3))
def test_a_jump_counts_from_the_last_good_reading_and_never_lapses(axis):
    """Nor is a reading near the jump good; a reading near the last good one is, and the jump is forgotten."""

    def reading(time, off):
        return Measurement(time, *(value + off * (k == axis) for k, value in enumerate((30.0, 1.0, 0.0))))

    monitor, _ = checked(Monitor(SETTINGS), reading(1.0, 0.0), limit=9.0)
    for k in range(1, 400):
        monitor, verdict = checked(monitor, reading(1.0 + k / RATE, 4.9 - 1e-3 * k), limit=9.0)
        assert verdict.kind is VerdictKind.JUMP
        assert str(verdict).endswith("limit 1.50 mm")
        assert monitor.good == reading(1.0, 0.0)
    assert verdict_of(monitor, reading(11.0, 1.4), limit=9.0) == OK
    monitor, _ = checked(monitor, reading(11.0, 0.1), limit=9.0)
    assert verdict_of(monitor, reading(11.2, 4.9), limit=9.0) == OK  # 4.8 mm in 0.2 s, within the speed limit


def test_the_travel_that_is_predicted_after_a_jump_adds_to_its_limit():
    """Readings in transit show a needle that still moved when the jump was found."""
    moving = {"tip_at": driven(5.0), "limit": 9.0}
    monitor, _ = checked(Monitor(SETTINGS), Measurement(0.0, 30.0, 1.0), **moving)
    monitor, verdict = checked(monitor, Measurement(0.1, 35.0, 1.0), **moving)
    assert str(verdict) == "jump: 5.00 mm, limit 3.00 mm"
    assert verdict_of(monitor, Measurement(0.4, 25.6, 1.0), **moving) == OK
    assert verdict_of(monitor, Measurement(0.4, 25.4, 1.0), **moving) == "jump: 4.60 mm, limit 4.50 mm"


def test_after_a_jump_a_reading_at_its_prediction_shows_that_the_one_before_was_wrong():
    """For example after a metal plate has left, which distorted the last good readings."""
    monitor, _ = checked(Monitor(SETTINGS), Measurement(0.0, 30.0, 2.9), limit=9.0)
    monitor, verdict = checked(monitor, Measurement(0.025, 30.0, 5.0), limit=9.0)
    assert verdict.kind is VerdictKind.JUMP
    assert verdict_of(monitor, Measurement(0.4, 30.0, 1.2), limit=9.0) == OK


# ---- frozen sensors


def verdict_on_all(positions, tip_ats, settings=SETTINGS):
    """The verdict on the last of readings with these x (None: missing) and these predictions of the tip."""
    monitor = Monitor(settings)
    for k, (x, tip_at) in enumerate(zip(positions, tip_ats, strict=False)):
        measurement = Measurement(k / RATE, x, None if x is None else 1.0)
        monitor, verdict = checked(monitor, measurement, tip_at, limit=1e9)
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
    """While the predicted tip moves by `step` (mm) between two readings."""
    for settings in (SETTINGS, SETTINGS.model_copy(update={"indicator_window_s": 0.05})):
        verdict = verdict_on_all(positions, repeat(driven(step * RATE)), settings)
        assert verdict == OK if count is None else verdict.startswith(f"frozen: {count} identical readings")


def test_a_frozen_sensor_is_detected_although_the_map_to_the_tip_changes():
    monitor = Monitor(SETTINGS)
    for k in range(4):
        measurement = Measurement(k / RATE, 30.0 + 0.01 * k, 1.0, 0.0, frame(k / RATE))
        monitor, verdict = checked(monitor, measurement, driven(0.125 * RATE))
    assert verdict.kind is VerdictKind.FROZEN


@pytest.mark.parametrize("shift", [1.0, -1.0])
def test_a_correction_of_the_estimate_at_rest_does_not_count_as_travel(shift):
    assert verdict_on_all([30.0] * 8, [at_rest] * 4 + [lambda _: (30.0 + shift, 1.0, 0.0)] * 4) == OK


def test_corrections_do_not_hide_the_motion_of_a_driven_needle():
    """3.9 mm/s: 0.0975 mm between two readings, after each of which the estimate is corrected to the reading."""

    def after(k):
        return lambda time: (30.0 + 3.9 * (time - k / RATE), 1.0, 0.0)

    assert verdict_on_all([30.0] * 4, map(after, range(4))) == OK
    assert verdict_on_all([30.0] * 5, map(after, range(5))) == (
        "frozen: 5 identical readings while the tip travelled 0.39 mm"
    )


# ---- a missing tip


def gone(time):
    """A frame without the tip."""
    return Measurement(time, None, None, None, frame(time, tip=None))


def test_the_last_good_reading_is_returned_until_it_is_stale_and_only_with_a_frame():
    monitor, _ = observed([CLEAN] * 3)
    assert monitor.last_good(0.35, 0.3) == monitor.good
    assert monitor.last_good(0.36, 0.3) is None
    bare, _ = checked(Monitor(SETTINGS), Measurement(0.0, 30.0, 1.0))
    assert bare.last_good(0.0, 0.3) is None


def test_a_tip_missing_in_a_few_frames_is_accepted():
    monitor, _ = observed([CLEAN] * 3)
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
    monitor, _ = observed([CLEAN] * 3, monitor=Monitor(settings))
    last = monitor.good
    time = last.time + 1.0 / RATE
    bad = replace(Measurement(time, last.x, last.y, last.z, replace(frame(time), number=number)), **values)
    monitor, verdict = checked(monitor, bad, now=time)
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
