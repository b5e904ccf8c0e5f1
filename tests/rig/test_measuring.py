"""What is made of the readings of a period: before the needle moves, between two frames, with the tip lost."""

import math
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.rig.measuring import look_around, see
from flexneedle.rig.monitor.watch import Watch
from flexneedle.types import VISIBLE, Frame, Measurement, SensorReading

OK = "ok"

SCENARIO = flexneedle.load_scenario("phantom")
TIP = (30.0, 1.0)
RATE = 40.0
STALE_AFTER = SCENARIO.control.stale_after_s


class Belief:
    """A tip at rest. heard: how many readings it was corrected by, None for a period without any."""

    def __init__(self, heard=0):
        self.heard = heard

    tip_sd = 0.0

    def tip_at(self, _time):
        return TIP

    def observe(self, samples):
        return Belief(len(samples))

    def without_reading(self):
        return Belief(None)


class Eye:
    """A tracker that tells these samples."""

    def __init__(self, *samples, status=VISIBLE):
        self.samples, self.status = samples, status

    def read(self):
        return self.samples


def sample(time, *, seen=True, indicator=0.02):
    references = {f"ref{k}": SensorReading((0.0, 0.0, 0.0), indicator=indicator) for k in (1, 2, 3)}
    tip = SensorReading((*TIP, time)) if seen else SensorReading(None, status="out of volume")
    x, y, z = (*TIP, 0.0) if seen else (None, None, None)
    return Measurement(time, x, y, z, Frame(time, round(time * RATE), {"tip": tip, **references}))


def second(end=1.0, **kind):
    """The samples of a second up to `end`."""
    return [sample(end - k / RATE, **kind) for k in range(40, -1, -1)]


def before(now, *samples, watch=None):
    return look_around(SCENARIO, Belief(), watch or Watch(SCENARIO.monitor), now, Eye(*samples))


def during(watch, now, *samples, status=VISIBLE):
    return see(SCENARIO, Belief(), watch, now - 0.2, now, Eye(*samples, status=status))


def test_before_the_needle_moves_all_that_was_told_counts_however_long_ago():
    """The readings of a second have a limit of age of 0.3 s only from there on that the tracker could tell them."""
    sight = before(1.0 + 0.9 * STALE_AFTER, *second())
    assert str(sight.verdict) == OK
    assert {str(reading.verdict) for reading in sight.readings} == {OK}


@pytest.mark.parametrize(("lost", "verdict"), [(3, OK), (6, "missing: tracker sees no tip (out of volume)")])
def test_before_the_needle_moves_the_tip_may_be_lost_for_a_tenth_of_a_second(lost, verdict):
    samples = second()
    samples[-lost:] = [sample(one.time, seen=False) for one in samples[-lost:]]
    sight = before(1.0, *samples)
    assert str(sight.verdict) == verdict
    assert not sight.field


def test_before_the_needle_moves_a_lost_tip_does_not_hide_the_field():
    samples = second(indicator=0.2)
    samples[-1] = sample(1.0, seen=False, indicator=0.2)
    sight = before(1.0, *samples)
    assert str(sight.verdict).startswith("field distorted")
    assert sight.field


def test_before_the_needle_moves_the_newest_frame_is_of_now():
    """Frames of a minute ago, each as good as can be, of a tracker that went silent."""
    sight = before(61.0, *second())
    assert str(sight.verdict) == "stale: 60.000 s old, limit 0.3 s"
    blind = [*second()[:-1], sample(1.0, seen=False)]
    assert str(before(61.0, *blind).verdict) == "stale: 60.000 s old, limit 0.3 s"
    undated = [replace(sample(0.0), time=math.nan), *second()]
    assert str(before(61.0, *undated).verdict) == "stale: 60.000 s old, limit 0.3 s"


def test_an_old_frame_told_again_without_the_tip_is_not_taken_for_one_that_lost_it():
    watch = before(1.0, *second()).watch
    for again in (sample(1.0, seen=False), replace(sample(1.025, seen=False), time=math.nan)):
        sight = during(watch, 1.05, again)
        assert str(sight.verdict) in ("stale: frame 40 after frame 40", "not a number")
        assert sight.estimate.heard is None


def test_between_two_frames_a_good_field_is_as_it_was_and_nothing_is_learnt():
    watch = before(1.0, *second()).watch
    sight = during(watch, 1.0 + 0.9 * STALE_AFTER)
    assert (str(sight.verdict), sight.estimate.heard) == (OK, None)


def test_between_two_frames_a_distorted_field_is_as_it_was_and_nothing_is_learnt():
    watch = before(1.0, *second(indicator=0.2)).watch
    sight = during(watch, 1.0 + 0.9 * STALE_AFTER)
    assert str(sight.verdict).startswith("field distorted")
    assert (sight.field, sight.estimate.heard) == (True, None)


def test_after_the_age_limit_silence_is_silence_whatever_the_field_was():
    for indicator in (0.02, 0.2):
        watch = before(1.0, *second(indicator=indicator)).watch
        sight = during(watch, 1.0 + 1.1 * STALE_AFTER, status="no reply")
        assert str(sight.verdict) == "missing: no reading (no reply)"
        assert (sight.field, sight.estimate.heard) == (False, None)


def periods(watch, *indicators):
    """What is made of control periods of 0.2 s from second 1 on, in each of which the references tell this."""
    sights = []
    for k, indicator in enumerate(indicators, 1):
        now = 1.0 + 0.2 * k
        told = (sample(now - n / RATE, indicator=indicator) for n in range(7, -1, -1))
        sights.append(during(sights[-1].watch if sights else watch, now, *told))
    return sights


def test_in_a_distorted_field_no_reading_corrects_the_belief():
    """It is in doubt for half a second before the median over a second says so."""
    sights = periods(before(1.0, *second()).watch, 0.2, 0.2, 0.2, 0.2)
    assert [str(sight.verdict).split(":")[0] for sight in sights] == [
        "ok",
        "ok",
        "field distorted",
        "field distorted",
    ]
    for sight in sights:
        assert sight.estimate.heard is None
        assert not sight.saw_after(0.0)
        (told,) = {str(reading.verdict) for reading in sight.readings}
        in_doubt = "field in doubt: ref1 0.2000, limit 0.0547 (median over 0.2 s)"
        assert told == (in_doubt if sight.verdict.ok else str(sight.verdict))


def test_a_field_in_doubt_for_a_moment_holds_nothing_and_is_believed_again():
    sights = periods(before(1.0, *second()).watch, 0.02, 0.2, 0.02)
    assert [(str(sight.verdict), sight.estimate.heard) for sight in sights] == [(OK, 8), (OK, None), (OK, 8)]
    assert [sight.saw_after(1.0) for sight in sights] == [True, False, True]


def test_a_monitor_that_is_switched_off_has_no_doubts():
    off = SCENARIO.with_values({"monitor.enabled": False}).monitor
    assert periods(Watch(off), 0.2)[0].estimate.heard == 8


def test_readings_on_their_way_while_the_needle_moved_may_be_older_than_the_newest():
    """A move of 0.2 s: of two readings as old as that and the limit together the newest is stale, the other is not."""
    watch = before(1.0, *second()).watch
    age = STALE_AFTER + 0.1
    sight = during(watch, 1.2 + age, sample(1.1), sample(1.2))
    assert [str(reading.verdict) for reading in sight.readings] == [
        OK,
        f"stale: {age:.3f} s old, limit 0.3 s",
    ]
    assert sight.estimate.heard is None


def test_a_newest_frame_without_the_tip_keeps_the_good_readings_of_the_period():
    watch = before(1.0, *second()).watch
    good, blind = [sample(1.0 + k / RATE) for k in (1, 2)], sample(1.0 + 3 / RATE, seen=False)
    sight = during(watch, blind.time, *good, blind)
    assert (str(sight.verdict), sight.estimate.heard, sight.sample) == (OK, 2, good[-1])
    alone = during(watch, 1.0 + 1 / RATE, sample(1.0 + 1 / RATE, seen=False))
    assert (str(alone.verdict), alone.estimate.heard, alone.sample.time) == (OK, None, 1.0)


class Refitted(Belief):
    """A needle at rest whose first correction shifts the tip by 1 mm."""

    tip_sd = 1.0

    def tip_at(self, _time):
        return TIP[0] + (1.0 if self.heard else 0.0), TIP[1]

    def observe(self, samples):
        return Refitted(self.heard + len(samples))


def test_a_refit_of_a_needle_at_rest_does_not_make_a_tracker_without_noise_a_frozen_one():
    estimate, watch = Refitted(), Watch(SCENARIO.monitor)
    for k in range(8):
        sight = see(SCENARIO, estimate, watch, k / RATE - 0.2, k / RATE, Eye(Measurement(k / RATE, *TIP)))
        assert str(sight.verdict) == OK
        estimate, watch = sight.estimate, sight.watch
    assert estimate.heard == 8


def test_a_broken_last_reading_is_the_verdict_and_earlier_good_ones_are_not_told_as_seen():
    watch = before(1.0, *second()).watch
    jumped = replace(sample(1.05), y=TIP[1] + 3.0)
    sight = during(watch, 1.05, sample(1.025), jumped)
    assert str(sight.verdict).startswith("innovation: 3.00 mm")
    assert sight.estimate.heard is None


class Unsure(Belief):
    """A tip whose prediction is off by half a millimetre."""

    tip_sd = 0.5


def test_the_limit_of_the_innovation_widens_with_the_uncertainty_of_the_prediction():
    """By three standard deviations: at the start a rig may be off by more than the limit."""
    limit = SCENARIO.control.innovation_limit_mm
    for estimate, most in ((Belief(), limit), (Unsure(), limit + 1.5)):
        for off, verdict in ((most - 0.01, OK), (most + 0.01, "innovation")):
            one = Measurement(1.0, TIP[0], TIP[1] + off)
            sight = see(SCENARIO, estimate, Watch(SCENARIO.monitor), 0.8, 1.0, Eye(one))
            assert str(sight.readings[0].verdict).split(":")[0] == verdict
