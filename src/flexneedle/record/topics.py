"""Topics of a run with their message types, and the messages of a plan and of a period."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot, isfinite

from flexneedle.record.columns import to_row
from flexneedle.record.messages import (
    Check,
    Message,
    diagnostics,
    joints,
    nanoseconds,
    number,
    path,
    points,
    pose,
    statuses,
    table,
    vector,
)
from flexneedle.record.readings import to_values
from flexneedle.types import ROLL, Control, Floats, Period, Pose

PLAN, SHAPE, STATUS, TIMING = "/plan/path", "/needle/shape", "/control/status", "/timing"
PREDICTED, PREDICTED_SD = "/needle/predicted_shape", "/needle/predicted_sd"
TRUE_SHAPE = "/needle/true_shape"
READINGS = "/tracker/readings"

_POSE, _PATH, _JOINTS = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path", "sensor_msgs/msg/JointState"
_NUMBER, _STATUS = "std_msgs/msg/Float64", "diagnostic_msgs/msg/DiagnosticArray"

TOPICS: dict[str, str] = {
    PLAN: _PATH,  # planned poses of the tip, once at the start
    SHAPE: _PATH,  # estimated nodes of the needle
    PREDICTED: _PATH,  # its nodes at the target, as predicted
    PREDICTED_SD: "std_msgs/msg/Float64MultiArray",  # standard deviations of their y and z, m
    TRUE_SHAPE: _PATH,  # points along the needle of the virtual phantom; without angles
    "/tip/measured": _POSE,  # the tracker's reading at its time of measurement; without an angle
    "/tip/estimate": _POSE,
    "/tip/path": _POSE,  # planned pose at the estimated depth
    "/tip/true": _POSE,  # of the virtual phantom; not available to the controller
    "/command": _JOINTS,  # increments of the period; roll includes the spin
    "/command/applied": _JOINTS,  # the same as applied by the actuators
    "/joint_states": _JOINTS,  # positions of base and guide and the roll after it
    "/control/cost": _NUMBER,
    "/control/spread": _NUMBER,  # m
    "/control/tip_load": _NUMBER,  # N
    "/control/innovation": "geometry_msgs/msg/Vector3Stamped",  # m
    "/tissue/strain_energy": _NUMBER,  # J, of the estimate
    "/tissue/true_strain_energy": _NUMBER,  # J, of the virtual phantom
    READINGS: _STATUS,  # a status for each reading of the period: the reported values and the verdict
    TIMING: _STATUS,  # wall-clock durations of the period, s
    STATUS: _STATUS,  # all scalars of the period, exact, in the columns of the CSV; last message of the period
}
"""Message type by topic. Units are SI, poses are in the frame `skin`."""

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
    for topic, message in (*_tip(period), *_control(period), *_tissue(period), *_status(period)):
        yield TopicMessage(topic, now, message)


def _tip(period: Period) -> Iterator[tuple[str, Message]]:
    yield SHAPE, path(period.time, period.shape)
    if period.predicted is not None:
        yield PREDICTED, path(period.time, period.predicted.nodes)
        yield PREDICTED_SD, table(period.predicted.sd)
    if period.true_shape is not None:
        yield TRUE_SHAPE, points(period.time, period.true_shape)
    x, y = period.measurement.x, period.measurement.y
    if x is not None and y is not None and isfinite(x) and isfinite(y):
        yield (
            "/tip/measured",
            pose(period.measurement.time, Pose(x, y, period.measurement.z or 0.0, 0.0, 0.0)),
        )
    yield "/tip/estimate", pose(period.time, period.estimate)
    yield "/tip/path", pose(period.time, period.path)
    if period.true_tip is not None:
        yield "/tip/true", pose(period.time, period.true_tip)


def _control(period: Period) -> Iterator[tuple[str, Message]]:
    yield "/command", joints(period.time, _increments(period.command))
    yield "/command/applied", joints(period.time, _increments(period.applied))
    yield "/joint_states", joints(period.time, (*period.base, *period.guide, period.roll))
    yield "/control/cost", number(period.cost)
    yield "/control/spread", number(period.spread * 1e-3)
    yield "/control/tip_load", number(hypot(*period.tip_load))
    yield "/control/innovation", vector(period.time, period.innovation)


def _increments(command: Control) -> tuple[float, ...]:
    return *command[:ROLL], command.roll + command.spin


def _tissue(period: Period) -> Iterator[tuple[str, Message]]:
    yield "/tissue/strain_energy", number(period.strain_energy * 1e-3)
    if period.true_strain_energy is not None:
        yield "/tissue/true_strain_energy", number(period.true_strain_energy * 1e-3)


def _status(period: Period) -> Iterator[tuple[str, Message]]:
    checks = [Check(str(one.verdict), one.verdict.ok, to_values(one)) for one in period.readings]
    yield READINGS, statuses(period.time, "reading", checks)
    durations = {f"{name}_s": repr(float(seconds)) for name, seconds in period.durations.items()}
    yield TIMING, diagnostics(period.time, "timing", durations)
    good = period.verdict.ok
    yield STATUS, diagnostics(period.time, "control", to_row(period), text=period.decision, good=good)
