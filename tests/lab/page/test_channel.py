"""Messages in the pipes of workers."""

import asyncio
import io

import pytest

from flexneedle.errors import RunError
from flexneedle.lab.page.channel import LONGEST, packed, read, received

MESSAGES = ['{"job": 3}', '{"text": "σ"}', bytes([1, 3, 0, 0]) + b"{}"]


def test_messages_are_read_as_they_were_written():
    pipe = io.BytesIO(b"".join(map(packed, MESSAGES)))
    assert [read(pipe) for _ in MESSAGES] == MESSAGES
    assert read(pipe) is None


def streamed(data: bytes):
    async def listen():
        stream = asyncio.StreamReader()
        stream.feed_data(data)
        stream.feed_eof()
        return [await received(stream) for _ in range(len(MESSAGES) + 1)]

    return asyncio.run(listen())


def test_the_server_reads_the_same():
    assert streamed(b"".join(map(packed, MESSAGES))) == [*MESSAGES, None]


@pytest.mark.parametrize("cut", [1, 4, 6])
def test_a_message_that_is_cut_off_is_the_end(cut):
    assert read(io.BytesIO(packed(MESSAGES[0])[:cut])) is None
    assert streamed(packed(MESSAGES[0])[:cut]) == [None] * 4


@pytest.mark.parametrize("length", [0, LONGEST + 1])
def test_a_length_that_is_none_is_refused(length):
    with pytest.raises(RunError, match=f"a message of {length} bytes: must have 1 to"):
        read(io.BytesIO(length.to_bytes(4, "little") + b"{}"))


def test_a_text_must_be_utf8():
    with pytest.raises(RunError, match="not UTF-8"):
        read(io.BytesIO(packed(b"{\xff}")))
