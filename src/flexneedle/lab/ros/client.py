"""Client of the ROS node. Only its start waits."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.link.client import LinkClient
from flexneedle.lab.ros.profile import INSERTION_KEYS, TopicProfile
from flexneedle.lab.ros.records import JointTargets, NodeSetup, RosHeartbeat
from flexneedle.results import Period


def check_installed() -> None:
    """Raise InputError if cyclonedds is not installed."""
    if find_spec("cyclonedds") is None:
        raise InputError("ROS 2 needs cyclonedds, which is not installed: pip install 'flexneedle[ros]'")


def open_node(profile: TopicProfile, *, epoch: float = 0.0) -> "NodeClient":
    """Start the node of an insertion, which publishes the topics of the profile and reads stop, arm and target.

    epoch: Unix time (s) of the records' time 0, for the stamps of messages (default: stamps are the records' times).
    Raises InputError if cyclonedds is not installed or ROS_DOMAIN_ID is invalid, RunError if the node does not start.
    """
    return NodeClient(profile.select(**INSERTION_KEYS), epoch=epoch)


class NodeClient(LinkClient):
    """A node that publishes and reads all topics of a profile. Use it as a context manager, or call `close`.

    subscribers, publishers: number of nodes of each topic, by key of `publish` and `subscribe`, at the last `poll`;
    obstacles: why a publisher of a sensor's topic is not received, by key.
    """

    droppable = (Period, JointTargets)

    def __init__(self, profile: TopicProfile, *, epoch: float = 0.0) -> None:
        check_installed()
        self.subscribers: Mapping[str, int] = {}
        self.publishers: Mapping[str, int] = {}
        self.obstacles: Mapping[str, str] = {}
        super().__init__(f"{__package__}.node", NodeSetup(profile, epoch), "ROS")

    def _take_heartbeat(self, beat: Any) -> None:
        super()._take_heartbeat(beat)
        if isinstance(beat, RosHeartbeat):
            self.subscribers, self.publishers = beat.subscribers, beat.publishers
            self.obstacles = beat.obstacles
