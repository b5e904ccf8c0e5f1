"""Profiles: topic names, units, axes and frames of a ROS system, one TOML file each.

A topic that a profile does not list is neither published nor read.
"""

import re
from collections.abc import Collection, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from flexneedle.errors import RigError
from flexneedle.scenario.library import Library
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.environment import Vector
from flexneedle.scenario.sections.fields import Positive, Section, Title
from flexneedle.types import Floats

PROFILES = Library("a profile of ROS topics", "profile", files(__package__) / "profiles", RigError)

AxisName = Literal["x", "y", "z", "-x", "-y", "-z"]
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST = 200


def _a_topic(name: str) -> str:
    if len(name) > _LONGEST or not _TOPIC.fullmatch(name):
        raise ValueError(
            "must be a full topic name such as /needle/shape: letters, digits and _ after each /"
        )
    return name


TopicName = Annotated[str, AfterValidator(_a_topic)]


class Axes(Section):
    """Three axes, right-handed: which axis points along the insertion's x, y and z."""

    x: AxisName = "x"
    """Axis along the insertion axis, into the tissue."""
    y: AxisName = "y"
    """Axis along the insertion's y."""
    z: AxisName = "z"
    """Axis along the insertion's z."""

    @property
    def rotation(self) -> Floats:
        """Matrix (3, 3) from coordinates of the insertion to these."""
        return np.array([_unit(self.x), _unit(self.y), _unit(self.z)]).T

    @model_validator(mode="after")
    def _right_handed(self) -> Self:
        if abs(np.linalg.det(self.rotation) - 1.0) > 0.5:
            rule = "must be three different axes, right-handed, such as x = z, y = y, z = -x"
            refuse([Problem((), [self.x, self.y, self.z], rule)])
        return self


def _unit(axis: AxisName) -> list[float]:
    sign = -1.0 if axis.startswith("-") else 1.0
    return [sign * (name == axis[-1]) for name in "xyz"]


class FrameAxes(Axes):
    """Section `frames.NAME`: a frame of the ROS system, and how the insertion is placed in it."""

    id: Annotated[str, Field(min_length=1, max_length=_LONGEST)]
    """`frame_id` of messages. A received message with another one is refused."""
    origin_mm: Vector = (0.0, 0.0, 0.0)
    """Where the insertion axis enters the skin, in this frame."""


class Topic(Section):
    """A topic without positions."""

    topic: TopicName
    """Full name of the topic."""


class PlacedTopic(Topic):
    """A topic with positions."""

    frame: str
    """Name of the frame among `frames`."""
    unit: Literal["m", "mm"] = "m"
    """Unit of lengths."""


class ShapeTopic(PlacedTopic):
    """A topic of poses along the needle, the last one the tip."""

    spacing_mm: Positive | None = None
    """Distance of the poses along the needle, counted from the tip. Not set: the nodes of the model."""


class Publish(Section):
    """Section `publish`: what is published where."""

    shape: ShapeTopic | None = None
    """Estimated needle."""
    predicted_shape: ShapeTopic | None = None
    """Needle at the target, as predicted."""
    tip: PlacedTopic | None = None
    """Estimated tip."""
    measured_tip: PlacedTopic | None = None
    """Tip as the tracker measured it, with its covariance; only where the tracker reports one."""
    plan: PlacedTopic | None = None
    """Planned path of the tip."""
    markers: PlacedTopic | None = None
    """Layers of tissue, and the target."""
    skin_entry: PlacedTopic | None = None
    """Where the insertion axis enters the skin."""
    needle_pose: PlacedTopic | None = None
    """Tip of the needle if it were straight: the inserted length along the insertion axis, and the roll."""
    guide_pose: PlacedTopic | None = None
    """The inserted length along the insertion axis, and the guide across it."""
    joint_states: Topic | None = None
    """Positions of base and guide, and the roll (m, rad)."""
    state: Topic | None = None
    """State of the rig in one word."""
    diagnostics: Topic | None = None
    """State of the rig with its reason, and all scalars, readings and durations of each control period."""
    joint_targets: Topic | None = None
    """Positions that the joints of a rig of topics are to take."""


class Subscribe(Section):
    """Section `subscribe`: what is read where."""

    tip: PlacedTopic | None = None
    """Tip from a tracker."""
    shape: PlacedTopic | None = None
    """Poses along the needle from a sensor of its shape, at any distances, the last one the tip."""
    target: PlacedTopic | None = None
    """Target."""
    stop: Topic | None = None
    """true stops the rig."""
    arm: Topic | None = None
    """true arms the rig; false stops it."""
    joint_states: Topic | None = None
    """Positions of the joints of a rig of topics."""


PUBLISHED: dict[str, str] = {
    "shape": "geometry_msgs/msg/PoseArray",
    "predicted_shape": "geometry_msgs/msg/PoseArray",
    "tip": "geometry_msgs/msg/PoseStamped",
    "measured_tip": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "plan": "nav_msgs/msg/Path",
    "markers": "visualization_msgs/msg/MarkerArray",
    "skin_entry": "geometry_msgs/msg/Point",
    "needle_pose": "geometry_msgs/msg/PoseStamped",
    "guide_pose": "geometry_msgs/msg/PointStamped",
    "joint_states": "sensor_msgs/msg/JointState",
    "state": "std_msgs/msg/String",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "joint_targets": "sensor_msgs/msg/JointState",
}
"""Message type of each key of `publish`."""

LATCHED = ("plan", "markers", "skin_entry", "state")
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

OF_THE_LOOP = (tuple(key for key in PUBLISHED if key != "joint_targets"), ("stop", "arm", "target"))
"""What the node of an insertion publishes and reads: a tracker and motors of topics have nodes of their own."""


class Profile(Section):
    """A profile, as its file describes it."""

    name: Title
    """Title in messages."""
    needle: Axes = Axes()
    """Axes of a pose on the needle: which of its own axes points along the needle, and the two across."""
    frames: dict[str, FrameAxes] = Field(default_factory=dict)
    """Frames by name."""
    publish: Publish = Publish()
    subscribe: Subscribe = Subscribe()

    def topics(self) -> Iterator[tuple[str, Topic]]:
        """Yield `publish.KEY` or `subscribe.KEY` and the topic of each that the profile lists."""
        for section in ("publish", "subscribe"):
            part = getattr(self, section)
            for key in type(part).model_fields:
                if (topic := getattr(part, key)) is not None:
                    yield f"{section}.{key}", topic

    def only(self, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> "Profile":
        """Return the profile with these keys alone."""
        sections = {"publish": publish, "subscribe": subscribe}
        kept = {
            name: getattr(self, name).model_copy(
                update={key: None for key in type(getattr(self, name)).model_fields if key not in keys}
            )
            for name, keys in sections.items()
        }
        return self.model_copy(update=kept)

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(_problems(self))
        return self


def _problems(profile: Profile) -> Iterator[Problem]:
    known = ", ".join(profile.frames) or "none"
    owners: dict[str, str] = {}
    for key, topic in profile.topics():
        if (other := owners.setdefault(topic.topic, key)) != key:
            rule = f"is that of {other}, too: what is published must not be read back as a measurement"
            yield Problem(f"{key}.topic", topic.topic, rule)
        if isinstance(topic, PlacedTopic) and topic.frame not in profile.frames:
            yield Problem(f"{key}.frame", topic.frame, f"must be one of frames: {known}")


def load_profile(source: str | Path) -> Profile:
    """Return the profile of a name or of a TOML file. Raises RigError with one line for each problem."""
    return PROFILES.load(source, Profile)
