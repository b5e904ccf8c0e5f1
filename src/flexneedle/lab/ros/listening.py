"""Listening to the topics that a rig reads, without publishing anything."""

import time
from dataclasses import dataclass, field

from flexneedle.errors import make_printable
from flexneedle.lab.ros.dds import Directory, Reader, participant
from flexneedle.lab.ros.idl import dds_name, dds_topic, ros_name
from flexneedle.lab.ros.node import readers_of
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import SUBSCRIBED, Profile
from flexneedle.lab.ros.records import Refused, Stop
from flexneedle.ports import Clock

_PAUSE_S = 0.01


@dataclass(frozen=True)
class Heard:
    """What was heard on a topic of `subscribe`.

    publishers: whose messages are received; messages: that were; age: of the last when listening ended (s), by the
    clocks of the two computers, None without one; problem: what is wrong, "" if nothing is.
    """

    key: str
    topic: str
    kind: str
    publishers: int
    messages: int
    age: float | None = None
    problem: str = ""


class Listener:
    """A participant that reads all that a profile lists in `subscribe`. Raises InputError or RunError as `participant`.

    identity: the domain.
    """

    def __init__(self, profile: Profile) -> None:
        domain = participant()
        self.identity = f"domain {domain.domain_id}"
        self._directory = Directory(domain)
        self._topics = [
            _Topic(one, readers_of(domain, one))
            for key in SUBSCRIBED
            if getattr(profile.subscribe, key) is not None
            for one in [Subscription(profile, key)]
        ]

    def close(self) -> None:
        """Leave the domain."""
        self._topics.clear()
        del self._directory

    @property
    def others(self) -> int:
        """Number of the other participants of the domain."""
        return self._directory.participants - 1

    def publishes(self, topic: str) -> bool:
        """Whether a node publishes a topic."""
        return any(name == dds_topic(topic) for name, _ in self._directory.publishers)

    def heard(self, clock: Clock, seconds: float) -> list[Heard]:
        """Listen for `seconds` and return what was heard on each topic."""
        begun = clock.now()
        while clock.now() - begun < seconds:
            for topic in self._topics:
                topic.take(clock.now())
            clock.wait(_PAUSE_S)
        now, publishers = time.time(), self._directory.publishers
        return [topic.heard(now, publishers) for topic in self._topics]


@dataclass
class _Topic:
    """One topic, its readers, the messages by publisher and time there, and what was wrong with the last wrong one."""

    subscription: Subscription
    readers: list[Reader]
    sources: set[tuple[int, int]] = field(default_factory=set)
    problem: str = ""

    def take(self, now: float) -> None:
        publishers = self.readers[0].writers
        for reader in self.readers:
            for data, source in reader.take():
                if source not in self.sources:  # a stop has several readers
                    self.sources.add(source)
                    self._read(data, now, publishers)

    def _read(self, data: bytes, now: float, publishers: int) -> None:
        match self.subscription.read(data, now, publishers):
            case Stop(reason=reason):
                self.problem = f"{reason or 'true'}: an insertion would be stopped"
            case Refused(reason=reason):
                self.problem = f"a message is refused: {reason}"

    def heard(self, now: float, publishers: list[tuple[str, str]]) -> Heard:
        """now: Unix time, s; publishers: of the domain."""
        one, matched = self.subscription, self.readers[0].writers
        kinds = [kind for topic, kind in publishers if topic == dds_topic(one.topic)]
        wrong = [kind for kind in kinds if kind != dds_name(one.kind)]
        problem = self.problem
        if wrong:
            problem = f"a publisher has the type {make_printable(ros_name(wrong[0]))}, which is not received"
        elif len(kinds) > matched:
            problem = "a publisher is not received: its quality of service must be reliable"
        sent = max((time for _, time in self.sources), default=None)
        age = None if sent is None else now - 1e-9 * sent
        return Heard(one.key, one.topic, one.kind, matched, len(self.sources), age, problem)
