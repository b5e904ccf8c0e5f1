"""ROS topics over Cyclone DDS: names and types, writers and readers.

ROS 2 names the DDS type of `geometry_msgs/msg/Pose` `geometry_msgs::msg::dds_::Pose_` and the DDS topic of `/tip`
`rt/tip`, and announces the hash of a type (REP 2011) in the user data of each writer and reader. Samples are CDR, as in
a trace; DDS needs the type for discovery only. The domain is ROS_DOMAIN_ID (default: 0). ROS's variables set the
discovery of other nodes; CYCLONEDDS_URI sets network interfaces, and wins where both set something.
"""

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from socket import AF_INET, getaddrinfo
from typing import Any, Self

import cyclonedds.idl.types
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.core import InstanceState as Instances
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from flexneedle.arguments import shorten
from flexneedle.errors import InputError, RunError
from flexneedle.record.messages import STORE

_HIGHEST_DOMAIN = 232  # a higher one has no RTPS ports
_DEPTH, _TAKEN = 5, 32
_MOST_KNOWN = 10_000  # participants and publishers of a domain
_ANY = SampleState.Any | ViewState.Any | Instances.Any
_types: Any = cyclonedds.idl.types
_NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
_BASIC: dict[str, Any] = {
    "bool": bool,
    "string": str,
    "byte": _types.byte,
    **{name: getattr(_types, name) for name in _NUMBERS},
}

# Names and types


def to_dds_name(name: str) -> str:
    """Return the name of the DDS type of a ROS type."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def to_ros_name(name: str) -> str:
    """Return the name of the ROS type of a DDS type, or the name itself if it has no ROS type."""
    package, *folder, kind = name.split("::")
    return f"{package}/{folder[0]}/{kind[:-1]}" if folder[1:] == ["dds_"] else name


def to_dds_topic(topic: str) -> str:
    """Return the DDS topic of a ROS topic such as `/tip`."""
    return f"rt{topic}"


@cache
def get_type_hash(name: str) -> str:
    """Return the hash of a ROS type, `RIHS01_` and 64 hexadecimal digits."""
    return STORE.hash_rihs01(name)


def make_user_data(name: str) -> bytes:
    """Return the user data of a writer or reader of a ROS type."""
    return f"typehash={get_type_hash(name)};".encode()


@cache
def make_idl_type(name: str) -> type[IdlStruct]:
    """Return the DDS type of a ROS type such as `geometry_msgs/msg/Pose`. Raises KeyError for an unknown one."""
    package, folder, kind = name.split("/")
    fields = {field: _make_field(definition) for field, definition in STORE.fielddefs[name][1]}
    return make_idl_struct(f"{kind}_", f"{package}.{folder}.dds_.{kind}_", fields, dataclassify=False)


def _make_field(definition: Any) -> Any:
    """Return the DDS type of a field: a basic type, a structure, or an array or sequence of either."""
    kind, detail = definition
    if kind is Nodetype.BASE:
        return _BASIC[detail[0]]
    if kind is Nodetype.NAME:
        return make_idl_type(detail)
    element, length = _make_field(detail[0]), detail[1]
    return _types.array[element, length] if kind is Nodetype.ARRAY else _types.sequence[element]


class CdrSample:
    """A sample as bytes of CDR with its header, in place of a structure."""

    def __init__(self, data: bytes) -> None:
        self.data, self.sample_info = data, None

    def serialize(self, **_how: object) -> bytes:
        """Return the bytes."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, **_how: object) -> Self:
        """Return a sample of these bytes."""
        return cls(bytes(data))

    @classmethod
    def deserialize_key(cls, data: bytes, **_how: object) -> Self:
        """Return a sample without data, which a writer sends when it ends."""
        return cls(bytes(data))


# Discovery

_URI, _RANGE, _PEERS, _LOCAL = (
    "CYCLONEDDS_URI",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
)
_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_MOST_PARTICIPANTS = 32  # of one machine that are searched there
_ADDRESS = re.compile(r"[\w.:%\[\]-]+", re.ASCII)
_ANY_ADDRESS, _PORT, _HIGHEST_PORT = "0.0.0.0", re.compile(r"[0-9]{1,5}"), 65535
_QUIET = "<General><AllowMulticast>false</AllowMulticast></General>"


def discovery_settings(environment: Mapping[str, str]) -> str:
    """Return Cyclone DDS settings for ROS's discovery variables, as rcl and rmw_cyclonedds set them since Iron.

    ROS_LOCALHOST_ONLY = 1 wins over the others. Unlike there, this machine is searched with SUBNET, too: its nodes with
    LOCALHOST ignore multicast, and would be found by their own next search only.

    Raises:
        InputError: A value is unknown.
    """
    given, peers = _find_range(environment)
    if given == "SYSTEM_DEFAULT":
        return ""
    if given == "OFF":  # another process cannot have this tag
        discovery = f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>"
        return _wrap_settings(f"{_QUIET}<Discovery>{discovery}</Discovery>")
    listed = "".join(f'<Peer Address="{peer}"/>' for peer in ("localhost", *peers))
    # Nodes of this machine without multicast search the ports of the participants up to this index.
    index = f"<MaxAutoParticipantIndex>{_MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
    discovery = f"<ParticipantIndex>auto</ParticipantIndex>{index}<Peers>{listed}</Peers>"
    general = _QUIET if given == "LOCALHOST" else ""
    return _wrap_settings(f"{general}<Discovery>{discovery}</Discovery>")


def _wrap_settings(settings: str) -> str:
    return f"<CycloneDDS><Domain>{settings}</Domain></CycloneDDS>"


def _find_range(environment: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return the range of discovery and the addresses of static peers. Raises InputError."""
    local, given = environment.get(_LOCAL, ""), environment.get(_RANGE) or _RANGES[0]
    if local not in ("", "0", "1"):
        raise InputError(f"{_LOCAL} = {shorten(local)}: must be 0 or 1")
    if given not in _RANGES:
        raise InputError(f"{_RANGE} = {shorten(given)}: must be one of {', '.join(_RANGES)}")
    peers = [peer.strip() for peer in environment.get(_PEERS, "").split(";") if peer.strip()]
    for peer in peers:
        if not _ADDRESS.fullmatch(peer):
            raise InputError(
                f"{_PEERS}: {shorten(peer)}: must be addresses or names of hosts, separated by ;"
            )
    return ("LOCALHOST", []) if local == "1" else (given, peers)


# Endpoints


def join_domain() -> DomainParticipant:
    """Join the domain, with the discovery that ROS's environment variables set.

    Raises InputError for an invalid variable, RunError if DDS cannot be started.
    """
    given = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not given.isdecimal() or int(given) > _HIGHEST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID = {given!r}: must be a whole number from 0 to {_HIGHEST_DOMAIN}")
    settings = discovery_settings(os.environ)
    for peer in _find_range(os.environ)[1]:
        if f'"{peer}"' in settings:
            _require_host(peer)
    try:
        with _cyclone_settings(settings):
            return DomainParticipant(int(given))
    except DDSException as error:
        raise RunError(f"ROS 2: no DDS participant in domain {given}: {error.msg or error}") from error


def _require_host(peer: str) -> None:
    """Raise InputError for a peer (HOST or HOST:PORT) to which Cyclone DDS cannot send: it would end the process."""
    host, mark, port = peer.partition(":") if peer.count(":") == 1 else (peer, "", "")
    try:
        addresses = {address[0] for *_, address in getaddrinfo(host, None, AF_INET)}
    except (OSError, UnicodeError):
        addresses = set()
    if not addresses or _ANY_ADDRESS in addresses:
        raise InputError(
            f"{_PEERS}: {shorten(peer)}: must be a known host or an IPv4 address (not {_ANY_ADDRESS})"
        )
    if mark and not (_PORT.fullmatch(port) and 0 < int(port) <= _HIGHEST_PORT):
        raise InputError(f"{_PEERS}: {shorten(peer)}: the port must be from 1 to {_HIGHEST_PORT}")


@contextmanager
def _cyclone_settings(settings: str) -> Iterator[None]:
    """Put settings before the user's in CYCLONEDDS_URI, where Cyclone DDS reads them, within the block only."""
    given = os.environ.get(_URI)
    os.environ[_URI] = ",".join(filter(None, (settings, given)))
    try:
        yield
    finally:
        if given is None:
            del os.environ[_URI]
        else:
            os.environ[_URI] = given


class TopicWriter:
    """Publishes messages of one type without waiting: if a reader does not keep up, old samples are replaced.

    Reliable, so that reliable and best-effort subscribers match, with a short history: a slow subscriber misses
    samples. latched: later subscribers receive the last message, too. quality: policies in place of these.
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
        usual = _make_quality(kind, 1 if latched else _DEPTH, reliable=True, latched=latched)
        qos = Qos(*(quality or ()), base=usual)
        self._writer: Any = DataWriter(domain, _make_topic(domain, topic, kind), qos=qos)

    def write(self, message: Any) -> None:
        """Publish a message; drop it if DDS has no room for it."""
        try:
            self._writer.write(CdrSample(bytes(STORE.serialize_cdr(message, self._kind))))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise RunError(f"ROS 2: a message cannot be published: {error.msg or error}") from error

    @property
    def readers(self) -> int:
        """Number of subscribers."""
        return _count(self._writer.get_matched_subscriptions)


class TopicReader:
    """Receives messages of one type; only with `latched` also the last one from before it was made."""

    def __init__(
        self,
        domain: DomainParticipant,
        topic: str,
        kind: str,
        *,
        reliable: bool = True,
        latched: bool = False,
    ) -> None:
        qos = _make_quality(kind, _TAKEN, reliable=reliable, latched=latched)
        self._reader: Any = DataReader(domain, _make_topic(domain, topic, kind), qos=qos)
        self.condition = ReadCondition(self._reader, _ANY)

    def take(self) -> Iterator[tuple[bytes, tuple[int, int]]]:
        """Yield the data received since the last call, each with its publisher and the publisher's time stamp."""
        for sample in self._reader.take(N=_TAKEN):
            if isinstance(sample, CdrSample):
                info: Any = sample.sample_info
                yield sample.data, (info.publication_handle, info.source_timestamp)

    @property
    def writers(self) -> int:
        """Number of publishers."""
        return _count(self._reader.get_matched_publications)


def make_waitset(domain: DomainParticipant, readers: list[TopicReader]) -> WaitSet:
    """Return an object that waits until one of the readers has data."""
    waitset = WaitSet(domain)
    for reader in readers:
        waitset.attach(reader.condition)
    return waitset


class DomainDirectory:
    """The discovered participants of a domain and their publishers."""

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
    """Count matches. Cyclone DDS asks twice, and raises IndexError if the second answer is larger."""
    while True:
        try:
            return len(matched())
        except IndexError:
            continue


def _make_quality(kind: str, depth: int, *, reliable: bool, latched: bool) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=0) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(make_user_data(kind)),
    )


def _make_topic(domain: DomainParticipant, topic: str, kind: str) -> Any:
    made: Any = Topic(domain, to_dds_topic(topic), make_idl_type(kind))
    made.data_type = CdrSample
    return made
