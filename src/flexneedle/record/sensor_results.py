"""Results of the sensors along the needle over an insertion: readings, innovations, exclusion, and the tip's sd."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from flexneedle.results import Insertion, Period, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.types import Point, SensorState, VerdictKind


@dataclass(frozen=True)
class SensorResult:
    """A sensor over an insertion.

    readings: all; missing: readings without a value; rejected: share of the others that was rejected; mean_nis,
    median_nis: of its innovations while it was used, NaN without any; excluded: the last verdict, "" if it was used to
    the end, and the depth of the tip (mm) at that time, NaN if it was used; silent_mm: depth of the tip (mm) since
    which it had no good reading, NaN if the last one is not stale.
    """

    name: str
    readings: int
    missing: int
    rejected: float
    mean_nis: float
    median_nis: float
    excluded: str
    excluded_mm: float
    silent_mm: float

    @property
    def summary(self) -> str:
        """Number of readings with a value, share of them that was rejected, and innovation."""
        values = f"{self.readings - self.missing} readings, {100.0 * self.rejected:.2g} % rejected"
        return values if math.isnan(self.mean_nis) else f"{values}, mean NIS {self.mean_nis:.2f}"


def sensor_results(insertion: Insertion) -> list[SensorResult]:
    """Return the results of the sensors along the needle; none without them."""
    names = dict.fromkeys(state.name for period in insertion.periods for state in period.sensors)
    return [_result(insertion, name) for name in names]


def tip_sds(insertion: Insertion) -> tuple[float, ...] | None:
    """Return the standard deviations x, y, z (mm) of the last estimated tip; None if unknown."""
    covariance = insertion.periods[-1].tip_covariance if insertion.periods else None
    return None if covariance is None else tuple(math.sqrt(covariance[k][k]) for k in range(3))


def sensor_values(insertion: Insertion) -> dict[str, Any]:
    """Return the keys that sensors along the needle add to a result; none without them."""
    results, sds = sensor_results(insertion), tip_sds(insertion)
    known = {} if sds is None else {"tip_sd_mm": list(sds)}
    return known | ({"sensors": [asdict(one) for one in results]} if results else {})


def sensor_columns(names: Iterable[str]) -> dict[str, type]:
    """Return the columns in the table of a study of sensors with these names: types by column."""
    kinds = {"nis": float, "excluded": str, "excluded_mm": float}
    return {f"sensor_{name}_{key}": kind for name in names for key, kind in kinds.items()}


def sensor_row(insertion: Insertion) -> dict[str, Any]:
    """Return the values of `sensor_columns`: median NIS, kind of the verdict of an exclusion, and its depth (mm)."""
    row: dict[str, Any] = {}
    for one in sensor_results(insertion):
        values = one.median_nis, one.excluded.partition(":")[0], one.excluded_mm
        row |= zip(sensor_columns([one.name]), values, strict=True)
    return row


def page_sensors(period: Period, plan: Plan) -> list[dict[str, Any]]:
    """Return name, verdict, NIS and good points x, y, z (mm) of each sensor along the needle in a period."""
    return [
        {"name": state.name, "verdict": str(state.verdict), "nis": state.nis, "points": _points(state, plan)}
        for state in period.sensors
    ]


def _points(state: SensorState, plan: Plan) -> list[Point]:
    """Return the points (mm) that a sensor measured, none of a sensor that measures no positions."""
    scenario = plan.scenario
    kinds = [] if scenario is None else [one for one in scenario.sensor if one.title == state.name]
    if scenario is None or not any(isinstance(one, Slice | Points) for one in kinds):
        return []
    rows = (row for one in state.good for row in one.rows)
    known = (row for row in rows if all(map(math.isfinite, row[: 1 + scenario.setup.axes])))
    return [(x, y, z if math.isfinite(z) else 0.0) for x, y, z in known]


def _result(insertion: Insertion, name: str) -> SensorResult:
    every = ((period, state) for period in insertion.periods for state in period.sensors)
    steps = [(period, state) for period, state in every if state.name == name]
    verdicts = [one.verdict for _, state in steps for one in state.readings]
    missing = sum(verdict.kind is VerdictKind.MISSING for verdict in verdicts)
    valid = len(verdicts) - missing
    good = sum(verdict.ok for verdict in verdicts)
    used = [state.nis for _, state in steps if state.verdict.ok and not math.isnan(state.nis)]
    last, since = steps[-1][1].verdict, _excluded_mm(steps)
    rejected, nis = 1.0 - good / valid if valid else 0.0, sum(used) / len(used) if used else math.nan
    middle = median(used) if used else math.nan
    excluded = "" if last.ok else str(last)
    silent = _silent_mm(insertion.scenario, name, steps)
    return SensorResult(name, len(verdicts), missing, rejected, nis, middle, excluded, since, silent)


def _excluded_mm(steps: list[tuple[Period, SensorState]]) -> float:
    """Return the depth of the tip (mm) from which a sensor is excluded to the end; NaN if it is used."""
    since = math.nan
    for period, state in steps:
        since = math.nan if state.verdict.ok else period.estimate.x if math.isnan(since) else since
    return since


def _silent_mm(scenario: Scenario | None, name: str, steps: list[tuple[Period, SensorState]]) -> float:
    """Return the depth of the tip (mm) since which a sensor has no good reading; NaN if its last one is not stale.

    Images in which the needle was never seen are not silent.
    """
    sensor = next((one for one in scenario.sensor if one.title == name), None) if scenario else None
    if scenario is None or sensor is None:
        return math.nan
    good = [[one.reading.time for one in state.readings if one.verdict.ok] for _, state in steps]
    limit = scenario.control.stale_after_s + sensor.longest_wait
    if type(sensor).sees is not Sensor.sees and not any(good):
        return math.nan
    return _silent([period for period, _ in steps], good, limit)


def tracker_silent_mm(insertion: Insertion) -> float:
    """Return the depth of the tip (mm) since which the tracker has no good reading; NaN if the last is not stale."""
    scenario = insertion.scenario
    if scenario is None or not scenario.tracker.enabled or not insertion.periods:
        return math.nan
    good = [[one.measurement.time for one in each.readings if one.verdict.ok] for each in insertion.periods]
    return _silent(insertion.periods, good, scenario.control.stale_after_s)


def _silent(periods: Sequence[Period], good: Sequence[Sequence[float]], limit: float) -> float:
    """Return the depth (mm) at the last good readings, with their times (s) by period; NaN if within `limit` (s)."""
    heard = [(period.estimate.x, times[-1]) for period, times in zip(periods, good, strict=True) if times]
    depth, last = heard[-1] if heard else (periods[0].estimate.x, -math.inf)
    return depth if periods[-1].time - last > limit else math.nan
