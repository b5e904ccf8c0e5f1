"""Check of the readings before the first step: nothing is expected, but a bad reading prevents the step."""

import math
from dataclasses import replace

import pytest

from flexneedle.lab.rig.supervisor.protocol import Expectation
from flexneedle.lab.rig.supervisor.tip_watch import TipWatch
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import VISIBLE, Frame, Measurement, SensorReading, VerdictKind

NOW = 10.0
AT_TIP = Expectation((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 3.0)


def measured(number, time=NOW, x=0.0):
    frame = Frame(time, number, {"tip": SensorReading((x, 0.0, 0.0))})
    return Measurement(time, x, 0.0, 0.0, frame)


def watched(*readings):
    """Return the verdict at the start of the first step after these readings, each of one tick."""
    watch = TipWatch(Monitor(MonitorSettings(references=0)), 0.25, 0.0)
    for reading in readings:
        watch = watch.with_readings([reading], NOW, VISIBLE)
    return watch.with_expectation(AT_TIP, NOW, NOW + 1.0).verdict


@pytest.mark.parametrize(
    ("newest", "kind"),
    [
        (measured(3), VerdictKind.OK),
        (measured(3, x=math.nan), VerdictKind.NOT_A_NUMBER),
        (measured(2), VerdictKind.STALE),
        (measured(1), VerdictKind.STALE),
        (measured(3, NOW - 0.3), VerdictKind.STALE),
        (measured(3, NOW + 0.3), VerdictKind.STALE),
    ],
)
def test_a_first_step_does_not_begin_on_a_missing_old_or_repeated_reading(newest, kind):
    assert watched(measured(1), measured(2), newest).kind is kind


def test_a_good_reading_ends_the_rejection():
    assert watched(measured(1), measured(1), measured(2)).ok


def test_the_expected_motion_of_the_tip_waits_with_its_motors():
    watch = TipWatch(Monitor(MonitorSettings(references=0)), 0.25, 0.0).with_expectation(
        AT_TIP, NOW, NOW + 1.0
    )
    assert watch.with_later_end(NOW + 0.5, 1.0).ended == NOW + 2.0
    assert watch.with_later_end(NOW + 1.5, 1.0).ended == NOW + 1.0
    halfway = replace(
        watch.with_later_end(NOW + 0.5, 1.0), expected=Expectation((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), 0.1)
    )
    assert halfway.with_readings([measured(4, NOW + 1.0, 4.5)], NOW + 1.0, VISIBLE).verdict.ok


@pytest.mark.parametrize(
    ("reading", "kind"),
    [
        ((), VerdictKind.OK),
        ((measured(2, x=5.0),), VerdictKind.INNOVATION),
        ((measured(2, x=math.nan),), VerdictKind.NOT_A_NUMBER),
    ],
)
def test_a_step_with_a_sensor_along_the_needle_needs_no_tracker_but_none_that_contradicts(reading, kind):
    """The next step needs a new reading of a sensor."""
    sensed = replace(AT_TIP, sensed=True)
    watch = TipWatch(Monitor(MonitorSettings(references=0)), 0.25, NOW - 1.0)
    moving = watch.with_expectation(sensed, NOW, NOW + 1.0).with_readings(reading, NOW, VISIBLE)
    assert moving.permission.kind is kind
    assert not moving.with_expectation(AT_TIP, NOW, NOW + 1.0).permission.ok


def in_field(settings, *, sensed, x=0.0):
    """Return the permission in a step, a second after the field has become distorted; x: of the newest reading."""
    expected = replace(AT_TIP, end=AT_TIP.begin, sensed=sensed)
    watch = TipWatch(Monitor(settings), 0.25, NOW - 1.0).with_expectation(expected, NOW, NOW)
    reference = SensorReading((0.0, 0.0, 0.0), indicator=0.3)
    for k in range(41):
        time = NOW + k / 40.0
        here = measured(k, time, x if k == 40 else 1e-3 * k)
        frame = replace(here.frame, readings={**here.frame.readings, "ref1": reference})
        watch = watch.with_readings([replace(here, frame=frame)], time, VISIBLE)
    return watch.permission.kind


def test_a_distorted_field_holds_the_needle_unless_the_fit_knows_its_error():
    """A reading that is bad by itself holds the needle in any case."""
    known, unknown = (MonitorSettings(references=1, indicator_error_mm=error) for error in (9.6, 0.0))
    assert in_field(known, sensed=True) is VerdictKind.OK
    assert in_field(known, sensed=False) is VerdictKind.FIELD_DISTORTED
    assert in_field(unknown, sensed=True) is VerdictKind.FIELD_DISTORTED
    assert in_field(known, sensed=True, x=5.0) is VerdictKind.INNOVATION
    assert in_field(known, sensed=True, x=math.nan) is VerdictKind.NOT_A_NUMBER
    assert in_field(known.model_copy(update={"references": 2}), sensed=True) is VerdictKind.FIELD_UNKNOWN
