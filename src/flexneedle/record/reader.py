"""Reader of `trace.mcap`, also of an incomplete one."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from struct import error as StructError
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader

from flexneedle.errors import InputError
from flexneedle.record.fields import PREDICTED, PREDICTED_SD, SHAPE, TRUE_SHAPE, from_row, parse_verdict
from flexneedle.record.messages import (
    STORE,
    DiagnosticArray,
    DiagnosticStatus,
    Float64MultiArray,
    poses_of,
    values_of,
)
from flexneedle.record.messages import Path as PathMessage
from flexneedle.record.readings import from_values
from flexneedle.record.sensors import SensorRecord, restore
from flexneedle.record.topics import READINGS, SENSOR_READINGS, SENSORS, STATUS, TIMING, TOPICS
from flexneedle.results import Period
from flexneedle.types import CheckedMeasurement, Floats, Shape, Z

_READ = (
    *(SHAPE, PREDICTED, PREDICTED_SD, TRUE_SHAPE),
    *(READINGS, SENSOR_READINGS, SENSORS, TIMING, STATUS),
)


@dataclass(frozen=True, eq=False)
class Trace:
    """Contents of a trace. note: one line on a missing or damaged end, "" for a complete file."""

    periods: tuple[Period, ...]
    about: dict[str, str]
    scenario: dict[str, Any]
    note: str


def read_trace(path: Path) -> Trace:
    """Return the contents of a trace up to its last complete period.

    Raises InputError if the file cannot be read or is not a trace.
    """
    collector = _Collector()
    try:
        with path.open("rb") as file:
            note = _collect(file, collector)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if collector.about is None:
        raise InputError(f"{path}: not a trace of flexneedle{': ' + note if note else ''}")
    return Trace(tuple(collector.periods), collector.about, collector.scenario, note and f"{path}: {note}")


def _collect(file: Any, collector: "_Collector") -> str:
    """Add all complete records to the collector; return the reason why the rest cannot be read, or ""."""
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            collector.add(record)
    except (McapError, CRCValidationError, StructError, KeyError, ValueError, InputError) as error:
        return f"incomplete: {len(collector.periods)} complete periods read ({type(error).__name__})"
    return ""


class _Collector:
    """Assembles periods from the records of a file."""

    def __init__(self) -> None:
        self.periods: list[Period] = []
        self.about: dict[str, str] | None = None
        self.scenario: dict[str, Any] = {}
        self._topics: dict[int, str] = {}
        self._shape: Floats = np.empty((0, 5))
        self._nodes: Floats = np.empty((0, 5))
        self._predicted: Shape | None = None
        self._true_shape: Floats | None = None
        self._durations: dict[str, float] = {}
        self._readings: tuple[CheckedMeasurement, ...] = ()
        self._sensor_readings: list[DiagnosticStatus] = []
        self._sensors = SensorRecord()

    def add(self, record: McapRecord) -> None:
        """Add one record of the file."""
        if isinstance(record, Message):
            self._add_message(self._topics[record.channel_id], record.data)
        elif isinstance(record, Channel):
            self._topics[record.id] = record.topic
        elif isinstance(record, Metadata) and record.name == "flexneedle":
            self.about = dict(record.metadata)
        elif isinstance(record, Attachment) and record.name == "scenario.json":
            self.scenario = json.loads(record.data)

    def _add_message(self, topic: str, data: bytes) -> None:
        if topic not in _READ:
            return
        message = STORE.deserialize_cdr(data, TOPICS[topic])
        if isinstance(message, PathMessage) and topic == SHAPE:
            self._shape, self._predicted, self._true_shape = poses_of(message), None, None
            self._sensors = SensorRecord()
        elif isinstance(message, PathMessage) and topic == TRUE_SHAPE:
            self._true_shape = poses_of(message)[:, : Z + 1]
        elif isinstance(message, PathMessage):
            self._nodes = poses_of(message)
        elif isinstance(message, Float64MultiArray):
            self._predicted = Shape(self._nodes, values_of(message))
        elif isinstance(message, DiagnosticArray) and topic == TIMING:
            self._durations = {name[:-2]: float(value) for name, value in _pairs(message.status[0])}
        elif isinstance(message, DiagnosticArray) and topic == READINGS:
            self._readings = tuple(
                from_values(dict(_pairs(status)), parse_verdict(status.message)) for status in message.status
            )
        elif isinstance(message, DiagnosticArray) and topic == SENSOR_READINGS:
            self._sensor_readings = message.status
        elif isinstance(message, DiagnosticArray) and topic == SENSORS:
            self._sensors = restore(message, self._sensor_readings)
        elif isinstance(message, DiagnosticArray):
            row = dict(_pairs(message.status[0]))
            period = from_row(row, self._shape, self._durations, self._readings)
            more = {"predicted": self._predicted, "true_shape": self._true_shape, **self._sensors._asdict()}
            self.periods.append(replace(period, **more))


def _pairs(status: DiagnosticStatus) -> Iterator[tuple[str, str]]:
    return ((pair.key, pair.value) for pair in status.values)
