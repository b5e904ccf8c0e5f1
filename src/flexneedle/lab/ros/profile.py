"""Profiles: topic names, units, axes and frames of a ROS system, one TOML file each.

A topic that a profile does not list is neither published nor read.
"""

import re
from collections.abc import Collection, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from flexneedle.errors import RigError
from flexneedle.lab.link.fields import AxisName, make_unit
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse, to_line
from flexneedle.scenario.sections.environment import Vector
from flexneedle.scenario.sections.fields import Positive, Section, Title
from flexneedle.types import Floats

PROFILES = Library("a profile of ROS topics", "profile", files(__package__) / "profiles", RigError)

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST = 200
_SENSORS = "sensors."

Keys = Collection[str]


def _check_name(name: str) -> str:
    if len(name) > _LONGEST or not _TOPIC.fullmatch(name):
        raise ValueError(
            "must be a full topic name such as /needle/shape: letters, digits and _ after each /"
        )
    return name


TopicName = Annotated[str, AfterValidator(_check_name)]


class AxisNames(Section):
    """Axes, right-handed, that point along the insertion's x, y and z."""

    x: AxisName = "x"
    """Axis along the insertion axis, into the tissue."""
    y: AxisName = "y"
    """Axis along the insertion's y."""
    z: AxisName = "z"
    """Axis along the insertion's z."""

    @property
    def rotation(self) -> Floats:
        """Matrix (3, 3) from coordinates of the insertion to coordinates along these axes."""
        return np.array([make_unit(self.x), make_unit(self.y), make_unit(self.z)]).T

    @model_validator(mode="after")
    def _check_handedness(self) -> Self:
        if abs(np.linalg.det(self.rotation) - 1.0) > 0.5:
            rule = "must be three different axes, right-handed, such as x = z, y = y, z = -x"
            refuse([Problem((), [self.x, self.y, self.z], rule)])
        return self


class FrameAxes(AxisNames):
    """Section `frames.NAME`: a frame of the ROS system, with the place of the insertion in it."""

    id: Annotated[str, Field(min_length=1, max_length=_LONGEST)]
    """`frame_id` of messages. Received messages with another one are refused."""
    origin_mm: Vector = (0.0, 0.0, 0.0)
    """Point where the insertion axis enters the skin, in this frame."""


class ProfileTopic(Section):
    """A topic without positions."""

    topic: TopicName
    """Full name of the topic."""


class PlacedTopic(ProfileTopic):
    """A topic with positions."""

    frame: str
    """Name of the frame among `frames`."""
    unit: Literal["m", "mm"] = "m"
    """Unit of lengths."""


class ShapeTopic(PlacedTopic):
    """A topic of poses along the needle, the last one the tip."""

    spacing_mm: Positive | None = None
    """Distance of the poses along the needle, counted from the tip (default: the nodes of the model)."""


SensorType = Literal[
    "std_msgs/msg/Float64MultiArray",
    "geometry_msgs/msg/PoseArray",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/PoseStamped",
]
"""Types of the topics of sensors along the needle."""
CURVATURES, SHAPE, POINT, POSE = get_args(SensorType)


class SensorTopic(PlacedTopic):
    """Section `sensors.NAME`: a topic of a sensor along the needle.

    Two devices of a rig must not read topics with a common source: a shape is computed from curvatures.
    """

    type: SensorType
    """Type of its messages: curvatures at gratings, points along the needle, or one point."""
    frame: str = ""
    """Name of the frame among `frames`; not for curvatures, which are in a frame that rolls with the needle."""
    order: Literal["sites", "components"] | None = None
    """Order of curvatures: both of each grating, or one of each grating and then the other. Not set: the order of the
    layout in the message, without a layout `sites`."""
    source: Title | None = None
    """Device that measures. Not set: of curvatures and shapes, the namespace of the topic."""

    @property
    def sources(self) -> set[str]:
        """Names of the data: the topic, and its source."""
        namespace = _namespace(self.topic) if self.type in (CURVATURES, SHAPE) else self.topic
        return {self.topic, self.source or namespace}


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0] or topic


class PublishedTopics(Section):
    """Section `publish`: published topics."""

    shape: ShapeTopic | None = None
    """Estimated needle."""
    predicted_shape: ShapeTopic | None = None
    """Predicted needle at the target."""
    tip: PlacedTopic | None = None
    """Estimated tip."""
    tip_covariance: PlacedTopic | None = None
    """Estimated tip with the covariance of its position, with sensors along the needle."""
    measured_tip: PlacedTopic | None = None
    """Measured tip with its covariance, if the tracker reports a covariance."""
    plan: PlacedTopic | None = None
    """Planned path of the tip."""
    markers: PlacedTopic | None = None
    """Layers of tissue, and the target."""
    zones: PlacedTopic | None = None
    """Zones to avoid, and their margins."""
    clearance: PlacedTopic | None = None
    """Line from the estimated needle to the nearest zone, and the clearance as text."""
    skin_entry: PlacedTopic | None = None
    """Point where the insertion axis enters the skin."""
    needle_pose: PlacedTopic | None = None
    """Tip of a straight needle: the inserted length along the insertion axis, and the roll."""
    guide_pose: PlacedTopic | None = None
    """The inserted length along the insertion axis, and the guide across it."""
    joint_states: ProfileTopic | None = None
    """Positions of base and guide, and the roll (m, rad)."""
    state: ProfileTopic | None = None
    """State of the rig in one word."""
    diagnostics: ProfileTopic | None = None
    """State of the rig with its reason, and all scalars, readings, durations and sensors of each control period."""
    joint_targets: ProfileTopic | None = None
    """Goals of the joints of a rig of topics."""


class ReadTopics(Section):
    """Section `subscribe`: topics that are read."""

    tip: PlacedTopic | None = None
    """Measured tip of a tracker."""
    shape: PlacedTopic | None = None
    """Measured poses along the needle, at any distances, the last one the tip."""
    target: PlacedTopic | None = None
    """Target."""
    stop: ProfileTopic | None = None
    """true stops the rig."""
    arm: ProfileTopic | None = None
    """true arms the rig; false stops it."""
    joint_states: ProfileTopic | None = None
    """Positions of the joints of a rig of topics."""


PUBLISHED: dict[str, str] = {
    "shape": "geometry_msgs/msg/PoseArray",
    "predicted_shape": "geometry_msgs/msg/PoseArray",
    "tip": "geometry_msgs/msg/PoseStamped",
    "tip_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "measured_tip": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "plan": "nav_msgs/msg/Path",
    "markers": "visualization_msgs/msg/MarkerArray",
    "zones": "visualization_msgs/msg/MarkerArray",
    "clearance": "visualization_msgs/msg/MarkerArray",
    "skin_entry": "geometry_msgs/msg/Point",
    "needle_pose": "geometry_msgs/msg/PoseStamped",
    "guide_pose": "geometry_msgs/msg/PointStamped",
    "joint_states": "sensor_msgs/msg/JointState",
    "state": "std_msgs/msg/String",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "joint_targets": "sensor_msgs/msg/JointState",
}
"""Message type of each key of `publish`."""

LATCHED = ("plan", "markers", "zones", "skin_entry", "state")
"""Keys of `publish` whose last message is also delivered to later subscribers."""

SUBSCRIBED: dict[str, str] = {
    "tip": "geometry_msgs/msg/PoseStamped",
    "shape": "geometry_msgs/msg/PoseArray",
    "target": "geometry_msgs/msg/PointStamped",
    "stop": "std_msgs/msg/Bool",
    "arm": "std_msgs/msg/Bool",
    "joint_states": "sensor_msgs/msg/JointState",
}
"""Message type of each key of `subscribe`."""

INSERTION_KEYS: dict[str, tuple[str, ...]] = {
    "publish": tuple(key for key in PUBLISHED if key != "joint_targets"),
    "subscribe": ("stop", "arm", "target"),
}
"""Keys of the node of an insertion; trackers and motors of topics have separate nodes."""


class TopicProfile(Section):
    """A profile, with the keys of its file."""

    name: Title
    """Title in messages."""
    needle: AxisNames = AxisNames()
    """Axes of a pose on the needle: the one along the needle, and the two across it."""
    frames: dict[str, FrameAxes] = Field(default_factory=dict)
    """Frames by name."""
    publish: PublishedTopics = PublishedTopics()
    subscribe: ReadTopics = ReadTopics()
    sensors: dict[str, SensorTopic] = Field(default_factory=dict)
    """Topics of sensors along the needle by name."""

    def list_topics(self) -> Iterator[tuple[str, ProfileTopic]]:
        """Yield `publish.KEY`, `subscribe.KEY` or `sensors.NAME` and the topic of each that the profile lists."""
        for section in INSERTION_KEYS:
            part = getattr(self, section)
            for key in type(part).model_fields:
                if (topic := getattr(part, key)) is not None:
                    yield f"{section}.{key}", topic
        for name, sensor in self.sensors.items():
            yield f"{_SENSORS}{name}", sensor

    @property
    def read_topics(self) -> dict[str, tuple[ProfileTopic, str]]:
        """Topics that are read, each with its type, by key of `subscribe` or `sensors.NAME`."""
        listed = {key: getattr(self.subscribe, key) for key in SUBSCRIBED}
        known = {key: (topic, SUBSCRIBED[key]) for key, topic in listed.items() if topic is not None}
        return known | {f"{_SENSORS}{name}": (topic, topic.type) for name, topic in self.sensors.items()}

    def find_sources(self, key: str) -> set[str]:
        """Return the names of the data of a topic that is read, by its key."""
        topic, kind = self.read_topics[key]
        if isinstance(topic, SensorTopic):
            return topic.sources
        same = (one.sources for one in self.sensors.values() if one.topic == topic.topic)
        return {topic.topic, *({_namespace(topic.topic)} if kind == SHAPE else ())}.union(*same)

    def select(self, *, publish: Keys = (), subscribe: Keys = (), sensors: Keys = ()) -> "TopicProfile":
        """Return the profile with these keys alone."""

        def reduce(part: Section, keys: Keys) -> Section:
            return part.model_copy(update={key: None for key in type(part).model_fields if key not in keys})

        parts = {"publish": reduce(self.publish, publish), "subscribe": reduce(self.subscribe, subscribe)}
        kept = {name: topic for name, topic in self.sensors.items() if name in sensors}
        return self.model_copy(update={**parts, "sensors": kept})

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(_find_problems(self))
        return self


def _find_problems(profile: TopicProfile) -> Iterator[Problem]:
    known = ", ".join(profile.frames) or "none"
    owners: dict[str, str] = {}
    for key, topic in profile.list_topics():
        other = owners.setdefault(topic.topic, key)
        # One topic may be read in several ways, of which a rig uses one.
        if other != key and not (isinstance(topic, SensorTopic) and not other.startswith("publish.")):
            rule = f"is also the topic of {other}: a published message must not be read back as a measurement"
            yield Problem(f"{key}.topic", topic.topic, rule)
        if isinstance(topic, SensorTopic) and topic.type == CURVATURES:
            if topic.frame:
                yield Problem(f"{key}.frame", topic.frame, "curvatures have no frame")
        elif isinstance(topic, PlacedTopic) and topic.frame not in profile.frames:
            yield Problem(f"{key}.frame", topic.frame, f"must be one of frames: {known}")


def load_profile(source: str | Path) -> TopicProfile:
    """Return the profile of a name or of a TOML file. Raises RigError with one line for each problem."""
    return PROFILES.load(source, TopicProfile)


def load_part(name: str, *, publish: Keys = (), subscribe: Keys = (), sensors: Keys = ()) -> TopicProfile:
    """Return a profile reduced to some keys. Raises RigError if it lacks one."""
    profile = load_profile(name)
    known = dict(profile.list_topics())
    wanted = {"publish": publish, "subscribe": subscribe, "sensors": sensors}
    for key in (f"{section}.{key}" for section, keys in wanted.items() for key in keys):
        if key not in known:
            raise RigError(to_line(Problem("profile", name, f"must list {key}; it lists {', '.join(known)}")))
    return profile.select(publish=publish, subscribe=subscribe, sensors=sensors)
