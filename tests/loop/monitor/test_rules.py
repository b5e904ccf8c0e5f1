"""Each rule of the monitor: accepted and rejected readings, on both sides of its limit."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.loop.monitor import rules as monitor_rules
from flexneedle.results import Verdict, VerdictKind
from flexneedle.types import Frame, Measurement, SensorReading

OK = "ok"


class Texts:
    """The rules, with verdicts as text."""

    def __getattr__(self, name):
        rule = getattr(monitor_rules, f"check_{name}", None) or getattr(monitor_rules, name)

        def text(*args, **options):
            result = rule(*args, **options)
            return str(result) if isinstance(result, Verdict) else result

        return text


rules = Texts()
DIRECTIONS = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, 0.8)]


def test_the_first_bad_verdict_is_returned_and_later_rules_are_not_evaluated():
    def verdicts():
        yield Verdict()
        yield Verdict(VerdictKind.STALE, "bad")
        raise AssertionError

    assert rules.first_bad(verdicts()) == "stale: bad"
    assert rules.first_bad([Verdict(), Verdict()]) == rules.first_bad([]) == OK


@pytest.mark.parametrize(
    "measurement", [Measurement(1.0, None, 1.0), Measurement(1.0, 30.0, None), Measurement(1.0, None, None)]
)
def test_a_reading_without_a_tip_is_missing(measurement):
    assert rules.missing(measurement) == "missing: tip not measured"
    assert rules.missing(Measurement(1.0, 30.0, 1.0)) == OK


def test_a_missing_tip_has_the_trackers_reason():
    origin = (0.0, 0.0, 0.0)
    for reading, reason in (
        (SensorReading(None, status="out of volume"), "out of volume"),
        (SensorReading(origin, status="out of volume"), "out of volume"),
        (SensorReading(None), "no position"),
        (SensorReading(origin), "no orientation"),
    ):
        frame = Frame(1.0, 7, {"tip": reading, "ref1": SensorReading(origin)})
        found = rules.missing(Measurement(1.0, None, None, frame=frame))
        assert found == f"missing: tip not measured ({reason})"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", ["time", "x", "y", "z"])
def test_a_value_that_is_not_finite_is_not_a_number(bad, which):
    measurement = replace(Measurement(1.0, 30.0, 1.0, 0.0), **{which: bad})
    assert rules.not_a_number(measurement) == f"not a number: {which} {bad}"
    assert (
        rules.not_a_number(Measurement(1.0, 30.0, 1.0))
        == rules.not_a_number(Measurement(1.0, None, None))
        == OK
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_directions_points_and_covariances_must_be_finite(bad):
    good = Measurement(
        1.0,
        30.0,
        1.0,
        direction=(0.1, 0.2),
        points=((0.0, 0.0, 0.0), (10.0, 0.1, 0.2)),
        covariance=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        direction_covariance=((1.0, 0.0), (0.0, 1.0)),
    )
    assert rules.not_a_number(good) == OK
    spoilt = {
        "direction": {"direction": (0.1, bad)},
        "points": {"points": ((0.0, 0.0, 0.0), (10.0, bad, 0.2))},
        "covariance": {"covariance": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, bad))},
        "direction covariance": {"direction_covariance": ((1.0, bad), (0.0, 1.0))},
    }
    for name, values in spoilt.items():
        assert rules.not_a_number(replace(good, **values)) == f"not a number: {name} {bad}"
    everything = {field: value for values in spoilt.values() for field, value in values.items()}
    assert rules.not_a_number(replace(good, y=bad, **everything)) == (
        f"not a number: y {bad}, direction {bad}, points {bad}, covariance {bad}, direction covariance {bad}"
    )


def test_a_reading_is_stale_beyond_the_age_limit():
    assert rules.stale(9.5, 10.0, 0.5) == rules.stale(10.5, 10.0, 0.5) == OK
    assert rules.stale(9.4, 10.0, 0.5) == "stale: 0.600 s old, limit 0.5 s"
    assert rules.stale(10.6, 10.0, 0.5) == "stale: dated 0.600 s ahead"


def test_a_repeated_frame_number_is_stale_whatever_its_time():
    frames = [Frame(time, number, {}) for time, number in ((1.0, 7), (1.025, 7), (1.025, 6), (1.025, 8))]
    assert [rules.repeated(frame, frames[0]) for frame in frames[1:]] == [
        "stale: frame 7 after frame 7",
        "stale: frame 6 after frame 7",
        OK,
    ]
    assert rules.repeated(None, frames[0]) == rules.repeated(frames[0], None) == OK


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_innovation_is_the_distance_and_is_accepted_up_to_its_limit(direction):
    def at(distance):
        return rules.innovation(
            (30.0 + distance * direction[0], 1.0 + distance * direction[1]), (30.0, 1.0), 2.0
        )

    assert at(2.0 - 1e-12) == OK
    assert at(5.0) == "innovation: 5.00 mm, limit 2 mm"
    assert at(2.0 + 1e-6).startswith("innovation")


def test_a_tip_out_of_the_plane_is_rejected_on_either_side():
    assert (
        rules.out_of_plane(5.0, 5.0) == rules.out_of_plane(-5.0, 5.0) == rules.out_of_plane(None, 5.0) == OK
    )
    assert rules.out_of_plane(-5.1, 5.0) == "out of plane: -5.10 mm, limit 5 mm"
    assert rules.out_of_plane(5.1, 5.0).startswith("out of plane: 5.10 mm")


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_motion_beyond_the_limit_is_a_jump(direction):
    before = Measurement(1.0, 30.0, 1.0)

    def after(distance):
        return rules.jump(
            Measurement(1.1, 30.0 + distance * direction[0], 1.0 + distance * direction[1]), before, 3.0
        )

    assert after(2.99) == OK
    assert after(3.01) == "jump: 3.01 mm, limit 3.00 mm"


def test_a_jump_out_of_the_plane_counts_if_both_readings_have_z():
    before = Measurement(1.0, 30.0, 1.0, 0.0)
    assert rules.jump(Measurement(1.1, 30.0, 1.0, 4.0), before, 3.0).startswith("jump: 4.00 mm")
    assert rules.jump(Measurement(1.1, 30.0, 1.0), before, 3.0) == OK


def test_identical_readings_while_the_tip_travels_are_frozen():
    assert rules.frozen(4, 0.3, 0.3) == OK
    assert rules.frozen(4, 0.301, 0.3) == ("frozen: 4 identical readings while the tip travelled 0.30 mm")


def test_an_indicator_is_valid_for_a_measured_sensor_and_a_number_from_0():
    origin = (0.0, 0.0, 0.0)
    assert [rules.has_indicator(SensorReading(origin, indicator=i)) for i in (0.0, 0.02, 9.9)] == [True] * 3
    for indicator in (None, math.nan, math.inf, -1.0):
        assert not rules.has_indicator(SensorReading(origin, indicator=indicator))
    assert not rules.has_indicator(SensorReading(None, indicator=0.02))
    assert not rules.has_indicator(SensorReading(origin, indicator=0.02, status="out of volume"))


def test_a_field_observed_for_too_short_a_time_is_not_known():
    assert rules.too_short(0.475, 0.5, 3) == "field not known: observed for 0.47 s, 0.5 s needed"
    assert rules.too_short(0.5, 0.5, 3) == rules.too_short(0.0, 0.5, 0) == OK


def test_the_largest_median_is_reported():
    indicators = {"ref1": [0.05] * 9, "ref2": [0.08] * 5 + [0.0] * 4, "ref3": [0.06] * 9}
    assert rules.distortion(indicators, 0.0547, 1.0) == (
        "field distorted: ref2 0.0800, limit 0.0547 (median over 1 s)"
    )


@given(st.lists(st.floats(0.0, 0.05), min_size=10, max_size=40), st.lists(st.floats(0.06, 9.9), max_size=9))
def test_fewer_than_half_of_the_readings_above_the_limit_are_accepted(low, high):
    assert rules.distortion({"ref1": low + high}, 0.0547, 1.0) == OK


def test_a_median_at_the_limit_is_accepted():
    assert rules.distortion({"ref1": [0.0547]}, 0.0547, 1.0) == rules.distortion({}, 0.0547, 1.0) == OK
    assert rules.distortion({"ref1": [0.05471]}, 0.0547, 1.0) != OK


def test_the_field_is_not_known_without_indicators_of_enough_references():
    indicators = {"ref1": [0.01], "ref2": []}
    assert rules.missing_references(indicators, 1, 1.0, {}) == OK
    unknown = "field not known: 1 of 2 reference sensors measured within 1 s"
    assert rules.missing_references(indicators, 2, 1.0, {}) == unknown
    lost = SensorReading(None, status="out of volume")
    newest = {"tip": lost, "ref1": SensorReading((0.0, 0.0, 0.0)), "ref2": lost}
    assert rules.missing_references(indicators, 2, 1.0, newest) == unknown + " (ref2: out of volume)"
    assert rules.missing_references({}, 0, 1.0, {}) == OK
