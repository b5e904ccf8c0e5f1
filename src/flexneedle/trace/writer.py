"""`trace.mcap`: a run as standard ROS 2 messages, complete up to the last period even if the process is killed.

Each period is one chunk (uncompressed), written at once when the period ends, so that the file ends with a complete
record.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer

from flexneedle.files import uninterrupted
from flexneedle.trace.messages import STORE
from flexneedle.trace.topics import LATCHED, TOPICS, TopicMessage, period_messages, plan_message
from flexneedle.types import Period, Plan

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
    `scenario.json`. Raises FileExistsError if the file exists.
    """

    def __init__(
        self, path: Path, plan: Plan, *, about: Mapping[str, str], scenario: Mapping[str, Any]
    ) -> None:
        self._file = path.open("xb", buffering=_CHUNK_SIZE)
        self._writer = Writer(self._file, chunk_size=_CHUNK_SIZE, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="flexneedle")
        self._writer.add_metadata("flexneedle", dict(about))
        text = json.dumps(scenario, indent=1, ensure_ascii=False, allow_nan=False)
        self._writer.add_attachment(0, 0, "scenario.json", "application/json", text.encode())
        self._channels = self._register()
        self._count = 0
        self._write([plan_message(plan.tips)])

    def add(self, period: Period) -> None:
        """Write a period to the file."""
        self._write(list(period_messages(period)))

    def close(self) -> None:
        """Write the index and close the file; without an index the file is readable as well."""
        if self._file.closed:
            return
        with uninterrupted():
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates no result
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trail: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, messages: Iterable[TopicMessage]) -> None:
        """Write messages as one chunk and flush it."""
        with uninterrupted():
            for one in messages:
                data = bytes(STORE.serialize_cdr(one.message, TOPICS[one.topic]))
                self._writer.add_message(self._channels[one.topic], one.time, data, one.time, self._count)
            self._writer.flush()  # type: ignore[no-untyped-call]  # mcap annotates no result
            self._count += 1

    def _register(self) -> dict[str, int]:
        """Register types and topics; return the channel of each topic."""
        schemas = {kind: self._schema(kind) for kind in dict.fromkeys(TOPICS.values())}
        return {topic: self._channel(topic, schemas[kind]) for topic, kind in TOPICS.items()}

    def _schema(self, kind: str) -> int:
        definition, _ = STORE.generate_msgdef(kind, ros_version=2)
        return int(self._writer.register_schema(kind, "ros2msg", definition.encode()))

    def _channel(self, topic: str, schema: int) -> int:
        qos = {"offered_qos_profiles": _LATCHED_QOS} if topic in LATCHED else {}
        return int(self._writer.register_channel(topic, "cdr", schema, qos))
