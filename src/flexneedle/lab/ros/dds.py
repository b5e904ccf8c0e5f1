"""Writers and readers of ROS topics over Cyclone DDS. Samples are CDR, as in a trace; the type is for discovery.

The domain is ROS_DOMAIN_ID (default: 0); network interfaces and discovery are those of CYCLONEDDS_URI.
"""

import os
from collections.abc import Callable, Iterator
from typing import Any, Self

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.core import InstanceState as Instances
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from flexneedle.errors import InputError, RunError
from flexneedle.lab.ros.idl import dds_topic, idl_type, user_data
from flexneedle.record.messages import STORE

_HIGHEST_DOMAIN = 232  # beyond it the ports of RTPS would not exist
_DEPTH, _TAKEN = 5, 32
_MOST_KNOWN = 10_000  # participants and publishers of a domain
_ANY = SampleState.Any | ViewState.Any | Instances.Any


class Cdr:
    """A sample as bytes of CDR with its header; takes the place of a structure in writers and readers."""

    def __init__(self, data: bytes) -> None:
        self.data, self.sample_info = data, None

    def serialize(self, **_how: object) -> bytes:
        """The bytes."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, **_how: object) -> Self:
        """A sample of these bytes."""
        return cls(bytes(data))

    @classmethod
    def deserialize_key(cls, data: bytes, **_how: object) -> Self:
        """A sample without data: that a writer ended."""
        return cls(bytes(data))


def participant() -> DomainParticipant:
    """Join the domain. Raises InputError for an invalid ROS_DOMAIN_ID, RunError if DDS cannot be started."""
    given = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not given.isdecimal() or int(given) > _HIGHEST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID = {given!r}: must be a whole number from 0 to {_HIGHEST_DOMAIN}")
    try:
        return DomainParticipant(int(given))
    except DDSException as error:
        raise RunError(f"ROS 2: no DDS participant in domain {given}: {error.msg or error}") from error


class Writer:
    """Publishes messages of one type. It never waits: without a reader that keeps up, old samples are replaced.

    Reliable, so that reliable and best-effort subscribers both match, with a short history: a slow subscriber misses
    samples. latched: the last message is also delivered to later subscribers. quality: policies in place of these.
    """

    def __init__(
        self,
        domain: DomainParticipant,
        topic: str,
        kind: str,
        quality: Qos | None = None,
        *,
        latched: bool = False,
    ) -> None:
        self._kind = kind
        usual = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0),
            Policy.History.KeepLast(1 if latched else _DEPTH),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            *_common(kind),
        )
        self._writer: Any = DataWriter(
            domain, _topic(domain, topic, kind), qos=Qos(*(quality or ()), base=usual)
        )
        self.missed = 0

    def write(self, message: Any) -> None:
        """Publish a message; where DDS has no room for it, it is counted in `missed`."""
        try:
            self._writer.write(Cdr(bytes(STORE.serialize_cdr(message, self._kind))))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise RunError(f"ROS 2: a message cannot be published: {error.msg or error}") from error
            self.missed += 1

    @property
    def readers(self) -> int:
        """Number of subscribers."""
        return _count(self._writer.get_matched_subscriptions)


class Reader:
    """Receives messages of one type, without those published before it was made unless `latched`."""

    def __init__(
        self,
        domain: DomainParticipant,
        topic: str,
        kind: str,
        *,
        reliable: bool = True,
        latched: bool = False,
    ) -> None:
        quality = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0) if reliable else Policy.Reliability.BestEffort,
            Policy.History.KeepLast(_TAKEN),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.IgnoreLocal.Participant,
            *_common(kind),
        )
        self._reader: Any = DataReader(domain, _topic(domain, topic, kind), qos=quality)
        self.condition = ReadCondition(self._reader, _ANY)

    def take(self) -> Iterator[tuple[bytes, tuple[int, int]]]:
        """The data received since the last call, each with its publisher and its time there."""
        for sample in self._reader.take(N=_TAKEN):
            if isinstance(sample, Cdr):
                info: Any = sample.sample_info
                yield sample.data, (info.publication_handle, info.source_timestamp)

    @property
    def writers(self) -> int:
        """Number of publishers."""
        return _count(self._reader.get_matched_publications)


def waitset(domain: DomainParticipant, readers: list[Reader]) -> WaitSet:
    """Something to wait on until one of the readers has data."""
    found = WaitSet(domain)
    for reader in readers:
        found.attach(reader.condition)
    return found


class Directory:
    """The participants of a domain and their publishers, as far as they have been discovered."""

    def __init__(self, domain: DomainParticipant) -> None:
        readers: list[Any] = [
            BuiltinDataReader(domain, topic)
            for topic in (BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication)
        ]
        alive = SampleState.Any | ViewState.Any | Instances.Alive
        self._known = [(reader, ReadCondition(reader, alive)) for reader in readers]

    @property
    def participants(self) -> int:
        """Number of participants, this one included."""
        return len(self._read(0))

    @property
    def publishers(self) -> list[tuple[str, str]]:
        """DDS names of the topic and the type of each publisher."""
        return [(one.topic_name, one.type_name) for one in self._read(1)]

    def _read(self, which: int) -> Any:
        reader, alive = self._known[which]
        return reader.read(N=_MOST_KNOWN, condition=alive)


def _count(matched: Callable[[], list[int]]) -> int:
    """Number of what is matched. Cyclone DDS asks twice, and raises IndexError if there are more the second time."""
    while True:
        try:
            return len(matched())
        except IndexError:
            continue


def _common(kind: str) -> tuple[Any, ...]:
    return Policy.DataRepresentation(use_cdrv0_representation=True), Policy.Userdata(user_data(kind))


def _topic(domain: DomainParticipant, topic: str, kind: str) -> Any:
    made: Any = Topic(domain, dds_topic(topic), idl_type(kind))
    made.data_type = Cdr
    return made
