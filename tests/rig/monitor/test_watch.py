"""The watch: the order of its rules, its window, its hysteresis, and that it never changes itself."""

import math
from dataclasses import replace

import pytest

from flexneedle.rig.monitor.watch import Watch
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, Measurement, SensorReading, Verdict, VerdictKind

RATE = 40.0
SETTINGS = MonitorSettings()
OK = "ok"
MISSED = Verdict(VerdictKind.MISSING, "tracker sees no tip (out of volume)")


def frame(time, indicators=(0.02, 0.02, 0.02), tip=(1.0, 2.0, 3.0)):
    """A frame with one reference sensor for each indicator; None is one that the tracker does not see."""
    readings = {"tip": SensorReading(tip, status=OK if tip else "out of volume")}
    for k, indicator in enumerate(indicators, 1):
        seen = indicator is not None
        place, status = ((0.0, 0.0, 0.0), OK) if seen else (None, "out of volume")
        readings[f"ref{k}"] = SensorReading(place, indicator=indicator, status=status)
    return Frame(time, round(time * RATE), readings)


def at_rest(_time):
    return 30.0, 1.0


def driven(speed):
    """The predicted tip (mm) of a needle that is inserted at `speed` (mm/s) from time 0 on."""
    return lambda time: (30.0 + speed * time, 1.0)


def told(watch, indicators, begin, count):
    """The watch after `count` readings at rest, and its verdict on the field after each, as text."""
    verdicts = []
    for k in range(count):
        time = begin + k / RATE
        sample = Measurement(time, 30.0 + 1e-6 * k, 1.0, 0.0, frame(time, indicators))
        watch, verdict = watch.take(sample, at_rest, time, 0.3, 2.0)
        assert verdict.ok
        watch, field = watch.look()
        verdicts.append(str(field))
    return watch, verdicts


def one(sample, watch=None, now=None):
    watch = watch or Watch(SETTINGS)
    return str(watch.take(sample, at_rest, sample.time if now is None else now, 0.3, 2.0)[1])


def test_a_clean_field_lets_the_needle_move_once_half_a_window_of_it_was_seen():
    _, verdicts = told(Watch(SETTINGS), (0.02, 0.03, 0.054), 0.0, 100)
    assert verdicts[0] == "field not known: observed for 0.00 s, 0.5 s needed"
    assert verdicts[19] == "field not known: observed for 0.47 s, 0.5 s needed"
    assert set(verdicts[20:]) == {OK}


def test_a_gap_between_frames_is_no_time_that_was_looked_at():
    """0.35 s of frames, 0.65 s of none: as each new frame comes, one of before is a second old."""
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 15)
    _, verdicts = told(watch, (0.02, 0.02, 0.02), 1.0, 24)
    assert verdicts[1] == "field not known: observed for 0.35 s, 0.5 s needed"
    known = [verdict == OK for verdict in verdicts]
    assert known == [False] * 20 + [True] * 4


def test_after_silence_in_a_distorted_field_one_clean_frame_is_not_enough():
    watch, verdicts = told(Watch(SETTINGS), (0.09, 0.02, 0.02), 0.0, 40)
    assert verdicts[-1].startswith("field distorted")
    _, verdicts = told(watch, (0.052, 0.02, 0.02), 2.5, 30)
    assert verdicts[-1] == "field distorted: ref1 0.0520, to fall below 0.0492 (median over 1 s)"
    _, verdicts = told(watch, (0.02, 0.02, 0.02), 2.5, 30)
    assert all(verdict.startswith("field not known: observed for") for verdict in verdicts[:20])
    assert verdicts[-1] == OK


def test_a_reference_seen_now_and_then_is_not_known():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    for k in range(40, 120):
        watch, verdicts = told(watch, (0.02, 0.02 if k % 4 == 0 else None, 0.02), k / RATE, 1)
    assert verdicts[-1].startswith("field not known: 2 of 3 reference sensors seen within 1 s")


@pytest.mark.parametrize("code", [float("nan"), float("inf"), -1.0])
def test_an_indicator_that_is_none_hides_no_distortion(code):
    """ref2 tells 0.9 in every other frame: half of its readings are enough to judge by, and they are bad."""
    watch = Watch(SETTINGS)
    for k in range(80):
        watch, verdicts = told(watch, (0.02, code if k % 2 else 0.9, 0.02), k / RATE, 1)
    assert verdicts[-1].startswith("field distorted: ref2 0.9000")
    _, verdicts = told(Watch(SETTINGS), (code, code, code), 0.0, 40)
    assert verdicts[-1].startswith("field not known: 0 of 3")


def test_references_out_of_volume_are_not_seen_whatever_they_tell():
    ill = SensorReading((0.0, 0.0, 0.0), indicator=0.01, status="out of volume")
    watch = Watch(SETTINGS)
    for k in range(40):
        told_by = Frame(
            k / RATE, k, {"tip": SensorReading((1.0, 2.0, 3.0)), "ref1": ill, "ref2": ill, "ref3": ill}
        )
        watch, _ = watch.take(Measurement(k / RATE, 30.0, 1.0, 0.0, told_by), at_rest, k / RATE, 0.3, 2.0)
    assert str(watch.look()[1]) == (
        "field not known: 0 of 3 reference sensors seen within 1 s "
        "(ref1: out of volume, ref2: out of volume, ref3: out of volume)"
    )


def test_no_other_sensor_stands_in_for_a_reference_but_each_may_tell_of_distortion():
    def verdict(other, ref3):
        """Of a second of frames in which ref3 is seen or not, and a second coil in the needle tells an indicator."""
        watch = Watch(SETTINGS)
        for k in range(40):
            place = SensorReading((0.0, 0.0, 0.0), indicator=0.01)
            readings = {
                "tip": SensorReading((1.0 + 1e-6 * k, 2.0, 3.0)),
                "ref1": place,
                "ref2": place,
                "ref3": ref3,
            }
            told_by = Frame(k / RATE, k, readings | {"tip.2": replace(place, indicator=other)})
            watch, _ = watch.take(Measurement(k / RATE, 30.0, 1.0, 0.0, told_by), at_rest, k / RATE, 0.3, 2.0)
        return str(watch.look()[1])

    seen, lost = SensorReading((0.0, 0.0, 0.0), indicator=0.01), SensorReading(None, status="out of volume")
    assert verdict(0.01, seen) == OK
    assert verdict(0.01, lost) == (
        "field not known: 2 of 3 reference sensors seen within 1 s "
        "(ref3: out of volume, no reference by its name: tip.2)"
    )
    assert verdict(0.2, seen).startswith("field distorted: tip.2 0.2000")


def test_only_the_last_window_is_judged():
    """0.2 for 2 s, then clean: after half a second more than half of a window of 1 s is clean, of 2 s is not."""
    watch, _ = told(Watch(SETTINGS), (0.2, 0.02, 0.02), 0.0, 80)
    _, verdicts = told(watch, (0.02, 0.02, 0.02), 2.0, 40)
    assert verdicts[18].startswith("field distorted")
    assert verdicts[20] == OK


def still(places, step, settings=SETTINGS):
    """The verdict on the last of readings at such places (x, None: not seen), while the model's tip goes `step` mm on
    in each."""
    watch = Watch(settings)
    for k, x in enumerate(places):
        sample = Measurement(k / RATE, x, None if x is None else 1.0)
        watch, verdict = watch.take(sample, driven(step * RATE), k / RATE, 0.3, 1e9)
    return str(verdict)


@pytest.mark.parametrize(
    ("places", "step", "count"),
    [
        ([29.0, *[30.0] * 4], 0.1001, 4),
        ([29.0, *[30.0] * 3], 0.1001, None),
        ([30.0] * 400, 0.0, None),
        ([30.0] * 400, 0.001, 400),  # slow, and longer than the window
        ([30.0] * 3 + [math.nextafter(30.0, 31.0)], 0.2, None),  # the last digit makes a reading new
        ([30.0, None] * 4 + [30.0], 0.1, 5),
    ],
)
def test_a_tip_that_stays_the_same_while_the_needle_moves_is_frozen(places, step, count):
    for settings in (SETTINGS, SETTINGS.model_copy(update={"indicator_window_s": 0.05})):
        verdict = still(places, step, settings)
        assert verdict == OK if count is None else verdict.startswith(f"frozen: the same in {count} readings")


def test_half_a_second_of_distortion_holds_and_names_the_sensor():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    _, verdicts = told(watch, (0.02, 0.09, 0.02), 1.0, 40)
    first = next(k for k, verdict in enumerate(verdicts) if verdict != OK)
    assert first in (19, 20, 21)
    assert verdicts[-1] == "field distorted: ref2 0.0900, to fall below 0.0492 (median over 1 s)"
    assert set(verdicts[:first]) == {OK}


def test_single_readings_above_the_threshold_do_not_hold():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    for k in range(40, 240):
        watch, verdicts = told(watch, (0.5 if k % 3 == 0 else 0.02, 0.02, 0.02), k / RATE, 1)
        assert verdicts == [OK]


def test_once_held_the_indicator_has_to_fall_below_the_lower_limit():
    watch, verdicts = told(Watch(SETTINGS), (0.06, 0.02, 0.02), 0.0, 40)
    assert verdicts[-1].startswith("field distorted")
    watch, verdicts = told(watch, (0.052, 0.02, 0.02), 1.0, 80)
    assert verdicts[-1] == "field distorted: ref1 0.0520, to fall below 0.0492 (median over 1 s)"
    watch, verdicts = told(watch, (0.049, 0.02, 0.02), 3.0, 80)
    assert verdicts[-1] == OK
    assert told(watch, (0.052, 0.02, 0.02), 6.0, 80)[1][-1] == OK


def test_what_left_the_window_is_forgotten():
    watch, _ = told(Watch(SETTINGS), (0.09, 0.02, 0.02), 0.0, 40)
    assert len(watch.recent) == 40
    watch, verdicts = told(watch, (0.02, 0.02, 0.02), 50.0, 40)
    assert verdicts[-1] == OK
    assert len(watch.recent) == 40


def test_a_lost_reference_holds_after_half_a_window_and_not_before():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 40)
    _, verdicts = told(watch, (0.02, None, 0.02), 1.0, 60)
    held = [verdict != OK for verdict in verdicts]
    assert held.index(True) in (19, 20, 21)
    assert verdicts[-1] == "field not known: 2 of 3 reference sensors seen within 1 s (ref2: out of volume)"


def test_as_many_references_are_needed_as_the_scenario_says():
    for needed, verdict in ((2, OK), (3, "field not known: 2 of 3 reference sensors seen within 1 s")):
        watch = Watch(SETTINGS.model_copy(update={"references": needed}))
        assert told(watch, (0.02, 0.02), 0.0, 40)[1][-1] == verdict


def test_a_tracker_that_tells_only_the_tip_is_not_held_against():
    watch, verdict = Watch(SETTINGS).take(Measurement(0.0, 30.0, 1.0), at_rest, 0.0, 0.3, 2.0)
    assert verdict.ok
    assert watch.look()[1].ok


@pytest.mark.parametrize(
    ("sample", "verdict"),
    [
        (Measurement(1.0, float("nan"), 1.0), "not a number"),
        (Measurement(1.0, None, None), "missing: tracker sees no tip"),
        (
            Measurement(1.0, None, None, frame=frame(1.0, tip=None)),
            "missing: tracker sees no tip (out of volume)",
        ),
        (Measurement(1.0, 30.0, 1.0, 6.0), "out of plane: 6.00 mm, limit 5 mm"),
        (Measurement(1.0, 33.0, 1.0), "innovation: 3.00 mm, limit 2 mm"),
    ],
)
def test_each_fault_of_a_reading_is_named(sample, verdict):
    assert one(sample) == verdict


def test_a_frame_told_again_is_not_believed_and_not_remembered():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    again = Measurement(0.075, 30.0, 1.0, 0.0, frame(2 / RATE))
    after, verdict = watch.take(again, at_rest, 0.075, 0.3, 2.0)
    assert str(verdict) == "stale: frame 2 after frame 2"
    assert after is watch


def test_an_old_reading_is_stale():
    assert one(Measurement(1.0, 30.0, 1.0), now=1.5) == "stale: 0.500 s old, limit 0.3 s"


def test_a_jump_counts_from_the_last_good_reading():
    watch, _ = Watch(SETTINGS).take(Measurement(1.0, 30.0, 1.0), at_rest, 1.0, 0.3, 2.0)
    far = Measurement(1.025, 31.9, 1.0)
    watch, verdict = watch.take(far, at_rest, 1.025, 0.3, 2.0)
    assert str(verdict) == "jump: 1.90 mm, limit 1.50 mm"
    assert watch.good == Measurement(1.0, 30.0, 1.0)
    assert one(Measurement(1.05, 31.9, 1.0), watch) == OK  # so far it may have come by now
    # Near the jump, and still too far from where it was last well seen.
    assert one(Measurement(1.03, 31.8, 1.0), watch) == "jump: 1.80 mm, limit 1.60 mm"


def test_a_frozen_sensor_is_seen_although_the_map_to_the_tip_changes():
    watch = Watch(SETTINGS)
    for k in range(4):
        sample = Measurement(k / RATE, 30.0 + 0.01 * k, 1.0, 0.0, frame(k / RATE))
        watch, verdict = watch.take(sample, driven(0.125 * RATE), sample.time, 0.3, 2.0)
    assert str(verdict) == "frozen: the same in 4 readings while the tip should have moved 0.38 mm"


def watched(estimates):
    """The verdict on the last of identical readings, one for each predicted tip (a function of time)."""
    watch = Watch(SETTINGS)
    for k, tip_at in enumerate(estimates):
        sample = Measurement(k / RATE, 30.0, 1.0)
        watch, verdict = watch.take(sample, tip_at, sample.time, 0.3, 1e9)
    return str(verdict)


@pytest.mark.parametrize("shift", [1.0, -1.0])
def test_a_correction_of_the_estimate_of_a_needle_at_rest_is_no_motion(shift):
    assert watched([at_rest] * 4 + [lambda _: (30.0 + shift, 1.0)] * 4) == OK


def test_corrections_do_not_hide_the_motion_of_a_driven_needle():
    """3.9 mm/s: 0.0975 mm between two readings, after each of which the estimate is corrected to the reading."""

    def after(k):
        return lambda time: (30.0 + 3.9 * (time - k / RATE), 1.0)

    assert watched(after(k) for k in range(4)) == OK
    assert watched(after(k) for k in range(5)) == (
        "frozen: the same in 5 readings while the tip should have moved 0.39 mm"
    )


@pytest.mark.parametrize("time", [1e6, -50.0, float("nan")])
def test_a_reading_of_another_time_changes_no_judgement_of_the_field(time):
    watch, _ = told(Watch(SETTINGS), (0.2, 0.02, 0.02), 0.0, 40)
    sample = Measurement(time, 30.0, 1.0, 0.0, replace(frame(1.0, (0.01, 0.01, 0.01)), number=1000))
    after, verdict = watch.take(sample, at_rest, 1.0, 0.3, 2.0)
    assert str(verdict).startswith(("stale", "not a number"))
    assert after is watch
    assert str(after.look()[1]).startswith("field distorted")


def test_the_last_good_reading_counts_until_it_is_old_and_only_of_frames():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    assert watch.last_good(0.35, 0.3) == watch.good
    assert watch.last_good(0.36, 0.3) is None
    bare, _ = Watch(SETTINGS).take(Measurement(0.0, 30.0, 1.0), at_rest, 0.0, 0.3, 2.0)
    assert bare.last_good(0.0, 0.3) is None


def test_a_tip_lost_in_a_few_frames_is_not_held_against_the_tracker():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 3)
    last = watch.good

    def lost(time, seen_by=watch):
        return seen_by.only_missed(Measurement(time, None, None, None, frame(time, tip=None)), MISSED)

    assert lost(last.time + 0.1) == last
    assert lost(last.time + 0.125) is None
    assert lost(last.time + 0.1, Watch(SETTINGS)) is None  # never seen
    assert watch.only_missed(Measurement(last.time + 0.025, None, None), MISSED) is None  # no frame
    assert watch.only_missed(last, Verdict()) is None  # not lost
    again = Measurement(last.time, None, None, None, frame(last.time, tip=None))
    for kind in (VerdictKind.STALE, VerdictKind.NOT_A_NUMBER):
        assert watch.only_missed(again, Verdict(kind, "of this kind")) is None  # it tells nothing of the tip
    off = replace(watch, settings=SETTINGS.model_copy(update={"enabled": False}))
    assert lost(last.time + 0.025, off) is None


def test_switched_off_it_still_refuses_what_no_loop_can_use():
    off = Watch(SETTINGS.model_copy(update={"enabled": False}))
    assert one(Measurement(1.0, 30.0, 1.0, 60.0), off) == OK
    assert one(Measurement(1.0, None, None), off).startswith("missing")
    assert one(Measurement(1.0, 33.0, 1.0), off).startswith("innovation")
    assert told(off, (5.0, 5.0, 5.0), 0.0, 80)[1][-1] == OK


def test_the_watch_itself_never_changes():
    watch, _ = told(Watch(SETTINGS), (0.02, 0.02, 0.02), 0.0, 10)
    kept = replace(watch)
    told(watch, (0.9, 0.9, 0.9), 0.25, 40)
    assert watch == kept
