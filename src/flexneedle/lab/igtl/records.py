"""Records that an insertion and its OpenIGTLink node exchange, besides `Plan`, `Period` and records of `lab.link`."""

from dataclasses import dataclass

from flexneedle.lab.igtl.settings import IgtlSettings
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.types import Point


@dataclass(frozen=True)
class NodeSetup:
    """The first record to a node.

    epoch: Unix time (s) of the records' time 0; registration: of the image, if known; awaits: as after `TargetWait`.
    """

    settings: IgtlSettings
    epoch: float
    registration: ImageRegistration | None = None
    awaits: bool = False


@dataclass(frozen=True)
class InsertionBegin:
    """An insertion begins. registration: of its scenario's image, None without one."""

    registration: ImageRegistration | None = None


@dataclass(frozen=True)
class TargetWait:
    """Targets are received until an insertion begins."""


@dataclass(frozen=True)
class InsertionResult:
    """The end of an insertion, or its result in one line."""

    time: float
    text: str


@dataclass(frozen=True)
class PeerGeometry:
    """A registration of a peer, or points by it.

    Attributes:
        source: The peer.
        registration: The one that came last, None before the first.
        target, entry: In the image, RAS, or without a registration in the needle's frame (mm).
    """

    source: str
    registration: ImageRegistration | None = None
    target: Point | None = None
    entry: Point | None = None

    @property
    def has_points(self) -> bool:
        """True if it has a target or an entry."""
        return self.target is not None or self.entry is not None
