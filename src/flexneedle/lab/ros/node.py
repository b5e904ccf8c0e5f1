"""The ROS node of a rig: a process of its own, so that no thread of DDS runs in the rig's or the controller's.

    python -m flexneedle.lab.ros.node CHANNEL

CHANNEL is a descriptor whose other end is at `flexneedle.lab.ros.client.NodeClient`. The first record
on it is the `Setup`. The node publishes the messages of the records that follow and sends back what it receives. It
ends when the other end is closed.
"""

import signal
import sys
from threading import Event, Thread
from time import monotonic

from cyclonedds.domain import DomainParticipant

from flexneedle.errors import FlexneedleError, one_line
from flexneedle.lab.process import MessageChannel, open_channel
from flexneedle.lab.ros.dds import Reader, Writer, participant, waitset
from flexneedle.lab.ros.messages import Composer
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED
from flexneedle.lab.ros.records import Arm, Beat, JointTargets, Lost, Refused, Request, Setup, Stop

BEAT_S = 0.1
STALE_S = 0.1
"""Targets of joints that are older are not published: a command is carried out in time or not at all."""

_SWITCH_S = 5e-4  # a stop waits no longer than this for a thread that makes messages


def readers_of(domain: DomainParticipant, subscription: Subscription) -> list[Reader]:
    """Return the readers of a subscription, the first of which has all its publishers.

    A stop is taken from every publisher, whatever its quality of service, and also if it was sent before.
    """
    topic, kind = subscription.topic, subscription.kind
    if subscription.key == "stop":
        qualities = ({"reliable": False}, {"reliable": True}, {"reliable": True, "latched": True})
        return [Reader(domain, topic, kind, **quality) for quality in qualities]
    return [Reader(domain, topic, kind, reliable=subscription.key in ("target", "arm"))]


class Node:
    """Writers and readers of a profile."""

    def __init__(self, setup: Setup, channel: MessageChannel) -> None:
        self._channel, self._composer, self._ended = channel, Composer(setup.profile, setup.epoch), Event()
        self._domain = participant()
        publish, subscribe = setup.profile.publish, setup.profile.subscribe
        self._writers = {
            key: Writer(self._domain, topic.topic, kind, latched=key in LATCHED)
            for key, kind in PUBLISHED.items()
            if (topic := getattr(publish, key)) is not None
        }
        # Stops come first, also among messages that have arrived together.
        keys = sorted(type(subscribe).model_fields, key="stop".__ne__)
        wanted = (Subscription(setup.profile, key) for key in keys if getattr(subscribe, key) is not None)
        self._inputs = [(one, readers_of(self._domain, one)) for one in wanted]
        self._seen: dict[str, tuple[int, int]] = {}
        self._refused: dict[str, float] = {}
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
        for outgoing in self._composer.messages(record):
            self._writers[outgoing.key].write(outgoing.message)

    def _listen(self) -> None:
        every = [reader for _, readers in self._inputs for reader in readers]
        waiting = waitset(self._domain, every)
        last = -BEAT_S
        while not self._ended.is_set():
            for subscription, readers in self._inputs:
                for reader in readers:
                    self._forward(subscription, reader)
            if (now := monotonic()) - last >= BEAT_S:
                last = now
                self._channel.send(self._beat(now), keep=False)
            waiting.wait(round(1e9 * BEAT_S))

    def _beat(self, now: float) -> Beat:
        publishers = {one.key: readers[0].writers for one, readers in self._inputs}
        return Beat(now, {key: one.readers for key, one in self._writers.items()}, publishers)

    def _forward(self, subscription: Subscription, reader: Reader) -> None:
        publishers = reader.writers
        for data, source in reader.take():
            if self._seen.get(subscription.key) != source:  # a stop has several readers
                record = subscription.read(data, monotonic(), publishers)
                if record is not None and not self._repeats(record):
                    self._channel.send(record, keep=isinstance(record, Stop | Arm))
            self._seen[subscription.key] = source

    def _repeats(self, record: Request) -> bool:
        """Whether it is a refusal soon after one of the same topic: a flood of messages is no flood of records."""
        if not isinstance(record, Refused) or record.time - self._refused.get(record.topic, -1.0) < BEAT_S:
            return isinstance(record, Refused)
        self._refused[record.topic] = record.time
        return False


def main(descriptor: int) -> int:
    """Run a node on the channel of the command line."""
    channel = open_channel(descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the rig, which then closes the channel
    sys.setswitchinterval(_SWITCH_S)
    try:
        node = Node(channel.receive_first(), channel)
    except EOFError:
        return 0
    except FlexneedleError as error:
        channel.send(Lost(monotonic(), one_line(error)))
        channel.flush(BEAT_S)
        return 1
    node.run()
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
