"""Records that an insertion and the node of a protocol exchange, besides `Plan` and `Period`.

Lengths are in mm in the frame of the insertion: x along its axis into the tissue, y and z across. Times are in s: of
published records on the clock of the run, of received records on `time.monotonic()`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flexneedle.types import Point

# Published


@dataclass(frozen=True)
class LinkState:
    """State of the rig by name, such as "armed", with its reason, whether it is good, and more values."""

    time: float
    state: str
    reason: str = ""
    good: bool = True
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class LinkTarget:
    """A target that is published, or that another program requests."""

    time: float
    point: Point


# Received. source: topic or peer.


@dataclass(frozen=True)
class LinkStop:
    """A request to stop, or an unreadable message in its place."""

    time: float
    source: str
    reason: str = ""


@dataclass(frozen=True)
class LinkArm:
    """A request to arm the rig."""

    time: float
    source: str


@dataclass(frozen=True)
class LinkRefusal:
    """A refused message. count: refused messages of the source, this one included."""

    time: float
    source: str
    reason: str
    count: int = 1


@dataclass(frozen=True)
class LinkNote:
    """An event that other programs have caused, such as the end of a connection."""

    time: float
    text: str


@dataclass(frozen=True)
class NodeLoss:
    """The node has ended or does not answer: nothing more is received, not even a stop."""

    time: float
    reason: str


# Between the two processes


@dataclass(frozen=True)
class NodeHeartbeat:
    """A sign of life of the node; the first one reports that it is ready."""

    time: float


Requested = LinkStop | LinkArm | LinkTarget | LinkRefusal | LinkNote | NodeLoss
"""Records that a node sends to the insertion."""
