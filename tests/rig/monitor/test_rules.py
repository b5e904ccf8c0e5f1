"""Each rule about readings: what it lets pass, what it names, both sides of its limit."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.rig.monitor import rules as judged
from flexneedle.types import Frame, Measurement, SensorReading, Verdict, VerdictKind

OK = "ok"


class Texts:
    """The rules, whose verdicts come as text."""

    def __getattr__(self, name):
        rule = getattr(judged, name)

        def text(*given, **named):
            found = rule(*given, **named)
            return str(found) if isinstance(found, Verdict) else found

        return text


rules = Texts()
WAYS = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, 0.8)]


def test_the_first_bad_verdict_counts_and_no_rule_behind_it_is_asked():
    def verdicts():
        yield Verdict()
        yield Verdict(VerdictKind.STALE, "bad")
        raise AssertionError

    assert rules.first_bad(verdicts()) == "stale: bad"
    assert rules.first_bad([Verdict(), Verdict()]) == rules.first_bad([]) == OK


@pytest.mark.parametrize(
    "sample", [Measurement(1.0, None, 1.0), Measurement(1.0, 30.0, None), Measurement(1.0, None, None)]
)
def test_a_tip_that_is_not_seen_is_missing(sample):
    assert rules.missing(sample) == "missing: tracker sees no tip"
    assert rules.missing(Measurement(1.0, 30.0, 1.0)) == OK


def test_the_trackers_own_reason_is_told():
    place = (0.0, 0.0, 0.0)
    for told, why in (
        (SensorReading(None, status="out of volume"), "out of volume"),
        (SensorReading(place, status="out of volume"), "out of volume"),
        (SensorReading(None), "no place"),
        (SensorReading(place), "no orientation"),
    ):
        frame = Frame(1.0, 7, {"tip": told, "ref1": SensorReading(place)})
        found = rules.missing(Measurement(1.0, None, None, frame=frame))
        assert found == f"missing: tracker sees no tip ({why})"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(4))
def test_what_is_not_finite_is_not_a_number(bad, which):
    values = [1.0, 30.0, 1.0, 0.0]
    values[which] = bad
    assert rules.not_a_number(Measurement(*values)) == "not a number"
    assert (
        rules.not_a_number(Measurement(1.0, 30.0, 1.0))
        == rules.not_a_number(Measurement(1.0, None, None))
        == OK
    )


def test_age_at_the_limit_is_believed_and_beyond_it_not():
    assert rules.stale(9.5, 10.0, 0.5) == rules.stale(10.5, 10.0, 0.5) == OK
    assert rules.stale(9.4, 10.0, 0.5) == "stale: 0.600 s old, limit 0.5 s"
    assert rules.stale(10.6, 10.0, 0.5) == "stale: dated 0.600 s ahead"


def test_a_frame_told_again_is_stale_whatever_its_time():
    frames = [Frame(time, number, {}) for time, number in ((1.0, 7), (1.025, 7), (1.025, 6), (1.025, 8))]
    assert [rules.repeated(frame, frames[0]) for frame in frames[1:]] == [
        "stale: frame 7 after frame 7",
        "stale: frame 6 after frame 7",
        OK,
    ]
    assert rules.repeated(None, frames[0]) == rules.repeated(frames[0], None) == OK


@pytest.mark.parametrize("way", WAYS)
def test_innovation_is_the_distance_and_its_limit_is_still_believed(way):
    def at(distance):
        return rules.innovation((30.0 + distance * way[0], 1.0 + distance * way[1]), (30.0, 1.0), 2.0)

    assert at(2.0 - 1e-12) == OK
    assert at(5.0) == "innovation: 5.00 mm, limit 2 mm"
    assert at(2.0 + 1e-6).startswith("innovation")


def test_a_tip_out_of_the_plane_on_either_side():
    assert (
        rules.out_of_plane(5.0, 5.0) == rules.out_of_plane(-5.0, 5.0) == rules.out_of_plane(None, 5.0) == OK
    )
    assert rules.out_of_plane(-5.1, 5.0) == "out of plane: -5.10 mm, limit 5 mm"
    assert rules.out_of_plane(5.1, 5.0).startswith("out of plane: 5.10 mm")


@pytest.mark.parametrize("way", WAYS)
def test_a_jump_is_faster_than_any_tip(way):
    """20 mm/s for 0.1 s, and 1 mm for noise: 3 mm."""
    before = Measurement(1.0, 30.0, 1.0)

    def after(distance):
        return rules.jump(
            Measurement(1.1, 30.0 + distance * way[0], 1.0 + distance * way[1]), before, 20.0, 1.0
        )

    assert after(2.99) == OK
    assert after(3.01) == "jump: 3.01 mm, limit 3.00 mm"
    assert rules.jump(before, None, 20.0, 1.0) == OK


def test_a_jump_out_of_the_plane_counts_where_both_readings_know_it():
    before = Measurement(1.0, 30.0, 1.0, 0.0)
    assert rules.jump(Measurement(1.1, 30.0, 1.0, 4.0), before, 20.0, 1.0).startswith("jump: 4.00 mm")
    assert rules.jump(Measurement(1.1, 30.0, 1.0), before, 20.0, 1.0) == OK


def test_a_reading_that_stays_while_the_needle_moves_is_frozen():
    assert rules.frozen(4, 0.3, 0.3) == OK
    assert rules.frozen(4, 0.301, 0.3) == (
        "frozen: the same in 4 readings while the tip should have moved 0.30 mm"
    )


def test_an_indicator_is_one_of_a_sensor_that_is_seen_and_a_number_that_one_can_be():
    place = (0.0, 0.0, 0.0)
    assert [rules.tells_indicator(SensorReading(place, indicator=i)) for i in (0.0, 0.02, 9.9)] == [True] * 3
    for indicator in (None, math.nan, math.inf, -1.0):
        assert not rules.tells_indicator(SensorReading(place, indicator=indicator))
    assert not rules.tells_indicator(SensorReading(None, indicator=0.02))
    assert not rules.tells_indicator(SensorReading(place, indicator=0.02, status="out of volume"))


def test_a_field_that_was_looked_at_for_too_short_is_not_known():
    assert rules.too_short(0.475, 0.5, 3) == "field not known: observed for 0.47 s, 0.5 s needed"
    assert rules.too_short(0.5, 0.5, 3) == rules.too_short(0.0, 0.5, 0) == OK


def test_the_worst_median_is_named():
    told = {"ref1": [0.05] * 9, "ref2": [0.08] * 5 + [0.0] * 4, "ref3": [0.06] * 9}
    assert rules.distortion(told, 0.0547, 1.0) == (
        "field distorted: ref2 0.0800, limit 0.0547 (median over 1 s)"
    )


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 0.05), min_size=10, max_size=40), st.lists(st.floats(0.06, 9.9), max_size=9))
def test_fewer_than_half_of_the_readings_above_the_limit_do_not_count(low, high):
    assert rules.distortion({"ref1": low + high}, 0.0547, 1.0) == OK


def test_the_median_at_the_limit_passes():
    assert rules.distortion({"ref1": [0.0547]}, 0.0547, 1.0) == rules.distortion({}, 0.0547, 1.0) == OK
    assert rules.distortion({"ref1": [0.05471]}, 0.0547, 1.0) != OK


def test_reference_sensors_that_tell_nothing_leave_the_field_unknown():
    told = {"ref1": [0.01], "ref2": []}
    assert rules.unseen_references(told, 1, 1.0, {}) == OK
    unknown = "field not known: 1 of 2 reference sensors seen within 1 s"
    assert rules.unseen_references(told, 2, 1.0, {}) == unknown
    lost = SensorReading(None, status="out of volume")
    newest = {"tip": lost, "ref1": SensorReading((0.0, 0.0, 0.0)), "ref2": lost}
    assert rules.unseen_references(told, 2, 1.0, newest) == unknown + " (ref2: out of volume)"
    assert rules.unseen_references({}, 0, 1.0, {}) == OK
