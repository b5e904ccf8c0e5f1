"""Records that a rig and its ROS node exchange, besides `Plan` and `Period`.

Lengths are in mm in the frame of the insertion: x along its axis into the tissue, y and z across. Times are in s: of
published records on the clock of the run, of received records on `time.monotonic()`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.lab.ros.profile import TopicProfile
from flexneedle.types import VISIBLE, Floats, Point, Quaternion

# Published


@dataclass(frozen=True)
class RosState:
    """State of the rig by name, such as "armed", with its reason, whether it is good, and more values."""

    time: float
    state: str
    reason: str = ""
    good: bool = True
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RosTarget:
    """A target that is published, or that another node requests."""

    time: float
    point: Point


@dataclass(frozen=True)
class JointTargets:
    """Goals of joints by name, in the unit of the joint (m or rad). time: `time.monotonic()`."""

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
class RosStop:
    """A request to stop, or an unreadable message on the topic of stops."""

    time: float
    topic: str
    reason: str = ""


@dataclass(frozen=True)
class RosArm:
    """A request to arm the rig."""

    time: float
    topic: str


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


@dataclass(frozen=True)
class RosRefusal:
    """A refused message. count: refused messages of the topic, this one included."""

    time: float
    topic: str
    reason: str
    count: int = 1


@dataclass(frozen=True)
class NodeLoss:
    """The node has ended or does not answer: nothing more is received, not even a stop."""

    time: float
    reason: str


# Between the two processes


@dataclass(frozen=True)
class NodeSetup:
    """The first record to a node. epoch: Unix time (s) of the records' time 0; 0: stamps are the records' times."""

    profile: TopicProfile
    epoch: float = 0.0


@dataclass(frozen=True)
class NodeHeartbeat:
    """A sign of life of the node; the first one reports that it is ready.

    subscribers: number of subscribers by key of `publish`; publishers: number of publishers by key of `subscribe`.
    """

    time: float
    subscribers: Mapping[str, int]
    publishers: Mapping[str, int]


Published = RosState | RosTarget | JointTargets | RosZones | RosClearance
Received = RosStop | RosArm | RosTarget | TipReading | JointReading | RosRefusal | NodeLoss
