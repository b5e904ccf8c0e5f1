"""Messages of a ROS node, made from the records of a rig: those of a trace, in the frames and units of a profile."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import pi
from typing import Any, NamedTuple

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros
from scipy.interpolate import CubicHermiteSpline

from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.markers import Scene, markers, scene_of
from flexneedle.lab.ros.profile import PlacedTopic, Profile, ShapeTopic
from flexneedle.lab.ros.records import JointTargets, RigState, Target
from flexneedle.record.messages import (
    Check,
    DiagnosticArray,
    Header,
    JointState,
    Path,
    PointMessage,
    PoseMessage,
    PoseStamped,
    Time,
    diagnostics,
    joints,
    nanoseconds,
    path,
    pose,
    statuses,
)
from flexneedle.record.topics import READINGS, STATUS, TIMING, plan_message, status_messages
from flexneedle.types import Floats, Measurement, Period, Plan, Pose, X, Z

PoseArray = ros.geometry_msgs__msg__PoseArray
PoseWithCovariance = ros.geometry_msgs__msg__PoseWithCovariance
PoseWithCovarianceStamped = ros.geometry_msgs__msg__PoseWithCovarianceStamped
PointStamped = ros.geometry_msgs__msg__PointStamped
String = ros.std_msgs__msg__String

UNKNOWN_TURN = pi**2 / 3
"""Variance (rad²) of an angle of which nothing is known: even from −π to π."""

_AXIS_TURN = np.array(
    [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
)  # rotation by the slopes θ (about z) and ψ (about −y)


class Outgoing(NamedTuple):
    """A message and the key of `publish` that it is for."""

    key: str
    message: Any


@dataclass
class Composer:
    """Makes messages of records. It remembers the scene: layers and target.

    epoch: Unix time (s) of the records' time 0; 0 leaves their own times.
    """

    profile: Profile
    epoch: float = 0.0
    scene: Scene = field(default_factory=Scene)
    _frames: dict[str, FrameMap] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        placed = self.profile.topics()
        self._frames = {
            key.removeprefix("publish."): FrameMap.of(self.profile, topic)
            for key, topic in placed
            if isinstance(topic, PlacedTopic) and key.startswith("publish.")
        }

    def messages(self, record: object) -> Iterator[Outgoing]:
        """Yield the messages of a record; none for a record of another kind."""
        for key, build in _BUILDERS.get(type(record), {}).items():
            if (
                getattr(self.profile.publish, key) is not None
                and (message := build(self, record)) is not None
            ):
                yield Outgoing(key, message)

    def frame(self, key: str) -> FrameMap:
        """The map of a topic with positions."""
        return self._frames[key]

    def header(self, key: str, time: float) -> Header:
        """Header of a message at a time of the records (s)."""
        frame = self._frames.get(key)
        return Header(self.stamp(time), frame.id if frame else "")

    def stamp(self, time: float) -> Time:
        """Time stamp of a time of the records (s)."""
        seconds, rest = divmod(nanoseconds(time + self.epoch), 1_000_000_000)
        return Time(seconds, rest)


# Poses along the needle


def _shape(composer: Composer, period: Period) -> PoseArray:
    return _array(composer, "shape", period.time, period.shape)


def _predicted(composer: Composer, period: Period) -> PoseArray | None:
    if period.predicted is None:
        return None
    return _array(composer, "predicted_shape", period.time, period.predicted.nodes)


def _array(composer: Composer, key: str, time: float, nodes: Floats) -> PoseArray:
    topic: ShapeTopic = getattr(composer.profile.publish, key)
    rows = nodes if topic.spacing_mm is None else spaced(nodes, topic.spacing_mm)
    poses = [stamped.pose for stamped in path(time, rows).poses]
    return PoseArray(composer.header(key, time), composer.frame(key).poses(poses))


def spaced(nodes: Floats, spacing: float) -> Floats:
    """Poses (m, 5) at equal distances (mm) along the needle of `nodes` (n, 5), counted from the tip, the last pose.

    Positions by cubic pieces along the axes of the nodes, slopes linearly between them.
    """
    steps = np.linalg.norm(np.diff(nodes[:, X : Z + 1], axis=0), axis=1)
    arcs = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = arcs[-1] - spacing * np.arange(int(arcs[-1] / spacing + 1e-9), -1, -1.0)
    axes = np.array([Pose.of(row).axis for row in nodes])
    positions = CubicHermiteSpline(arcs, nodes[:, X : Z + 1], axes)(wanted)
    slopes = [np.interp(wanted, arcs, column) for column in nodes[:, Z + 1 :].T]
    return np.column_stack([positions, *slopes])


def length_of(nodes: Floats) -> float:
    """Length (mm) of a needle from its nodes (n, 5)."""
    return float(np.linalg.norm(np.diff(nodes[:, X : Z + 1], axis=0), axis=1).sum())


# The tip


def _tip(composer: Composer, period: Period) -> PoseStamped:
    return _pose_stamped(composer, "tip", pose(period.time, period.estimate).pose, period.time)


def _measured(composer: Composer, period: Period) -> PoseWithCovarianceStamped | None:
    found = period.measurement
    if found.covariance is None or found.x is None or found.y is None or not period.verdict.ok:
        return None
    frame, (theta, psi) = composer.frame("measured_tip"), found.direction or (0.0, 0.0)
    placed = frame.pose(pose(found.time, Pose(found.x, found.y, found.z or 0.0, theta, psi)).pose)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = frame.covariance(1e-6 * np.array(found.covariance))
    matrix[3:, 3:] = frame.turns(_turn_covariance(found))
    message = PoseWithCovariance(placed, matrix.ravel())
    return PoseWithCovarianceStamped(composer.header("measured_tip", found.time), message)


def _turn_covariance(found: Measurement) -> Floats:
    """Covariance (3, 3), rad², of rotations about x, y, z: of the direction where it is known."""
    if found.direction is None or found.direction_covariance is None:
        return UNKNOWN_TURN * np.eye(3)
    known: Floats = _AXIS_TURN.T @ np.array(found.direction_covariance) @ _AXIS_TURN
    known[0, 0] = UNKNOWN_TURN
    return known


def _pose_stamped(composer: Composer, key: str, at: PoseMessage, time: float) -> PoseStamped:
    return PoseStamped(composer.header(key, time), composer.frame(key).pose(at))


# Path, scene and skin


def _path(composer: Composer, plan: Plan) -> Path:
    message: Any = plan_message(plan.tips).message
    header = composer.header("plan", 0.0)
    poses = composer.frame("plan").poses([stamped.pose for stamped in message.poses])
    return Path(header, [PoseStamped(header, one) for one in poses])


def _scene(composer: Composer, record: Plan | Target) -> Any:
    composer.scene = (
        replace(composer.scene, target=record.point) if isinstance(record, Target) else scene_of(record)
    )
    time = record.time if isinstance(record, Target) else 0.0
    return markers(composer.header("markers", time), composer.frame("markers"), composer.scene)


def _skin_entry(composer: Composer, _plan: Plan) -> PointMessage:
    return composer.frame("skin_entry").point(PointMessage(0.0, 0.0, 0.0))


# The motors


def _needle_pose(composer: Composer, period: Period) -> PoseStamped:
    base = period.base._replace(x=period.base.x + length_of(period.shape))
    at = pose(period.time, base).pose
    return _pose_stamped(composer, "needle_pose", rolled(at, period.roll), period.time)


def rolled(at: PoseMessage, roll: float) -> PoseMessage:
    """The pose, first turned by `roll` (rad) about its own x axis."""
    turn = at.orientation
    cosine, sine = np.cos(roll / 2), np.sin(roll / 2)
    mixed = (
        turn.w * sine + turn.x * cosine,
        turn.y * cosine + turn.z * sine,
        turn.z * cosine - turn.y * sine,
        turn.w * cosine - turn.x * sine,
    )
    return PoseMessage(at.position, type(turn)(*map(float, mixed)))


def _guide_pose(composer: Composer, period: Period) -> PointStamped:
    x = period.base.x + length_of(period.shape)
    at = PointMessage(*(1e-3 * float(value) for value in (x, *period.guide)))
    return PointStamped(composer.header("guide_pose", period.time), composer.frame("guide_pose").point(at))


def _joints(composer: Composer, period: Period) -> JointState:
    found = joints(period.time, (*period.base, *period.guide, period.roll))
    return replace(found, header=composer.header("joint_states", period.time))


def _targets(composer: Composer, record: JointTargets) -> JointState:
    names, positions = list(record.positions), np.array(list(record.positions.values()), dtype=float)
    header = composer.header("joint_targets", record.time)
    return JointState(header, names, positions, np.empty(0), np.empty(0))


# State


def _state(_composer: Composer, record: RigState) -> String:
    return String(record.state)


def _rig_diagnostics(composer: Composer, record: RigState) -> DiagnosticArray:
    check = Check(
        f"{record.state}: {record.reason}" if record.reason else record.state, record.good, record.values
    )
    return replace(
        statuses(record.time, "flexneedle: rig", [check]), header=composer.header("diagnostics", record.time)
    )


def _period_diagnostics(composer: Composer, period: Period) -> DiagnosticArray:
    found: dict[str, Any] = dict(status_messages(period))
    every = [status for topic in (STATUS, READINGS, TIMING) for status in found[topic].status]
    named = [replace(status, name=f"flexneedle: {status.name}") for status in every]
    return replace(
        diagnostics(period.time, "", {}), header=composer.header("diagnostics", period.time), status=named
    )


_BUILDERS: dict[type, dict[str, Callable[[Composer, Any], Any]]] = {
    Plan: {"plan": _path, "markers": _scene, "skin_entry": _skin_entry},
    Period: {
        "shape": _shape,
        "predicted_shape": _predicted,
        "tip": _tip,
        "measured_tip": _measured,
        "needle_pose": _needle_pose,
        "guide_pose": _guide_pose,
        "joint_states": _joints,
        "diagnostics": _period_diagnostics,
    },
    Target: {"markers": _scene},
    RigState: {"state": _state, "diagnostics": _rig_diagnostics},
    JointTargets: {"joint_targets": _targets},
}


def kinds() -> Iterable[type]:
    """Types of the records of which messages are made."""
    return _BUILDERS
