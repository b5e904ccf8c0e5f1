"""Each rule of the monitor: accepted and rejected readings, on both sides of its limit."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.loop.monitor import rules
from flexneedle.types import Frame, Measurement, SensorReading, Verdict, VerdictKind

OK = "ok"
ORIGIN = (0.0, 0.0, 0.0)
LOST = SensorReading(None, status="out of volume")
GOOD = Measurement(1.0, 30.0, 1.0, 0.0)
DIRECTIONS = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, 0.8)]
NOT_FINITE = [math.nan, math.inf, -math.inf]
UNKNOWN = "field not known: 1 of 2 reference sensors measured within 1 s"


def test_the_first_bad_verdict_is_returned_and_later_rules_are_not_evaluated():
    def verdicts():
        yield Verdict()
        yield Verdict(VerdictKind.STALE, "bad")
        raise AssertionError

    assert str(rules.first_bad(verdicts())) == "stale: bad"
    assert str(rules.first_bad([Verdict(), Verdict()])) == str(rules.first_bad([])) == OK


def without_tip(**readings):
    return Measurement(1.0, None, None, frame=Frame(1.0, 7, readings) if readings else None)


def frame(number, time=1.0):
    return Frame(time, number, {})


@pytest.mark.parametrize(
    ("rule", "given", "verdict"),
    [
        (rules.check_missing, (GOOD,), OK),
        (rules.check_missing, (replace(GOOD, x=None),), "missing: tip not measured"),
        (rules.check_missing, (replace(GOOD, y=None),), "missing: tip not measured"),
        (rules.check_missing, (without_tip(),), "missing: tip not measured"),
        (rules.check_missing, (without_tip(tip=LOST),), "missing: tip not measured (out of volume)"),
        (
            rules.check_missing,
            (without_tip(tip=SensorReading(ORIGIN, status="out of volume")),),
            "missing: tip not measured (out of volume)",
        ),
        (
            rules.check_missing,
            (without_tip(tip=SensorReading(None)),),
            "missing: tip not measured (no position)",
        ),
        (
            rules.check_missing,
            (without_tip(tip=SensorReading(ORIGIN)),),
            "missing: tip not measured (no orientation)",
        ),
        (rules.check_not_a_number, (GOOD,), OK),
        (rules.check_not_a_number, (without_tip(),), OK),
        (rules.check_stale, (9.5, 10.0, 0.5), OK),
        (rules.check_stale, (10.5, 10.0, 0.5), OK),
        (rules.check_stale, (9.4, 10.0, 0.5), "stale: 0.600 s old, limit 0.500 s"),
        (rules.check_stale, (10.6, 10.0, 0.5), "stale: dated 0.600 s ahead"),
        (rules.check_repeated, (frame(8, 1.025), frame(7)), OK),
        (rules.check_repeated, (frame(7, 1.025), frame(7)), "stale: frame 7 after frame 7"),
        (rules.check_repeated, (frame(6, 1.025), frame(7)), "stale: frame 6 after frame 7"),
        (rules.check_repeated, (None, frame(7)), OK),
        (rules.check_repeated, (frame(7), None), OK),
        (rules.check_out_of_plane, (5.0, 5.0), OK),
        (rules.check_out_of_plane, (-5.0, 5.0), OK),
        (rules.check_out_of_plane, (None, 5.0), OK),
        (rules.check_out_of_plane, (-5.1, 5.0), "out of plane: -5.10 mm, limit 5.00 mm"),
        (rules.check_out_of_plane, (5.1, 5.0), "out of plane: 5.10 mm, limit 5.00 mm"),
        (rules.check_jump, (replace(GOOD, z=4.0), GOOD, 3.0), "jump: 4.00 mm, limit 3.00 mm"),
        (rules.check_jump, (replace(GOOD, z=None), replace(GOOD, z=4.0), 3.0), OK),
        (rules.check_frozen, (4, 0.3, 0.3), OK),
        (rules.check_frozen, (4, 0.301, 0.3), "frozen: 4 identical readings while the tip travelled 0.30 mm"),
        (rules.check_too_short, (0.475, 0.5, 3), "field not known: observed for 0.47 s, 0.5 s needed"),
        (rules.check_too_short, (0.5, 0.5, 3), OK),
        (rules.check_too_short, (0.0, 0.5, 0), OK),
        (rules.check_distortion, ({"ref1": [0.0547]}, 0.0547, 1.0), OK),
        (rules.check_distortion, ({}, 0.0547, 1.0), OK),
        (
            rules.check_distortion,
            ({"ref1": [0.05471]}, 0.0547, 1.0),
            "field distorted: ref1 0.0547, limit 0.0547 (median over 1 s)",
        ),
        (
            rules.check_distortion,  # the largest median counts
            ({"ref1": [0.05] * 9, "ref2": [0.08] * 5 + [0.0] * 4, "ref3": [0.06] * 9}, 0.0547, 1.0),
            "field distorted: ref2 0.0800, limit 0.0547 (median over 1 s)",
        ),
        (rules.check_missing_references, ({"ref1": [0.01], "ref2": []}, 1, 1.0, {}), OK),
        (rules.check_missing_references, ({}, 0, 1.0, {}), OK),
        (rules.check_missing_references, ({"ref1": [0.01], "ref2": []}, 2, 1.0, {}), UNKNOWN),
        (
            rules.check_missing_references,
            ({"ref1": [0.01]}, 2, 1.0, {"tip": LOST, "ref1": SensorReading(ORIGIN), "ref2": LOST}),
            f"{UNKNOWN} (ref2: out of volume)",
        ),
    ],
)
def test_a_rule_accepts_or_rejects_with_the_value_and_its_limit(rule, given, verdict):
    assert str(rule(*given)) == verdict


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_values_must_be_finite(bad):
    good = replace(
        GOOD,
        direction=(0.1, 0.2),
        points=(ORIGIN, (10.0, 0.1, 0.2)),
        covariance=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        direction_covariance=((1.0, 0.0), (0.0, 1.0)),
    )
    assert rules.check_not_a_number(good).ok
    spoilt = {
        **{name: {name: bad} for name in ("time", "x", "y", "z")},
        "direction": {"direction": (0.1, bad)},
        "points": {"points": (ORIGIN, (10.0, bad, 0.2))},
        "covariance": {"covariance": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, bad))},
        "direction covariance": {"direction_covariance": ((1.0, bad), (0.0, 1.0))},
    }
    for name, values in spoilt.items():
        assert str(rules.check_not_a_number(replace(good, **values))) == f"not a number: {name} {bad}"
    everything = {field: value for values in spoilt.values() for field, value in values.items()}
    found = str(rules.check_not_a_number(replace(good, **everything)))
    assert found == f"not a number: {', '.join(f'{name} {bad}' for name in spoilt)}"


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_distances_are_accepted_up_to_their_limit_in_any_direction(direction):
    def innovation(distance):
        tip = (30.0 + distance * direction[0], 1.0 + distance * direction[1])
        return str(rules.check_innovation(tip, (30.0, 1.0), 2.0))

    def jump(distance):
        tip = Measurement(1.1, 30.0 + distance * direction[0], 1.0 + distance * direction[1])
        return str(rules.check_jump(tip, GOOD, 3.0))

    assert innovation(2.0 - 1e-12) == jump(2.99) == OK
    assert innovation(5.0) == "innovation: 5.00 mm, limit 2.00 mm"
    assert innovation(2.0 + 1e-6).startswith("innovation")
    assert jump(3.01) == "jump: 3.01 mm, limit 3.00 mm"


def test_an_indicator_is_valid_for_a_measured_sensor_and_a_number_from_0():
    for indicator in (0.0, 0.02, 9.9):
        assert rules.has_indicator(SensorReading(ORIGIN, indicator=indicator))
    for indicator in (None, math.nan, math.inf, -1.0):
        assert not rules.has_indicator(SensorReading(ORIGIN, indicator=indicator))
    assert not rules.has_indicator(SensorReading(None, indicator=0.02))
    assert not rules.has_indicator(SensorReading(ORIGIN, indicator=0.02, status="out of volume"))


@given(st.lists(st.floats(0.0, 0.05), min_size=10, max_size=40), st.lists(st.floats(0.06, 9.9), max_size=9))
def test_fewer_than_half_of_the_readings_above_the_limit_are_accepted(low, high):
    assert rules.check_distortion({"ref1": low + high}, 0.0547, 1.0).ok
