"""Topics of a run with their message types, and the messages of a plan and of a period."""

from collections.abc import Iterator
from dataclasses import dataclass

from flexneedle.record.fields import FIELDS, TIP_COVARIANCE, to_row
from flexneedle.record.messages import (
    Check,
    Message,
    diagnostics,
    named_statuses,
    nanoseconds,
    path,
    statuses,
)
from flexneedle.record.readings import to_values
from flexneedle.record.sensors import has_sensors, reading_checks, state_checks
from flexneedle.results import Period
from flexneedle.types import Floats

PLAN, STATUS, TIMING, READINGS = "/plan/path", "/control/status", "/timing", "/tracker/readings"
SENSORS, SENSOR_READINGS = "/sensors/status", "/sensors/readings"
_STATUS = "diagnostic_msgs/msg/DiagnosticArray"
_OF_FIELDS = [topic for field in FIELDS.values() for topic in field.topics]

TOPICS: dict[str, str] = {
    PLAN: "nav_msgs/msg/Path",  # planned poses of the tip, once at the start
    **{topic.name: topic.kind for topic in _OF_FIELDS},
    READINGS: _STATUS,  # a status for each reading of the period: the reported values and the verdict
    SENSORS: _STATUS,  # the covariance of the tip, and a status for each sensor along the needle
    SENSOR_READINGS: _STATUS,  # a status for each reading of the sensors along the needle
    TIMING: _STATUS,  # wall-clock durations of the period, s
    STATUS: _STATUS,  # all scalars of the period, exact, in the columns of the CSV; last message of the period
}
"""Message type by topic. Units are SI, poses are in the frame `skin`."""

OPTIONAL = (TIP_COVARIANCE, SENSORS, SENSOR_READINGS)
"""Topics of runs with sensors along the needle only."""
LATCHED = (PLAN,)
"""Topics with a single message that is also delivered to later subscribers."""


@dataclass(frozen=True)
class TopicMessage:
    """A message with its topic and time (ns since the start of the run)."""

    topic: str
    time: int
    message: Message


def plan_message(tips: Floats) -> TopicMessage:
    """Return the message of the planned tip poses (m + 1, 5) at time 0."""
    return TopicMessage(PLAN, 0, path(0.0, tips))


def period_messages(period: Period) -> Iterator[TopicMessage]:
    """Yield the messages of a period; `/control/status` is the last."""
    now = nanoseconds(period.time)
    for topic in _OF_FIELDS:
        if (message := topic.message(period)) is not None:
            yield TopicMessage(topic.name, now, message)
    for name, status in status_messages(period):
        yield TopicMessage(name, now, status)


def status_messages(period: Period) -> Iterator[tuple[str, Message]]:
    """Yield readings, sensors along the needle, durations and all scalars of a period, each with its topic."""
    checks = [Check(str(one.verdict), one.verdict.ok, to_values(one)) for one in period.readings]
    yield READINGS, statuses(period.time, "reading", checks)
    if has_sensors(period):
        yield SENSOR_READINGS, named_statuses(period.time, reading_checks(period))
        yield SENSORS, named_statuses(period.time, state_checks(period))
    durations = {f"{name}_s": repr(float(seconds)) for name, seconds in period.durations.items()}
    yield TIMING, diagnostics(period.time, "timing", durations)
    good = period.verdict.ok
    yield STATUS, diagnostics(period.time, "control", to_row(period), text=period.decision, good=good)
