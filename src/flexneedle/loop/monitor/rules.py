"""Checks of a reading and of the tracker's field: each rule is a pure function.

A rule returns OK, or a verdict with the measured value and its limit. A bad reading is rejected, never corrected.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from statistics import median

from flexneedle.types import (
    OK,
    TIP,
    VISIBLE,
    Frame,
    Measurement,
    SensorReading,
    Verdict,
    VerdictKind,
    is_reference,
)

Position = tuple[float, ...]


def first_bad(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the first verdict that is not OK, else OK; the rest of a generator is not evaluated."""
    return next((verdict for verdict in verdicts if not verdict.ok), OK)


def check_missing(measurement: Measurement, axes: int = 1) -> Verdict:
    """Require a tip, with z if there are two lateral axes; the verdict has the tracker's reason if it gives one."""
    if None not in (measurement.x, measurement.y, measurement.z)[: 1 + axes]:
        return OK
    reading = None if measurement.frame is None else measurement.frame.readings.get(TIP)
    if reading is None:
        return Verdict(VerdictKind.MISSING, "tip not measured")
    if reading.status != VISIBLE:
        reason = reading.status
    else:
        reason = "no position" if reading.position is None else "no orientation"
    return Verdict(VerdictKind.MISSING, f"tip not measured ({reason})")


def check_not_a_number(measurement: Measurement) -> Verdict:
    """Require finite time, coordinates, direction, points and covariances; the verdict names the others."""
    bad: dict[str, float] = {}  # the first of each name
    for name, values in _list_numbers(measurement):
        for value in values:
            if value is not None and not math.isfinite(value):
                bad.setdefault(name, value)
    reason = ", ".join(f"{name} {value}" for name, value in bad.items())
    return Verdict(VerdictKind.NOT_A_NUMBER, reason) if bad else OK


def check_stale(time: float, now: float, limit: float) -> Verdict:
    """Require a time stamp at most `limit` (s) in the past or in the future."""
    if now - time > limit:
        return Verdict(VerdictKind.STALE, f"{now - time:.3f} s old, limit {limit:.3f} s")
    if time > now + limit:
        return Verdict(VerdictKind.STALE, f"dated {time - now:.3f} s ahead")
    return OK


def check_repeated(frame: Frame | None, previous: Frame | None) -> Verdict:
    """Require a frame number above the previous one, whatever the time stamp."""
    if frame is None or previous is None or frame.number > previous.number:
        return OK
    return Verdict(VerdictKind.STALE, f"frame {frame.number} after frame {previous.number}")


def check_innovation(measured: Position, predicted: Position, limit: float) -> Verdict:
    """Require a tip at most `limit` (mm) from the predicted one."""
    distance = math.dist(measured, predicted)
    if distance <= limit:
        return OK
    return Verdict(VerdictKind.INNOVATION, f"{distance:.2f} mm, limit {limit:.2f} mm")


def check_out_of_plane(z: float | None, limit: float) -> Verdict:
    """Require a tip at most `limit` (mm) from the plane of the insertion; OK for a tracker without z."""
    if z is None or abs(z) <= limit:
        return OK
    return Verdict(VerdictKind.OUT_OF_PLANE, f"{z:.2f} mm, limit {limit:.2f} mm")


def check_jump(measurement: Measurement, previous: Measurement, limit: float) -> Verdict:
    """Require a tip at most `limit` (mm) from the previous good reading."""
    travel = math.dist(*_common_coordinates(measurement, previous))
    if travel <= limit:
        return OK
    return Verdict(VerdictKind.JUMP, f"{travel:.2f} mm, limit {limit:.2f} mm")


def check_frozen(count: int, travel: float, travel_limit: float) -> Verdict:
    """Refuse `count` identical readings while the predicted tip travelled more than `travel_limit` (mm)."""
    if travel <= travel_limit:
        return OK
    return Verdict(VerdictKind.FROZEN, f"{count} identical readings while the tip travelled {travel:.2f} mm")


def has_indicator(reading: SensorReading) -> bool:
    """Return whether a sensor is measured and has a valid indicator.

    Valid is a finite number from 0; trackers report −1 as an error code.
    """
    indicator = reading.indicator
    measured = reading.status == VISIBLE and reading.position is not None
    return measured and indicator is not None and 0.0 <= indicator < math.inf


def check_too_short(duration: float, least: float, needed: int) -> Verdict:
    """Require frames that cover at least `least` (s), if any reference sensors are `needed`."""
    if needed == 0 or duration >= least - 1e-9:
        return OK
    return Verdict(VerdictKind.FIELD_UNKNOWN, f"observed for {duration:.2f} s, {least:g} s needed")


def check_missing_references(
    indicators: Mapping[str, Sequence[float]], needed: int, window: float, newest: Mapping[str, SensorReading]
) -> Verdict:
    """Require `needed` reference sensors with an indicator within the window (s).

    newest: the newest readings by sensor; their status explains the verdict. Only a sensor with the name of a reference
    counts, not a second one in the needle, for example.
    """
    measured = sum(bool(values) and is_reference(name) for name, values in indicators.items())
    if measured >= needed:
        return OK
    others = [name for name in newest if name != TIP]
    faults = [f"{name}: {newest[name].status}" for name in others if newest[name].status != VISIBLE]
    if misnamed := [name for name in others if not is_reference(name)]:
        faults.append(f"not named as a reference: {', '.join(misnamed)}")
    detail = f" ({', '.join(faults)})" if faults else ""
    reason = f"{measured} of {needed} reference sensors measured within {window:g} s{detail}"
    return Verdict(VerdictKind.FIELD_UNKNOWN, reason)


def check_distortion(
    indicators: Mapping[str, Sequence[float]], limit: float, window: float, resuming: bool = False
) -> Verdict:
    """Require medians of the indicators over the window (s) at most at the limit.

    The verdict names the sensor with the largest median. resuming: true after a distorted field, with `limit` the lower
    one of the hysteresis.
    """
    name, value = largest_median(indicators)
    if value <= limit:
        return OK
    rule = "must fall below" if resuming else "limit"
    reason = f"{name} {value:.4f}, {rule} {limit:.4f} (median over {window:g} s)"
    return Verdict(VerdictKind.FIELD_DISTORTED, reason)


def check_in_doubt(indicators: Mapping[str, Sequence[float]], limit: float, window: float) -> Verdict:
    """Check as `check_distortion`, over a window (s) too short for a hold.

    Readings of this time must not correct the estimate.
    """
    name, value = largest_median(indicators)
    if value <= limit:
        return OK
    reason = f"{name} {value:.4f}, limit {limit:.4f} (median over {window:g} s)"
    return Verdict(VerdictKind.FIELD_IN_DOUBT, reason)


def largest_median(indicators: Mapping[str, Sequence[float]]) -> tuple[str, float]:
    """Return the sensor with the largest median indicator, and the median; ("", 0) if there is no indicator."""
    medians = {name: median(values) for name, values in indicators.items() if values}
    return max(medians.items(), key=lambda item: item[1], default=("", 0.0))


def _list_numbers(measurement: Measurement) -> Iterator[tuple[str, Iterable[float | None]]]:
    """Return the numbers of a reading by name, None if not measured, without the sensors of its frame."""
    yield "time", (measurement.time,)
    yield "x", (measurement.x,)
    yield "y", (measurement.y,)
    yield "z", (measurement.z,)
    yield "direction", measurement.direction or ()
    yield "points", chain.from_iterable(measurement.points)
    yield "covariance", chain.from_iterable(measurement.covariance or ())
    yield "direction covariance", chain.from_iterable(measurement.direction_covariance or ())


def _common_coordinates(one: Measurement, other: Measurement) -> tuple[Position, Position]:
    """Return the positions of two readings in the coordinates that both have."""
    pairs = ((one.x, other.x), (one.y, other.y), (one.z, other.z))
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    return tuple(a for a, _ in known), tuple(b for _, b in known)
