"""The decoder on streams: round trips, any cut, other types, damaged bytes."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.igtl.codec import MOST_BYTES, MOST_SKIPPED, Decoder, Skipped, pack
from flexneedle.lab.igtl.crc import crc64
from flexneedle.lab.igtl.messages import (
    MESSAGES,
    Message,
    NamedPoint,
    PointMessage,
    PolylineMessage,
    PositionMessage,
    StatusMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from igtl_messages import EXAMPLES

numbers = st.floats(width=32, allow_nan=False, allow_infinity=False)
points = st.tuples(numbers, numbers, numbers)
colors = st.tuples(*[st.integers(0, 255)] * 4)


def texts(size):
    printable = st.characters(exclude_categories=("C", "Z"))
    return st.text(printable, max_size=size).filter(lambda text: len(text.encode()) <= size)


def of(kind, **fields):
    times = st.integers(0, (1 << 48) - 1).map(lambda ticks: ticks / (1 << 16))
    metadata = st.dictionaries(texts(9), texts(9), max_size=3)
    return st.builds(kind, name=texts(20), time=times, metadata=metadata, **fields)


rows = st.tuples(numbers, numbers, numbers, numbers)
matrices = st.tuples(rows, rows, rows, st.just((0.0, 0.0, 0.0, 1.0)))
named = st.builds(
    NamedPoint,
    name=texts(64),
    group=texts(32),
    owner=texts(20),
    position=points,
    color=colors,
    diameter=numbers,
)
paths = st.builds(
    Trajectory,
    name=texts(64),
    group=texts(32),
    owner=texts(20),
    entry=points,
    target=st.none() | points,
    color=colors,
    radius=numbers,
)
messages = st.one_of(
    of(TransformMessage, matrix=matrices),
    of(PositionMessage, position=points, orientation=st.tuples(*[numbers] * 4)),
    of(PointMessage, points=st.lists(named, max_size=3).map(tuple)),
    of(TrajectoryMessage, trajectories=st.lists(paths, max_size=3).map(tuple)),
    of(PolylineMessage, points=st.lists(points, min_size=2, max_size=9).map(tuple)),
    of(
        StatusMessage,
        code=st.integers(1, 65_535),
        subcode=st.integers(-(1 << 63), (1 << 63) - 1),
        error=texts(20),
        text=texts(99),
    ),
    of(StringMessage, text=st.text(st.characters(exclude_categories=("Cs",)), max_size=99)),
)
streams = st.lists(st.tuples(messages, st.sampled_from([1, 2])), min_size=1, max_size=4)


@given(messages)
def test_a_message_survives_its_packet(message):
    assert Decoder().feed(pack(message, 2)) == [message]


@given(streams, st.lists(st.integers(0, 2000), max_size=6))
def test_a_stream_may_be_cut_anywhere(stream, cuts):
    data = b"".join(pack(message, version) for message, version in stream)
    decoder, found = Decoder(), []
    ends = sorted({min(cut, len(data)) for cut in cuts} | {len(data)})
    for begin, end in zip([0, *ends], ends, strict=False):
        found += decoder.feed(data[begin:end])
    assert [(one.type, one.name, one.time) for one in found] == [
        (one.type, one.name, one.time) for one, _ in stream
    ]
    assert found == Decoder().feed(data)
    assert decoder.version == max(version for _, version in stream)


@given(st.sampled_from(list(EXAMPLES)), st.integers(50, 400), st.binary(min_size=1, max_size=8))
def test_a_damaged_body_or_crc_is_refused(kind, place, noise):
    packet = bytearray(pack(EXAMPLES[kind]))
    place = min(place, len(packet) - len(noise))
    packet[place : place + len(noise)] = noise
    if packet == pack(EXAMPLES[kind]):
        return
    decoder = Decoder()
    assert decoder.feed(packet) == []
    assert "CRC" in decoder.refused
    assert decoder.feed(pack(EXAMPLES[kind])) == []


@given(streams, st.lists(st.tuples(st.integers(0, 3000), st.binary(max_size=4)), min_size=1, max_size=5))
def test_damaged_streams_give_only_messages_whose_crc_matches(stream, damages):
    data = bytearray(b"".join(pack(message, version) for message, version in stream))
    for place, noise in damages:
        data[place : place + 2] = noise
    decoder = Decoder()
    for one in decoder.feed(data):
        if isinstance(one, Message):
            assert type(one).decode(one.encode(), name="a").encode() in bytes(data)
    assert decoder.refused.isprintable()


@given(st.binary(max_size=300))
def test_any_bytes_are_read_without_an_exception(data):
    decoder = Decoder()
    decoder.feed(data)
    decoder.feed(b"\0\1" + data)
    assert decoder.refused.isprintable()


def header(version=1, kind=b"TRANSFORM", size=48, crc=0):
    return struct.pack(">H12s20sQQQ", version, kind, b"a", 0, size, crc)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (
            b"GET / HTTP/1.1\r\nHost: localhost:18944\r\nAccept: */*\r\nConnection: close\r\n",
            "header version 18245",
        ),
        (header(version=0), "header version 0: must be 1 to 3"),
        (header(version=4), "header version 4"),
        (header(kind=b""), "type b''"),
        (header(kind=b"A\0B"), "type b'A\\x00B'"),
        (header(kind=b"\xff"), "type b'\\xff'"),
        (header(size=MOST_BYTES + 1), f"TRANSFORM of {MOST_BYTES + 1} bytes"),
        (header(kind=b"IMAGE", size=MOST_SKIPPED + 1), "IMAGE of"),
        (header(crc=1) + bytes(48), "TRANSFORM of 48 bytes: the CRC does not match"),
    ],
)
def test_garbage_is_refused_with_its_reason(data, reason):
    decoder = Decoder()
    assert decoder.feed(pack(EXAMPLES["STRING"]) + data) == [EXAMPLES["STRING"]]
    assert decoder.refused.startswith(reason)


def test_an_image_is_skipped_without_being_stored():
    size, decoder = 3_000_000, Decoder()
    assert decoder.feed(header(kind=b"IMAGE", size=size)) == [Skipped("IMAGE", "a", "not supported")]
    for _ in range(size // 1000):
        assert decoder.feed(bytes(1000)) == []
        assert len(decoder._data) <= 1000
    assert decoder.feed(pack(EXAMPLES["STATUS"])) == [EXAMPLES["STATUS"]]


@pytest.mark.parametrize("kind", MESSAGES)
def test_one_wrong_bit_anywhere_in_the_body_is_found(kind):
    packet = bytearray(pack(EXAMPLES[kind]))
    for bit in range(8 * 58, 8 * len(packet)):
        packet[bit // 8] ^= 1 << bit % 8
        assert crc64(bytes(packet[58:])) != int.from_bytes(packet[50:58], "big")
        packet[bit // 8] ^= 1 << bit % 8
