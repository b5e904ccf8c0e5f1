"""Synthetic readings of a tracker with a tip and references."""

from dataclasses import replace

from flexneedle.record.fields import parse_verdict
from flexneedle.results import Action, CheckedMeasurement
from flexneedle.types import Frame, Measurement, SensorReading

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
FRAMES = 8  # in a period of 0.2 s


def frame_of(number, time, indicators, place=(1.0, 2.0, 3.0)):
    """Return a frame with the tip at `place` and references with these indicators by name, None where not measured."""
    tip = SensorReading(place, UPRIGHT) if place else SensorReading(None, status="out of volume")
    references = {
        name: SensorReading(None, status="missing")
        if value is None
        else SensorReading((50.0, 0.0, 0.0), UPRIGHT, value)
        for name, value in indicators.items()
    }
    return Frame(time, number, {"tip": tip, **references})


def with_readings(period, indicator=lambda _: 0.03, verdict="ok"):
    """Return the period with the frames of its 0.2 s; `indicator` of the worst reference over time (s)."""
    times = [period.time - 0.2 + 0.025 * (k + 1) for k in range(FRAMES)]
    numbers = range(FRAMES * period.index, FRAMES * (period.index + 1))
    frames = [
        frame_of(number, time, {"ref1": 0.01, "ref2": indicator(time), "ref3": 0.02})
        for number, time in zip(numbers, times, strict=True)
    ]
    readings = tuple(
        CheckedMeasurement(
            Measurement(frame.time, period.measurement.x, period.measurement.y, 0.0, frame),
            parse_verdict(verdict),
        )
        for frame in frames
    )
    return replace(period, readings=readings)


def held(period, reason="field distorted: ref2 0.0812, limit 0.0547 (median over 1 s)"):
    """Return the period with the needle held."""
    return replace(period, action=Action.HOLD, decision="held", verdict=parse_verdict(reason))
