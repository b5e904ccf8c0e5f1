"""Messages of a ROS node, made from records: the messages of a trace in the frames and units of a profile."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from flexneedle.lab.link.records import LinkState, LinkTarget
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.markers import (
    MarkerScene,
    make_clearance_markers,
    make_markers,
    make_scene,
    make_zone_markers,
)
from flexneedle.lab.ros.profile import PlacedTopic, ShapeTopic, TopicProfile
from flexneedle.lab.ros.records import JointTargets, RosClearance, RosZones
from flexneedle.record.fields import FIELDS
from flexneedle.record.messages import (
    UNKNOWN_TURN,
    Check,
    DiagnosticArray,
    Header,
    JointState,
    Path,
    PointMessage,
    PoseMessage,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Time,
    nanoseconds,
    path,
    pose,
    statuses,
)
from flexneedle.record.topics import READINGS, SENSORS, STATUS, TIMING, plan_message, status_messages
from flexneedle.results import Period, Plan
from flexneedle.types import Floats, Matrix, Measurement, Pose, X, Z

PoseArray = ros.geometry_msgs__msg__PoseArray
PointStamped = ros.geometry_msgs__msg__PointStamped
String = ros.std_msgs__msg__String

_TRACED: dict[str, Callable[[Period], Any]] = {
    topic.name: topic.message for one in FIELDS.values() for topic in one.topics
}
_UNKNOWN_TURNS = UNKNOWN_TURN * np.eye(3)
_STATES = (STATUS, READINGS, SENSORS, TIMING)
# Rotation by the slopes θ (about z) and ψ (about −y).
_AXIS_TURN = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class OutgoingMessage(NamedTuple):
    """A message with its key of `publish`."""

    key: str
    message: Any


@dataclass
class MessageComposer:
    """Makes the messages of records, and keeps the scene: layers and target.

    epoch: Unix time (s) of the records' time 0; 0: stamps are the records' times.
    """

    profile: TopicProfile
    epoch: float = 0.0
    scene: MarkerScene = field(default_factory=MarkerScene)
    frames: dict[str, FrameMap] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.frames = {
            key.removeprefix("publish."): FrameMap.of(self.profile, topic)
            for key, topic in self.profile.list_topics()
            if isinstance(topic, PlacedTopic) and key.startswith("publish.")
        }

    def compose(self, record: object) -> Iterator[OutgoingMessage]:
        """Yield the messages of a record; none for a record of another kind."""
        for key, build in _BUILDERS.get(type(record), {}).items():
            listed = getattr(self.profile.publish, key) is not None
            if listed and (message := build(self, record)) is not None:
                yield OutgoingMessage(key, message)

    def make_header(self, key: str, time: float) -> Header:
        """Return the header of a message at a time of the records (s)."""
        seconds, rest = divmod(nanoseconds(time + self.epoch), 1_000_000_000)
        frame = self.frames.get(key)
        return Header(Time(seconds, rest), frame.id if frame else "")

    def make_pose(self, key: str, time: float, at: PoseMessage) -> PoseStamped:
        """Return the message of a pose on the needle."""
        return PoseStamped(self.make_header(key, time), self.frames[key].map_pose(at))


# Poses along the needle


def _make_shape(composer: MessageComposer, period: Period) -> PoseArray:
    return _make_poses(composer, "shape", period.time, period.shape)


def _make_predicted(composer: MessageComposer, period: Period) -> PoseArray | None:
    if period.predicted is None:
        return None
    return _make_poses(composer, "predicted_shape", period.time, period.predicted.nodes)


def _make_poses(composer: MessageComposer, key: str, time: float, nodes: Floats) -> PoseArray:
    topic: ShapeTopic = getattr(composer.profile.publish, key)
    rows = nodes if topic.spacing_mm is None else resample(nodes, topic.spacing_mm)
    poses = [stamped.pose for stamped in path(time, rows).poses]
    return PoseArray(composer.make_header(key, time), composer.frames[key].map_poses(poses))


def resample(nodes: Floats, spacing: float) -> Floats:
    """Return poses (m, 5) at equal distances (mm), counted from the tip, along the needle of `nodes` (n, 5).

    Positions are cubic pieces along the axes of the nodes, slopes linear between them.
    """
    steps = np.linalg.norm(np.diff(nodes[:, X : Z + 1], axis=0), axis=1)
    arcs = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = arcs[-1] - spacing * np.arange(int(arcs[-1] / spacing + 1e-9), -1, -1.0)
    axes = np.array([Pose.of(row).axis for row in nodes])
    positions = _interpolate_cubic(arcs, nodes[:, X : Z + 1], axes, wanted)
    slopes = [np.interp(wanted, arcs, column) for column in nodes[:, Z + 1 :].T]
    return np.column_stack([positions, *slopes])


def _interpolate_cubic(at: Floats, values: Floats, slopes: Floats, wanted: Floats) -> Floats:
    """Return Hermite cubics at `wanted`, as SciPy's spline, whose import takes half of the node's start."""
    piece = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, len(at) - 2)
    width = np.diff(at)[:, None]
    mean = np.diff(values, axis=0) / width
    bend = (slopes[:-1] + slopes[1:] - 2 * mean) / width
    square, cubic = (mean - slopes[:-1]) / width - bend, bend / width
    step = (wanted - at[piece])[:, None]
    found: Floats = values[piece] + step * (slopes[piece] + step * (square[piece] + step * cubic[piece]))
    return found


def measure_length(nodes: Floats) -> float:
    """Return the length (mm) of a needle from its nodes (n, 5)."""
    return float(np.linalg.norm(np.diff(nodes[:, X : Z + 1], axis=0), axis=1).sum())


# The tip


def _make_tip(composer: MessageComposer, period: Period) -> PoseStamped:
    return composer.make_pose("tip", period.time, _TRACED["/tip/estimate"](period).pose)


def _make_tip_covariance(composer: MessageComposer, period: Period) -> PoseWithCovarianceStamped | None:
    if period.tip_covariance is None:
        return None
    return _make_uncertain(composer, "tip_covariance", period.time, period.estimate, period.tip_covariance)


def _make_measured(composer: MessageComposer, period: Period) -> PoseWithCovarianceStamped | None:
    found = period.measurement
    if found.covariance is None or found.x is None or found.y is None or not period.verdict.ok:
        return None
    at = Pose(found.x, found.y, found.z or 0.0, *(found.direction or (0.0, 0.0)))
    turns = _make_turn_covariance(found)
    return _make_uncertain(composer, "measured_tip", found.time, at, found.covariance, turns)


def _make_uncertain(
    composer: MessageComposer,
    key: str,
    time: float,
    at: Pose,
    covariance: Matrix,
    turns: Floats = _UNKNOWN_TURNS,
) -> PoseWithCovarianceStamped:
    """Return a pose with the covariances of its position, mm², and of rotations about x, y, z, rad²."""
    frame, matrix = composer.frames[key], np.zeros((6, 6))
    matrix[:3, :3] = frame.map_covariance(1e-6 * np.array(covariance))
    matrix[3:, 3:] = frame.map_turns(turns)
    message = PoseWithCovariance(frame.map_pose(pose(time, at).pose), matrix.ravel())
    return PoseWithCovarianceStamped(composer.make_header(key, time), message)


def _make_turn_covariance(found: Measurement) -> Floats:
    """Return the covariance (3, 3), rad², of rotations about x, y, z."""
    if found.direction is None or found.direction_covariance is None:
        return _UNKNOWN_TURNS
    known: Floats = _AXIS_TURN.T @ np.array(found.direction_covariance) @ _AXIS_TURN
    known[0, 0] = UNKNOWN_TURN
    return known


# Path, scene and skin


def _make_path(composer: MessageComposer, plan: Plan) -> Path:
    message: Any = plan_message(plan.tips).message
    header = composer.make_header("plan", 0.0)
    poses = composer.frames["plan"].map_poses([stamped.pose for stamped in message.poses])
    return Path(header, [PoseStamped(header, one) for one in poses])


def _make_plan_markers(composer: MessageComposer, plan: Plan) -> Any:
    composer.scene = make_scene(plan)
    return make_markers(composer.make_header("markers", 0.0), composer.frames["markers"], composer.scene)


def _make_target_markers(composer: MessageComposer, target: LinkTarget) -> Any:
    composer.scene = replace(composer.scene, target=target.point)
    header = composer.make_header("markers", target.time)
    return make_markers(header, composer.frames["markers"], composer.scene)


def _make_zones(composer: MessageComposer, record: RosZones) -> Any:
    return make_zone_markers(composer.make_header("zones", 0.0), composer.frames["zones"], record)


def _make_clearance(composer: MessageComposer, record: RosClearance) -> Any:
    header = composer.make_header("clearance", record.time)
    return make_clearance_markers(header, composer.frames["clearance"], record)


def _make_skin_entry(composer: MessageComposer, _plan: Plan) -> PointMessage:
    return composer.frames["skin_entry"].map_point(PointMessage(0.0, 0.0, 0.0))


# The motors


def _make_needle_pose(composer: MessageComposer, period: Period) -> PoseStamped:
    base = period.base._replace(x=period.base.x + measure_length(period.shape))
    at = turn_about_axis(pose(period.time, base).pose, period.roll)
    return composer.make_pose("needle_pose", period.time, at)


def turn_about_axis(at: PoseMessage, roll: float) -> PoseMessage:
    """Return the pose after a turn by `roll` (rad) about its x axis."""
    turn = at.orientation
    cosine, sine = np.cos(roll / 2), np.sin(roll / 2)
    mixed = (
        turn.w * sine + turn.x * cosine,
        turn.y * cosine + turn.z * sine,
        turn.z * cosine - turn.y * sine,
        turn.w * cosine - turn.x * sine,
    )
    return PoseMessage(at.position, type(turn)(*map(float, mixed)))


def _make_guide_pose(composer: MessageComposer, period: Period) -> PointStamped:
    x = period.base.x + measure_length(period.shape)
    at = PointMessage(*(1e-3 * float(value) for value in (x, *period.guide)))
    header = composer.make_header("guide_pose", period.time)
    return PointStamped(header, composer.frames["guide_pose"].map_point(at))


def _make_joints(composer: MessageComposer, period: Period) -> JointState:
    found: JointState = _TRACED["/joint_states"](period)
    return replace(found, header=composer.make_header("joint_states", period.time))


def _make_targets(composer: MessageComposer, record: JointTargets) -> JointState:
    names, positions = list(record.positions), np.array(list(record.positions.values()), dtype=float)
    header = composer.make_header("joint_targets", record.time)
    return JointState(header, names, positions, np.empty(0), np.empty(0))


# State


def _make_state(_composer: MessageComposer, record: LinkState) -> String:
    return String(record.state)


def _make_rig_diagnostics(composer: MessageComposer, record: LinkState) -> DiagnosticArray:
    text = f"{record.state}: {record.reason}" if record.reason else record.state
    found = statuses(record.time, "flexneedle: rig", [Check(text, record.good, record.values)])
    return replace(found, header=composer.make_header("diagnostics", record.time))


def _make_period_diagnostics(composer: MessageComposer, period: Period) -> DiagnosticArray:
    found: dict[str, Any] = dict(status_messages(period))
    every = [status for topic in _STATES if topic in found for status in found[topic].status]
    named = [replace(status, name=f"flexneedle: {status.name}") for status in every]
    return DiagnosticArray(composer.make_header("diagnostics", period.time), named)


_BUILDERS: dict[type, dict[str, Callable[[MessageComposer, Any], Any]]] = {
    Plan: {"plan": _make_path, "markers": _make_plan_markers, "skin_entry": _make_skin_entry},
    Period: {
        "shape": _make_shape,
        "predicted_shape": _make_predicted,
        "tip": _make_tip,
        "tip_covariance": _make_tip_covariance,
        "measured_tip": _make_measured,
        "needle_pose": _make_needle_pose,
        "guide_pose": _make_guide_pose,
        "joint_states": _make_joints,
        "diagnostics": _make_period_diagnostics,
    },
    LinkTarget: {"markers": _make_target_markers},
    RosZones: {"zones": _make_zones},
    RosClearance: {"clearance": _make_clearance},
    LinkState: {"state": _make_state, "diagnostics": _make_rig_diagnostics},
    JointTargets: {"joint_targets": _make_targets},
}
