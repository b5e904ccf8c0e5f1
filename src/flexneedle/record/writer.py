"""`trace.mcap`: a run as standard ROS 2 messages, complete up to the last period even if the process is killed.

Each period is one uncompressed chunk. It is passed to the operating system when the period ends, so that the file ends
with a complete record. No period waits for the disk: the system writes its cache later, and a power failure may cost
the periods of the last half minute.
"""

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.writer import CompressionType, Writer

from flexneedle.errors import RecordError
from flexneedle.interrupts import delay_signals
from flexneedle.record.messages import STORE
from flexneedle.record.topics import LATCHED, OPTIONAL, TOPICS, TopicMessage, period_messages, plan_message
from flexneedle.results import Period, Plan

# A period has about 10 kB; a chunk or buffer that fills up within a period would split it.
_CHUNK_SIZE = 1 << 24
_LATCHED_QOS = """\
- history: 3
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


class TraceWriter:
    """Writes a run to a new file. Use it as a context manager, or call `close`.

    about: metadata `flexneedle` of the file, such as seed and versions; scenario: nested values, attached as
    `scenario.json`. Raises FileExistsError if the file exists. All functions raise RecordError if the file
    cannot be written; earlier periods are kept, and the writer is closed.
    """

    def __init__(
        self, path: Path, plan: Plan, *, about: Mapping[str, str], scenario: Mapping[str, Any]
    ) -> None:
        self._path, self._count = path, 0
        self._file = _open_new(path)
        self._writer = Writer(self._file, chunk_size=_CHUNK_SIZE, compression=CompressionType.NONE)
        try:
            with self._writing():
                self._begin(about, scenario)
                self._write([plan_message(plan.tips)])
        except RecordError:
            path.unlink()  # without its beginning it is no trace
            raise

    def add(self, period: Period) -> None:
        """Write a period to the file."""
        with self._writing():
            self._write(list(period_messages(period)))

    def close(self) -> None:
        """Write the index and close the file; without an index the file is readable as well."""
        if self._file.closed:
            return
        with self._writing():
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trail: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Delay Ctrl-C until a record is written. If it cannot be, close the file as it is."""
        try:
            with delay_signals():
                yield
        except OSError as error:
            with suppress(OSError):  # the buffer cannot be written either
                self._file.close()
            raise RecordError.of(self._path, error) from error

    def _begin(self, about: Mapping[str, str], scenario: Mapping[str, Any]) -> None:
        """Write metadata and scenario; register types and topics."""
        self._writer.start(profile="ros2", library="flexneedle")
        self._writer.add_metadata("flexneedle", dict(about))
        text = json.dumps(scenario, indent=1, ensure_ascii=False, allow_nan=False)
        self._writer.add_attachment(0, 0, "scenario.json", "application/json", text.encode())
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._register([topic for topic in TOPICS if topic not in OPTIONAL])

    def _register(self, topics: Collection[str]) -> None:
        """Register topics and their types; the types come first."""
        for kind in dict.fromkeys(TOPICS[topic] for topic in topics):
            if kind not in self._schemas:
                definition, _ = STORE.generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = int(self._writer.register_schema(kind, "ros2msg", definition.encode()))
        for topic in topics:
            qos = {"offered_qos_profiles": _LATCHED_QOS} if topic in LATCHED else {}
            schema = self._schemas[TOPICS[topic]]
            self._channels[topic] = int(self._writer.register_channel(topic, "cdr", schema, qos))

    def _write(self, messages: Iterable[TopicMessage]) -> None:
        """Write messages as one chunk and flush it."""
        for one in messages:
            if one.topic not in self._channels:
                self._register([one.topic])
            data = bytes(STORE.serialize_cdr(one.message, TOPICS[one.topic]))
            self._writer.add_message(self._channels[one.topic], one.time, data, one.time, self._count)
        self._writer.flush()
        self._count += 1


def _open_new(path: Path) -> BinaryIO:
    try:
        return path.open("xb", buffering=_CHUNK_SIZE)
    except FileExistsError:
        raise
    except OSError as error:
        raise RecordError.of(path, error) from error
