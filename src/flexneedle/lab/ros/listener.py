"""A participant that reads the topics of a rig and publishes nothing."""

import time
from dataclasses import dataclass, field

from flexneedle.lab.link.records import LinkRefusal, LinkStop
from flexneedle.lab.ros.dds import DomainDirectory, TopicReader, join_domain, to_dds_topic
from flexneedle.lab.ros.node import find_obstacle, make_inputs
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import TopicProfile
from flexneedle.ports import Clock

_PAUSE_S = 0.01


@dataclass(frozen=True)
class TopicActivity:
    """Activity on a topic of `subscribe` or `sensors`.

    publishers, messages: their numbers; age: age (s) of the last message at the end, by the clocks of both computers,
    None without a message; problem: "" if there is none.
    """

    key: str
    topic: str
    kind: str
    publishers: int
    messages: int
    age: float | None = None
    problem: str = ""


class TopicListener:
    """Reads all topics of `subscribe` and `sensors` that a profile lists. Raises as `join_domain`.

    identity: the domain.
    """

    def __init__(self, profile: TopicProfile) -> None:
        domain = join_domain()
        self.identity = f"domain {domain.domain_id}"
        self._directory = DomainDirectory(domain)
        self._topics = [_Topic(*each) for each in make_inputs(domain, profile)]

    def close(self) -> None:
        """Leave the domain."""
        self._topics.clear()
        del self._directory

    @property
    def others(self) -> int:
        """Number of the other participants of the domain."""
        return self._directory.participants - 1

    def is_published(self, topic: str) -> bool:
        """Return whether a node publishes a topic."""
        return any(name == to_dds_topic(topic) for name, _ in self._directory.publishers)

    def listen(self, clock: Clock, seconds: float) -> list[TopicActivity]:
        """Listen for `seconds` and return the activity on each topic."""
        begun = clock.now()
        while clock.now() - begun < seconds:
            for topic in self._topics:
                topic.take(clock.now())
            clock.wait(_PAUSE_S)
        now, publishers = time.time(), self._directory.publishers
        return [topic.summarize(now, publishers) for topic in self._topics]


@dataclass
class _Topic:
    """One topic: its readers, the publisher and time of each message, and the last problem of a message."""

    subscription: Subscription
    readers: list[TopicReader]
    sources: set[tuple[int, int]] = field(default_factory=set)
    problem: str = ""

    def take(self, now: float) -> None:
        publishers = self.readers[0].writers
        for data, source in (sample for reader in self.readers for sample in reader.take()):
            if source not in self.sources:  # a stop has several readers
                self.sources.add(source)
                match self.subscription.read(data, now, publishers, 1e-9 * source[1]):
                    case LinkStop(reason=reason):
                        self.problem = f"{reason or 'true'}: an insertion would be stopped"
                    case LinkRefusal(reason=reason):
                        self.problem = f"a message is refused: {reason}"

    def summarize(self, now: float, publishers: list[tuple[str, str]]) -> TopicActivity:
        """Return the activity; now: Unix time, s; publishers: of the domain."""
        one, matched = self.subscription, self.readers[0].writers
        problem = find_obstacle(one, matched, publishers) or self.problem
        sent = max((time for _, time in self.sources), default=None)
        age = None if sent is None else now - 1e-9 * sent
        return TopicActivity(one.key, one.topic, one.kind, matched, len(self.sources), age, problem)
