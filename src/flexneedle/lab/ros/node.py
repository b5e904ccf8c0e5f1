"""The ROS node of a rig: a separate process, so that no thread of DDS runs in the rig or the controller.

    python -m flexneedle.lab.ros.node CHANNEL

CHANNEL is the descriptor of a channel to `flexneedle.lab.ros.client.NodeClient`. The first record on it is the
`NodeSetup`. The node publishes the messages of the later records, and sends back the records of received messages. It
ends when the other end is closed.
"""

import signal
import sys
from collections import defaultdict, deque
from collections.abc import Mapping
from threading import Event, Thread
from time import monotonic

from cyclonedds.domain import DomainParticipant

from flexneedle.errors import FlexneedleError, make_printable, one_line
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, NodeLoss
from flexneedle.lab.process import MessageChannel, open_channel
from flexneedle.lab.ros.composer import MessageComposer
from flexneedle.lab.ros.dds import (
    DomainDirectory,
    TopicReader,
    TopicWriter,
    join_domain,
    make_waitset,
    to_dds_name,
    to_dds_topic,
    to_ros_name,
)
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, TopicProfile
from flexneedle.lab.ros.records import JointTargets, NodeSetup, Received, RosHeartbeat

BEAT_S = 0.1
STALE_S = 0.1
"""Older joint targets are not published: a command is carried out in time or not at all."""
_REMEMBERED = 64  # messages of a topic, of which a repetition is recognised
_SWITCH_S = 5e-4  # longest time that a stop waits for a thread that makes messages

Input = tuple[Subscription, list[TopicReader]]


def make_inputs(domain: DomainParticipant, profile: TopicProfile) -> list[Input]:
    """Return the subscriptions of a profile with their readers, the first of which matches all publishers."""
    listed = [Subscription(profile, key) for key in profile.read_topics]
    return [(one, _make_readers(domain, one)) for one in listed]


def find_obstacle(subscription: Subscription, matched: int, publishers: list[tuple[str, str]]) -> str:
    """Return why a publisher of a topic is not received, "" if all are.

    matched: number of publishers that are received; publishers: DDS topic and type of each of the domain.
    """
    kinds = [kind for topic, kind in publishers if topic == to_dds_topic(subscription.topic)]
    wrong = [kind for kind in kinds if kind != to_dds_name(subscription.kind)]
    if wrong:
        return f"a publisher has the type {make_printable(to_ros_name(wrong[0]))}, which is not received"
    if len(kinds) > matched:
        return "a publisher is not received: its quality of service must be reliable"
    return ""


def _make_readers(domain: DomainParticipant, subscription: Subscription) -> list[TopicReader]:
    """Return the readers of a subscription. Stops of any quality of service are read, earlier ones included."""
    topic, kind = subscription.topic, subscription.kind
    if subscription.key == "stop":
        qualities = ({"reliable": False}, {"reliable": True}, {"reliable": True, "latched": True})
        return [TopicReader(domain, topic, kind, **quality) for quality in qualities]
    return [TopicReader(domain, topic, kind, reliable=subscription.key in ("target", "arm"))]


def make_memory() -> defaultdict[str, deque[tuple[int, int]]]:
    """Return the sources of the last messages by key; none yet."""
    return defaultdict(lambda: deque(maxlen=_REMEMBERED))


class RosNode:
    """Writers and readers of a profile."""

    def __init__(self, setup: NodeSetup, channel: MessageChannel) -> None:
        self._channel, self._ended = channel, Event()
        self._composer = MessageComposer(setup.profile, setup.epoch)
        self._domain = join_domain()
        self._writers = {
            key: TopicWriter(self._domain, topic.topic, kind, latched=key in LATCHED)
            for key, kind in PUBLISHED.items()
            if (topic := getattr(setup.profile.publish, key)) is not None
        }
        # Stops come first, also among messages that have arrived together.
        self._inputs = sorted(
            make_inputs(self._domain, setup.profile), key=lambda each: each[0].key != "stop"
        )
        self._read = make_memory()
        self._refused: dict[str, float] = {}
        # Not beside stops: to read the domain takes time.
        self._directory = DomainDirectory(self._domain) if setup.profile.sensors else None
        self._listener = Thread(target=self._listen, name="listener", daemon=True)

    def run(self) -> None:
        """Publish and receive until the other end of the channel is closed."""
        self._listener.start()
        while not self._channel.ended and self._listener.is_alive():
            for record in self._channel.receive(BEAT_S):
                self._publish(record)
        self._ended.set()
        self._listener.join()

    def _publish(self, record: object) -> None:
        if isinstance(record, JointTargets) and monotonic() - record.time > STALE_S:
            return
        for key, message in self._composer.compose(record):
            self._writers[key].write(message)

    def _listen(self) -> None:
        waitset = make_waitset(self._domain, [reader for _, readers in self._inputs for reader in readers])
        last = -BEAT_S
        while not self._ended.is_set():
            for subscription, readers in self._inputs:
                for reader in readers:
                    self._forward(subscription, reader)
            if (now := monotonic()) - last >= BEAT_S:
                last = now
                self._channel.send(self._make_heartbeat(now), keep=False)
            waitset.wait(round(1e9 * BEAT_S))

    def _make_heartbeat(self, now: float) -> RosHeartbeat:
        publishers = {one.key: readers[0].writers for one, readers in self._inputs}
        subscribers = {key: one.readers for key, one in self._writers.items()}
        return RosHeartbeat(now, subscribers, publishers, self._find_obstacles(publishers))

    def _find_obstacles(self, matched: Mapping[str, int]) -> dict[str, str]:
        silent = [one for one, _ in self._inputs if not matched[one.key]]
        if self._directory is None or not silent:
            return {}
        publishers = self._directory.publishers
        found = {one.key: find_obstacle(one, 0, publishers) for one in silent}
        return {key: reason for key, reason in found.items() if reason}

    def _forward(self, subscription: Subscription, reader: TopicReader) -> None:
        publishers = reader.writers
        for data, source in reader.take():
            if source in self._read[subscription.key]:  # a stop has several readers
                continue
            self._read[subscription.key].append(source)
            record = subscription.read(data, monotonic(), publishers, 1e-9 * source[1])
            if record is not None and not self._is_repeated(record):
                self._channel.send(record, keep=isinstance(record, LinkStop | LinkArm))

    def _is_repeated(self, record: Received) -> bool:
        """Return whether a record is a refusal soon after one of the same topic, as in a flood of messages."""
        if not isinstance(record, LinkRefusal):
            return False
        if record.time - self._refused.get(record.source, -1.0) < BEAT_S:
            return True
        self._refused[record.source] = record.time
        return False


def main(descriptor: int) -> int:
    """Run a node on the channel of the command line."""
    channel = open_channel(descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the rig, which then closes the channel
    sys.setswitchinterval(_SWITCH_S)
    try:
        node = RosNode(channel.receive_first(), channel)
    except EOFError:
        return 0
    except FlexneedleError as error:
        channel.send(NodeLoss(monotonic(), one_line(error)))
        channel.flush(BEAT_S)
        return 1
    node.run()
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
