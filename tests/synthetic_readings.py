"""Synthetic readings of a tracker with a tip and references."""

from dataclasses import replace

from flexneedle.record.fields import parse_verdict
from flexneedle.results import Action
from flexneedle.types import CheckedMeasurement, Frame, Measurement, SensorReading
from synthetic import make_insertion

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
FRAMES = 8  # in a period of 0.2 s
DISTORTED = "field distorted: ref2 0.1457, to fall below 0.0492 (median over 1 s)"


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


def watched(miss=0.06, indicator=lambda time: 0.13 if 4.0 <= time <= 8.0 else 0.03, holds=((4.7, 8.7),)):
    """Return an insertion with readings of a tracker, held in some spans of time (s)."""
    made = make_insertion(miss=miss)
    periods = [with_readings(period, indicator) for period in made.periods]
    is_held = [any(begin < period.time < end for begin, end in holds) for period in periods]
    return replace(
        made, periods=tuple(held(p) if hold else p for p, hold in zip(periods, is_held, strict=True))
    )


def held_from_the_start():
    """Return an insertion that ended where it began; no reading was used."""
    insertion = make_insertion()
    first = held(insertion.periods[0], DISTORTED)
    still = [replace(first, index=k, time=0.2 * (k + 1)) for k in range(20)]
    rejected = tuple(with_readings(period, verdict=DISTORTED) for period in still)
    reason = f"held for 10.00 s (limit 10.00 s): {DISTORTED}"
    return replace(insertion, periods=rejected, outcome="held", reason=reason)


def without_indicators():
    """Return an insertion with readings of a tracker none of which has an indicator."""
    readings = watched(indicator=lambda _: None).periods[0].readings
    insertion = make_insertion()
    frames = [frame_of(k, one.measurement.time, {"ref1": None}) for k, one in enumerate(readings)]
    bare = tuple(
        replace(one, measurement=replace(one.measurement, frame=frame))
        for one, frame in zip(readings, frames, strict=True)
    )
    return replace(insertion, periods=tuple(replace(p, readings=bare) for p in insertion.periods))
