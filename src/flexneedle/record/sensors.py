"""Conversion of the sensors along the needle, after a period, to named statuses and back, exact.

`/sensors/status` has a status of the tip, with its covariance, and one for each sensor;
`/sensors/readings` has one for each reading, with the name of its sensor.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from flexneedle.record.fields import parse_verdict
from flexneedle.record.messages import Check, DiagnosticArray, DiagnosticStatus
from flexneedle.record.readings import matrix_text, parse_matrix
from flexneedle.results import Period
from flexneedle.types import TIP, CheckedReading, Matrix, Reading, SensorState

_COVARIANCE = "covariance_mm2"


class SensorRecord(NamedTuple):
    """Fields of a period that only sensors along the needle fill."""

    sensors: tuple[SensorState, ...] = ()
    tip_covariance: Matrix | None = None


def has_sensors(period: Period) -> bool:
    """Return True if a period has sensors along the needle, or a covariance of the tip."""
    return bool(period.sensors) or period.tip_covariance is not None


def state_checks(period: Period) -> Iterator[tuple[str, Check]]:
    """Yield name and check of the tip, then of each sensor."""
    covariance = period.tip_covariance
    known = {} if covariance is None else {_COVARIANCE: matrix_text(covariance)}
    yield TIP, Check("", good=True, values=known)
    for one in period.sensors:
        yield one.name, Check(str(one.verdict), one.verdict.ok, {"nis": repr(float(one.nis))})


def reading_checks(period: Period) -> Iterator[tuple[str, Check]]:
    """Yield the name of the sensor and the check of each reading."""
    for state in period.sensors:
        for one in state.readings:
            yield state.name, Check(str(one.verdict), one.verdict.ok, reading_values(one.reading))


def reading_values(reading: Reading) -> dict[str, str]:
    """Return a reading as text by key; no rows, no key."""
    values = {"time_s": repr(float(reading.time)), "status": reading.status}
    return values | ({"rows": matrix_text(reading.rows)} if reading.rows else {})


def restore(states: DiagnosticArray, readings: Sequence[DiagnosticStatus]) -> SensorRecord:
    """Return the fields of the statuses of both topics; raises KeyError, ValueError or InputError for others."""
    tip, *others = states.status
    covariance = _pairs(tip).get(_COVARIANCE)
    sensors = tuple(_state(one, readings) for one in others)
    return SensorRecord(sensors, None if covariance is None else parse_matrix(covariance))


def _state(status: DiagnosticStatus, readings: Sequence[DiagnosticStatus]) -> SensorState:
    own = tuple(_reading(each) for each in readings if each.name == status.name)
    return SensorState(status.name, own, parse_verdict(status.message), float(_pairs(status)["nis"]))


def _reading(status: DiagnosticStatus) -> CheckedReading:
    values = _pairs(status)
    rows = parse_matrix(values["rows"]) if "rows" in values else ()
    reading = Reading(float(values["time_s"]), rows, values["status"])
    return CheckedReading(reading, parse_verdict(status.message))


def _pairs(status: DiagnosticStatus) -> Mapping[str, str]:
    return {pair.key: pair.value for pair in status.values}
