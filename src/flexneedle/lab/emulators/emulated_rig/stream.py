"""Records between the processes of an emulated rig.

A record has a time (s, monotonic clock), numbers, and whether the described part moves from then on. It is known up to
the time of the newest record.
"""

import select
from typing import NamedTuple

from flexneedle.errors import RunError
from flexneedle.lab.process import MessageChannel

_MOST_WAITING = 100


class Record(NamedTuple):
    """Time (s), numbers, and whether they change from then on."""

    time: float
    values: tuple[float, ...]
    moving: bool


class ChannelEnded(Exception):
    """The process at the other end has ended."""


def send_record(channel: MessageChannel, record: Record, to: str) -> None:
    """Send a record without waiting.

    Args:
        channel: Channel to the reader.
        record: The record.
        to: Name of the reader in errors.

    Raises:
        ChannelEnded: The reader has ended.
        RunError: The reader is thousands of records behind.
    """
    if not channel.send(record):
        raise ChannelEnded
    if channel.waiting > _MOST_WAITING:
        raise RunError(f"the {to} does not keep up")


def receive_records(channel: MessageChannel) -> list[Record]:
    """Return the records that have arrived, oldest first, without waiting. Raises ChannelEnded after the last."""
    records = channel.receive()
    if channel.ended and not records:
        raise ChannelEnded
    return records


def receive_first(channel: MessageChannel) -> Record:
    """Wait for the first records, and return the newest. Raises ChannelEnded."""
    while not (records := receive_records(channel)):
        select.select([channel], [], [])
    return records[-1]
