"""What makes a reading, or the field that it was taken in, one not to act on: each rule a pure function.

A rule returns OK, or in a few words what is wrong, with the value and the limit. A bad reading is reported, never
repaired.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median

from flexneedle.rig.tracking.table import TIP
from flexneedle.types import VISIBLE, Frame, Measurement, SensorReading, is_reference

Place = tuple[float, ...]


OK = "ok"
MISSING = "missing"
"""How a verdict begins that there is no tip to judge."""
DISTORTED = "field distorted"
"""How a verdict begins that a reference sensor's indicator is above the limit."""


def first_bad(verdicts: Iterable[str]) -> str:
    """Return the first verdict that is not OK, or OK; the rest of a generator is not looked at."""
    return next((verdict for verdict in verdicts if verdict != OK), OK)


def missing(sample: Measurement) -> str:
    """A reading in which the tracker does not see the tip; says why if the tracker does."""
    if sample.x is not None and sample.y is not None:
        return OK
    told = None if sample.frame is None else sample.frame.readings.get(TIP)
    if told is None:
        return f"{MISSING}: tracker sees no tip"
    why = told.status if told.status != VISIBLE else "no place" if told.position is None else "no orientation"
    return f"{MISSING}: tracker sees no tip ({why})"


def not_a_number(sample: Measurement) -> str:
    """Time or place is not finite."""
    values = (sample.time, sample.x, sample.y, sample.z)
    return OK if all(math.isfinite(value) for value in values if value is not None) else "not a number"


def stale(time: float, now: float, limit: float) -> str:
    """A reading older than `limit`, or dated so far ahead (s)."""
    if now - time > limit:
        return f"stale: {now - time:.3f} s old, limit {limit:g} s"
    if time > now + limit:
        return f"stale: dated {time - now:.3f} s ahead"
    return OK


def repeated(frame: Frame | None, before: Frame | None) -> str:
    """A frame that was told before, or one that comes after a later one, whatever its time stamp says."""
    if frame is None or before is None or frame.number > before.number:
        return OK
    return f"stale: frame {frame.number} after frame {before.number}"


def innovation(place: tuple[float, float], predicted: tuple[float, float], limit: float) -> str:
    """A tip further from the model's than `limit` (mm)."""
    distance = math.hypot(place[0] - predicted[0], place[1] - predicted[1])
    return OK if distance <= limit else f"innovation {distance:.2f} mm, limit {limit:g} mm"


def out_of_plane(z: float | None, limit: float) -> str:
    """A tip further than `limit` (mm) from the plane of the insertion; OK where the tracker does not know."""
    return OK if z is None or abs(z) <= limit else f"out of plane: {z:.2f} mm, limit {limit:g} mm"


def jump(sample: Measurement, before: Measurement | None, speed: float, margin: float) -> str:
    """A tip that moved faster than `speed` (mm/s) since the last good reading, with `margin` (mm) for noise."""
    if before is None:
        return OK
    moved = math.dist(*_shared(sample, before))
    limit = speed * abs(sample.time - before.time) + margin
    return OK if moved <= limit else f"jump of {moved:.2f} mm, limit {limit:.2f} mm"


def frozen(count: int, first: tuple[float, float], now: tuple[float, float], travel_limit: float) -> str:
    """A reading the same to the last digit, `count` times, while the model's tip travelled over `travel_limit` (mm).

    first, now: the model's tip (mm) at the first of these readings and at the newest.
    """
    travel = math.dist(first, now)
    if travel <= travel_limit:
        return OK
    return f"frozen: the same in {count} readings while the tip should have moved {travel:.2f} mm"


def tells_indicator(reading: SensorReading) -> bool:
    """Whether a reference sensor is seen and its indicator a number that one can be; a code such as −1 is none."""
    indicator = reading.indicator
    seen = reading.status == VISIBLE and reading.position is not None
    return seen and indicator is not None and 0.0 <= indicator < math.inf


def too_short(span: float, least: float, needed: int) -> str:
    """Reference sensors, if any are `needed`, were looked at for less than `least` (s)."""
    if needed == 0 or span >= least - 1e-9:
        return OK
    return f"field not known: looked at for {span:.2f} s, {least:g} s needed"


def unseen_references(
    indicators: Mapping[str, Sequence[float]], needed: int, window: float, newest: Mapping[str, SensorReading]
) -> str:
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
    return f"field not known: {told} of {needed} reference sensors seen within {window:g} s" + (
        f" ({', '.join(why)})" if why else ""
    )


def distortion(
    indicators: Mapping[str, Sequence[float]], limit: float, window: float, held: bool = False
) -> str:
    """The median indicator of a sensor over the window (s) is above the limit; names the worst one.

    held: whether it was above before, so that the limit is the lower one, for going on.
    """
    name, value = _worst(indicators)
    if value <= limit:
        return OK
    rule = "to fall below" if held else "limit"
    return f"{DISTORTED}: {name} {value:.4f}, {rule} {limit:.4f} (median over {window:g} s)"


def doubtful(indicators: Mapping[str, Sequence[float]], limit: float, window: float) -> str:
    """The same over a window (s) too short to hold the needle for: what is measured now is better not learnt from."""
    name, value = _worst(indicators)
    if value <= limit:
        return OK
    return f"field in doubt: {name} {value:.4f}, limit {limit:.4f} (median over {window:g} s)"


def _worst(indicators: Mapping[str, Sequence[float]]) -> tuple[str, float]:
    """Sensor with the largest median indicator, and that; 0 if none told any."""
    medians = {name: median(values) for name, values in indicators.items() if values}
    return max(medians.items(), key=lambda item: item[1], default=("", 0.0))


def _shared(one: Measurement, other: Measurement) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Places of two readings in the coordinates that both know."""
    pairs = ((one.x, other.x), (one.y, other.y), (one.z, other.z))
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    return tuple(a for a, _ in known), tuple(b for _, b in known)
