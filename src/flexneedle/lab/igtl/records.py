"""Records that an insertion sends to its OpenIGTLink node, besides `Plan`, `Period` and `LinkState`."""

from dataclasses import dataclass

from flexneedle.lab.igtl.settings import IgtlSettings
from flexneedle.lab.images.frames import ImageRegistration


@dataclass(frozen=True)
class NodeSetup:
    """The first record to a node. epoch: Unix time (s) of the records' time 0; registration: of the image, if known."""

    settings: IgtlSettings
    epoch: float
    registration: ImageRegistration | None = None


@dataclass(frozen=True)
class InsertionBegin:
    """An insertion begins. registration: of the image; None: the one received last, if any, remains."""

    registration: ImageRegistration | None = None


@dataclass(frozen=True)
class TargetWait:
    """The insertion waits for a target."""


@dataclass(frozen=True)
class InsertionResult:
    """The end of an insertion, or its result in one line."""

    time: float
    text: str
