"""Records between a rig and its ROS node, besides `Plan` and `Period`.

Lengths are in mm, in the frame of the insertion: x along its axis into the tissue, y and z across. Times are in s: of
what is published on the clock of the run, of what was received `time.monotonic()`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.lab.ros.profile import Profile
from flexneedle.types import VISIBLE, Point, Quaternion

# What is published


@dataclass(frozen=True)
class RigState:
    """State of the rig by its name, such as "armed", a reason, whether it is as it should be, and more values."""

    time: float
    state: str
    reason: str = ""
    good: bool = True
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """The target: as published, or as requested by a ROS node."""

    time: float
    point: Point


@dataclass(frozen=True)
class JointTargets:
    """Positions that joints are to take, by name, in the units of the joint (m or rad). time: `time.monotonic()`."""

    time: float
    positions: Mapping[str, float]


# What was received


@dataclass(frozen=True)
class Stop:
    """A node asks to stop, or sent on the topic of stops something that cannot be read."""

    time: float
    topic: str
    reason: str = ""


@dataclass(frozen=True)
class Arm:
    """A node asks to arm the rig."""

    time: float
    topic: str


@dataclass(frozen=True)
class TipReading:
    """A tip from a tracker of topics. time: when it was measured; orientation: z is the needle's axis, None if unknown.

    status: VISIBLE, or why there is no position.
    """

    time: float
    number: int
    position: Point | None
    orientation: Quaternion | None
    status: str = VISIBLE


@dataclass(frozen=True)
class ShapeReading:
    """Points along a needle from a sensor of its shape, from the base to the tip, at any distances.

    tip: the last of them as a reading of the tip.
    """

    points: tuple[Point, ...]
    tip: TipReading


@dataclass(frozen=True)
class JointReading:
    """Positions and, where known, velocities of joints by name, in the units of the joint (m, rad, s)."""

    time: float
    positions: Mapping[str, float]
    velocities: Mapping[str, float]


@dataclass(frozen=True)
class Refused:
    """A message that was not taken, and why; count: messages of the topic refused so far."""

    time: float
    topic: str
    reason: str
    count: int = 1


@dataclass(frozen=True)
class Lost:
    """The node has ended or does not answer: nothing is received any more, no stop either."""

    time: float
    reason: str


# Between the two processes


@dataclass(frozen=True)
class Setup:
    """The first record to a node: what it is for. epoch: Unix time (s) of the records' time 0, 0: stamps are these."""

    profile: Profile
    epoch: float = 0.0


@dataclass(frozen=True)
class Beat:
    """A sign of life; the first one is sent when the node is ready.

    subscribers: their number by key of `publish`; publishers: theirs by key of `subscribe`.
    """

    time: float
    subscribers: Mapping[str, int]
    publishers: Mapping[str, int]


Published = RigState | Target | JointTargets
Request = Stop | Arm | Target | TipReading | ShapeReading | JointReading | Refused | Lost
