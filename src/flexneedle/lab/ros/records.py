"""Records that a rig and its ROS node exchange, besides `flexneedle.lab.link.records`.

Lengths are in mm in the frame of the insertion: x along its axis into the tissue, y and z across. Times are in s on
`time.monotonic()`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.lab.link.records import NodeHeartbeat, Requested
from flexneedle.lab.ros.profile import TopicProfile
from flexneedle.types import VISIBLE, Floats, Point, Quaternion, Reading

# Published


@dataclass(frozen=True)
class JointTargets:
    """Goals of joints by name, in the unit of the joint (m or rad)."""

    time: float
    positions: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class ZoneSurface:
    """A zone to avoid, or its margin. corners (3 t, 3): of its t triangles."""

    name: str
    is_margin: bool
    corners: Floats


@dataclass(frozen=True)
class RosZones:
    """The zones of a plan, and their margins."""

    surfaces: tuple[ZoneSurface, ...]


@dataclass(frozen=True)
class RosClearance:
    """Least clearance of the estimated needle from zones, the name of the zone, and the nearest points of the two."""

    time: float
    zone: str
    clearance: float
    needle: Point
    surface: Point


# Received


@dataclass(frozen=True)
class TipReading:
    """A tip at its time of measurement. orientation: its z is the needle's axis; None if unknown.

    status: VISIBLE, or the reason why there is no position.
    """

    time: float
    number: int
    position: Point | None
    orientation: Quaternion | None
    status: str = VISIBLE


@dataclass(frozen=True)
class JointReading:
    """Positions of joints by name, in the unit of the joint (m or rad); an unused joint may have any."""

    time: float
    positions: Mapping[str, float]


# Between the two processes


@dataclass(frozen=True)
class NodeSetup:
    """The first record to a node. epoch: Unix time (s) of the records' time 0; 0: stamps are the records' times."""

    profile: TopicProfile
    epoch: float = 0.0


@dataclass(frozen=True)
class RosHeartbeat(NodeHeartbeat):
    """A sign of life of the node.

    subscribers: number of subscribers by key of `publish`; publishers: number of publishers by key of `subscribe`;
    obstacles: why a publisher of a sensor's topic is not received, by key `sensors.NAME`, only of those that are not.
    """

    subscribers: Mapping[str, int]
    publishers: Mapping[str, int]
    obstacles: Mapping[str, str] = field(default_factory=dict)


Received = Requested | TipReading | JointReading | Reading
"""A `Reading` of a topic of curvatures has both of each grating, as they are in the message."""
