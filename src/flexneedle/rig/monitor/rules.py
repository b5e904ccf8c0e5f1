"""What makes a reading, or the field that it was taken in, one not to act on: each rule a pure function.

A rule returns OK, or in a few words what is wrong, with the value and the limit. A bad reading is reported, never
repaired.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median

from flexneedle.rig.tracking.table import TIP
from flexneedle.types import (
    OK,
    VISIBLE,
    Frame,
    Measurement,
    SensorReading,
    Verdict,
    VerdictKind,
    is_reference,
)

Place = tuple[float, ...]


def first_bad(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the first verdict that is not OK, or OK; the rest of a generator is not looked at."""
    return next((verdict for verdict in verdicts if not verdict.ok), OK)


def missing(sample: Measurement) -> Verdict:
    """A reading in which the tracker does not see the tip; says why if the tracker does."""
    if sample.x is not None and sample.y is not None:
        return OK
    told = None if sample.frame is None else sample.frame.readings.get(TIP)
    if told is None:
        return Verdict(VerdictKind.MISSING, "tracker sees no tip")
    why = told.status if told.status != VISIBLE else "no place" if told.position is None else "no orientation"
    return Verdict(VerdictKind.MISSING, f"tracker sees no tip ({why})")


def not_a_number(sample: Measurement) -> Verdict:
    """Time or place is not finite."""
    values = (sample.time, sample.x, sample.y, sample.z)
    finite = all(math.isfinite(value) for value in values if value is not None)
    return OK if finite else Verdict(VerdictKind.NOT_A_NUMBER)


def stale(time: float, now: float, limit: float) -> Verdict:
    """A reading older than `limit`, or dated so far ahead (s)."""
    if now - time > limit:
        return Verdict(VerdictKind.STALE, f"{now - time:.3f} s old, limit {limit:g} s")
    if time > now + limit:
        return Verdict(VerdictKind.STALE, f"dated {time - now:.3f} s ahead")
    return OK


def repeated(frame: Frame | None, before: Frame | None) -> Verdict:
    """A frame that was told before, or one that comes after a later one, whatever its time stamp says."""
    if frame is None or before is None or frame.number > before.number:
        return OK
    return Verdict(VerdictKind.STALE, f"frame {frame.number} after frame {before.number}")


def innovation(place: tuple[float, float], predicted: tuple[float, float], limit: float) -> Verdict:
    """A tip further from the model's than `limit` (mm)."""
    distance = math.hypot(place[0] - predicted[0], place[1] - predicted[1])
    if distance <= limit:
        return OK
    return Verdict(VerdictKind.INNOVATION, f"{distance:.2f} mm, limit {limit:g} mm")


def out_of_plane(z: float | None, limit: float) -> Verdict:
    """A tip further than `limit` (mm) from the plane of the insertion; OK where the tracker does not know."""
    if z is None or abs(z) <= limit:
        return OK
    return Verdict(VerdictKind.OUT_OF_PLANE, f"{z:.2f} mm, limit {limit:g} mm")


def jump(sample: Measurement, before: Measurement | None, speed: float, margin: float) -> Verdict:
    """A tip that moved faster than `speed` (mm/s) since the last good reading, with `margin` (mm) for noise."""
    if before is None:
        return OK
    moved = math.dist(*_shared(sample, before))
    limit = speed * abs(sample.time - before.time) + margin
    if moved <= limit:
        return OK
    return Verdict(VerdictKind.JUMP, f"{moved:.2f} mm, limit {limit:.2f} mm")


def frozen(count: int, travel: float, travel_limit: float) -> Verdict:
    """`count` identical readings while the predicted tip travelled by `travel`, more than `travel_limit` (mm)."""
    if travel <= travel_limit:
        return OK
    reason = f"the same in {count} readings while the tip should have moved {travel:.2f} mm"
    return Verdict(VerdictKind.FROZEN, reason)


def tells_indicator(reading: SensorReading) -> bool:
    """Whether a reference sensor is seen and its indicator a number that one can be; a code such as −1 is none."""
    indicator = reading.indicator
    seen = reading.status == VISIBLE and reading.position is not None
    return seen and indicator is not None and 0.0 <= indicator < math.inf


def too_short(span: float, least: float, needed: int) -> Verdict:
    """Reference sensors, if any are `needed`, were looked at for less than `least` (s)."""
    if needed == 0 or span >= least - 1e-9:
        return OK
    return Verdict(VerdictKind.FIELD_UNKNOWN, f"observed for {span:.2f} s, {least:g} s needed")


def unseen_references(
    indicators: Mapping[str, Sequence[float]], needed: int, window: float, newest: Mapping[str, SensorReading]
) -> Verdict:
    """Fewer than `needed` reference sensors told an indicator within the window (s).

    newest: what the tracker last said of its sensors, by name; it may say what ails them. No other sensor stands in
    for a reference, such as a second one in the needle.
    """
    told = sum(bool(values) and is_reference(name) for name, values in indicators.items())
    if told >= needed:
        return OK
    others = [name for name in newest if name != TIP]
    ill = [f"{name}: {newest[name].status}" for name in others if newest[name].status != VISIBLE]
    nameless = [name for name in others if not is_reference(name)]
    why = [*ill, *([f"no reference by its name: {', '.join(nameless)}"] if nameless else [])]
    detail = f" ({', '.join(why)})" if why else ""
    seen = f"{told} of {needed} reference sensors seen within {window:g} s{detail}"
    return Verdict(VerdictKind.FIELD_UNKNOWN, seen)


def distortion(
    indicators: Mapping[str, Sequence[float]], limit: float, window: float, held: bool = False
) -> Verdict:
    """The median indicator of a sensor over the window (s) is above the limit; names the worst one.

    held: whether it was above before, so that the limit is the lower one, for going on.
    """
    name, value = _worst(indicators)
    if value <= limit:
        return OK
    rule = "to fall below" if held else "limit"
    reason = f"{name} {value:.4f}, {rule} {limit:.4f} (median over {window:g} s)"
    return Verdict(VerdictKind.FIELD_DISTORTED, reason)


def doubtful(indicators: Mapping[str, Sequence[float]], limit: float, window: float) -> Verdict:
    """The same over a window (s) too short to hold the needle for: what is measured now is better not learnt from."""
    name, value = _worst(indicators)
    if value <= limit:
        return OK
    reason = f"{name} {value:.4f}, limit {limit:.4f} (median over {window:g} s)"
    return Verdict(VerdictKind.FIELD_IN_DOUBT, reason)


def _worst(indicators: Mapping[str, Sequence[float]]) -> tuple[str, float]:
    """Sensor with the largest median indicator, and that; 0 if none told any."""
    medians = {name: median(values) for name, values in indicators.items() if values}
    return max(medians.items(), key=lambda item: item[1], default=("", 0.0))


def _shared(one: Measurement, other: Measurement) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Places of two readings in the coordinates that both know."""
    pairs = ((one.x, other.x), (one.y, other.y), (one.z, other.z))
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    return tuple(a for a, _ in known), tuple(b for _, b in known)
