"""Bytes of messages: against pyigtl, and against vectors written by hand from the specification."""

import struct

import numpy as np
import pytest
from pyigtl import messages as other

from flexneedle.errors import InputError
from flexneedle.lab.igtl.codec import Decoder, Query, Skipped, pack, pack_refusal
from flexneedle.lab.igtl.crc import crc64
from flexneedle.lab.igtl.messages import (
    PointMessage,
    PolylineMessage,
    PositionMessage,
    StatusMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from igtl_messages import EXAMPLES, MATRIX, TARGET

HEADER = 58


def body(message):
    return pack(message)[HEADER:]


def theirs():
    """The messages of pyigtl that equal ours."""
    points = EXAMPLES["POINT"].points
    lists = {
        "names": [one.name for one in points],
        "groups": [one.group for one in points],
        "owners": [one.owner for one in points],
        "diameters": [one.diameter for one in points],
    }
    line = np.array([3, 0, 1, 2])
    shape = other.PolyDataMessage(
        points=np.array(EXAMPLES["POLYDATA"].points), lines=line, device_name="Needle"
    )
    return {
        "TRANSFORM": other.TransformMessage(np.array(MATRIX), device_name="Tip"),
        "STRING": other.StringMessage("0.4 mm", device_name="Error"),
        "POINT": other.PointMessage([one.position for one in points], device_name="Target", **lists),
        "POLYDATA": shape,
    }


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["TRANSFORM", "STRING", "POINT", "POLYDATA"])
def test_packets_are_those_of_pyigtl(kind, version):
    message = theirs()[kind]
    message.timestamp, message.header_version = 1.5, version
    assert pack(EXAMPLES[kind], version) == message.pack()


def test_metadata_of_pyigtl_is_read_and_ours_is_read_by_pyigtl():
    message = other.StringMessage("a", device_name="b", timestamp=0.0)
    message.header_version, message.metadata = 2, {"Status": "OK", "age": "3"}
    ours = StringMessage(name="b", text="a", metadata=message.metadata)
    assert Decoder().feed(message.pack()) == [ours]
    packet = pack(ours, 2)
    read = other.MessageBase.create_message("STRING")
    read.unpack(other.MessageBase.parse_header(packet[:HEADER]), packet[HEADER:])
    assert (read.string, read.metadata) == ("a", ours.metadata)


@pytest.mark.parametrize("size", [0, 1, 7, 8, 48, 511, 512, 513, 519, 520, 1024, 5000])
def test_crc_of_any_length_is_that_of_pyigtl(size):
    data = np.random.default_rng(size).bytes(size)
    assert crc64(data) == other.CRC64(data)


def test_crc_has_the_check_value_of_ecma_182():
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_header_has_version_type_name_time_size_and_crc():
    packet = pack(TransformMessage(name="Tip", time=2.25, matrix=MATRIX))
    kind, name = b"TRANSFORM\0\0\0", b"Tip" + 17 * b"\0"
    assert packet[:34] == b"\0\1" + kind + name
    assert packet[34:50] == bytes([0, 0, 0, 2, 0x40, 0, 0, 0]) + bytes([0, 0, 0, 0, 0, 0, 0, 48])
    assert packet[50:58] == crc64(packet[58:]).to_bytes(8, "big")


def test_status_has_code_subcode_error_name_and_a_text_with_a_zero_byte():
    message = StatusMessage(name="a", code=13, subcode=0x200, error="Busy", text="Hi")
    assert body(message) == bytes.fromhex("000d 0000000000000200") + b"Busy" + 16 * b"\0" + b"Hi\0"


def test_trajectory_has_150_bytes():
    path = Trajectory(
        name="N",
        group="G",
        entry=(1.0, 2.0, 3.0),
        target=(-1.0, 0.5, 0.0),
        color=(1, 2, 3, 4),
        radius=2.0,
        owner="O",
    )
    lengths = bytes.fromhex("3f800000 40000000 40400000 bf800000 3f000000 00000000 40000000")
    expected = b"N" + 63 * b"\0" + b"G" + 31 * b"\0" + bytes([3, 0, 1, 2, 3, 4]) + lengths + b"O" + 19 * b"\0"
    assert body(TrajectoryMessage(name="a", trajectories=(path,))) == expected
    assert len(expected) == 150


@pytest.mark.parametrize(
    ("entry", "target", "kind"), [((1.0, 2.0, 3.0), None, 1), (None, (1.0, 2.0, 3.0), 2)]
)
def test_trajectory_may_lack_an_end(entry, target, kind):
    message = TrajectoryMessage(name="a", trajectories=(Trajectory(name="", entry=entry, target=target),))
    assert body(message)[96] == kind
    assert Decoder().feed(pack(message)) == [message]


def test_an_entry_is_read_from_a_trajectory_that_the_cpp_library_calls_target_only():
    path = Trajectory(name="", entry=(1.0, 2.0, 3.0), target=(0.0, 0.0, 0.0))
    content = bytearray(TrajectoryMessage(name="a", trajectories=(path,)).encode())
    content[96] = 2
    (read,) = Decoder().feed(framed("TRAJ", bytes(content)))
    assert read.trajectories == (path,)


def test_position_has_the_quaternion_with_w_last():
    message = PositionMessage(name="a", position=(1.0, 2.0, 3.0), orientation=(0.5, -0.5, 0.25, 0.0))
    floats = "3f800000 40000000 40400000 bf000000 3e800000 00000000 3f000000"
    assert body(message) == bytes.fromhex(floats)


def test_polydata_has_ten_counts_points_and_a_line():
    message = PolylineMessage(name="a", points=((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)))
    counts = struct.pack(">10I", 2, 0, 0, 1, 12, 0, 0, 0, 0, 0)
    points = bytes.fromhex("3f800000 40000000 40400000 00000000 00000000 3f800000")
    assert body(message) == counts + points + bytes([0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 1])


def test_a_text_that_is_not_ascii_is_utf_8():
    assert body(StringMessage(name="a", text="µ")) == bytes([0, 106, 0, 2, 0xC2, 0xB5])


def test_a_query_is_recognised_and_answered_by_an_error():
    packet = b"\0\1STT_TRANSFOR" + b"Tip" + 17 * b"\0" + bytes(24)
    assert Decoder().feed(packet) == [Query("STT_TRANSFOR", "Tip")]
    answer = pack_refusal(Query("STT_TRANSFOR", "Tip"))
    assert answer[2:14] == b"RTS_TRANSFOR"
    assert answer[HEADER:] == b"\1"


@pytest.mark.parametrize(
    "message",
    [
        StringMessage(name="x" * 21, text=""),
        StringMessage(name="a\0", text=""),
        StringMessage(name="a", text="x" * 65_536),
        StringMessage(name="a", text="", time=-1.0),
        StringMessage(name="a", text="", time=float("nan")),
        StatusMessage(name="a", code=0),
        StatusMessage(name="a", code=1, subcode=1 << 63),
        StatusMessage(name="a", code=1, error="x" * 21),
        StatusMessage(name="a", code=1, text="a\0b"),
        TransformMessage(name="a", matrix=MATRIX[:3]),
        TransformMessage(name="a", matrix=(*MATRIX[:3], (0.0, 0.0, 0.0, 2.0))),
        TransformMessage(name="a", matrix=((float("nan"), 0.0, 0.0, 0.0), *MATRIX[1:])),
        TransformMessage(name="a", matrix=((1e39, 0.0, 0.0, 0.0), *MATRIX[1:])),
        PolylineMessage(name="a", points=((0.0, 0.0, 0.0),)),
        PolylineMessage(name="a", points=((0.0, 0.0, 0.0),) * 70_000),
        TrajectoryMessage(name="a", trajectories=(Trajectory(name="", entry=None, target=None),)),
        TrajectoryMessage(
            name="a",
            trajectories=(Trajectory(name="", entry=(0.0, 0.0, 0.0), target=None, color=(0, 0, 0, 256)),),
        ),
    ],
)
def test_values_that_do_not_fit_are_refused(message):
    with pytest.raises(InputError):
        pack(message)


@pytest.mark.parametrize(
    "metadata", [{"k" * 65_536: ""}, {str(key): "" for key in range(8192)}, {"k": "v" * (1 << 20)}]
)
def test_metadata_that_does_not_fit_is_refused(metadata):
    with pytest.raises(InputError):
        pack(StringMessage(name="a", text="", metadata=metadata), 2)


def framed(kind, content, version=1):
    head = struct.pack(">H12s20sQQQ", version, kind.encode(), b"a", 0, len(content), crc64(content))
    return head + content


POLYDATA = PolylineMessage(name="a", points=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))).encode()
NAN = bytes.fromhex("7fc00000")


@pytest.mark.parametrize(
    ("kind", "content", "version", "reason"),
    [
        ("TRANSFORM", b"", 1, "0 bytes: must be 48"),
        ("TRANSFORM", NAN * 12, 1, "finite"),
        ("POSITION", bytes(24), 1, "24 bytes: must be 28"),
        ("POINT", bytes(135), 1, "135 bytes: must be a multiple of 136"),
        ("POINT", bytes(100) + NAN + bytes(32), 1, "finite"),
        ("TRAJ", bytes(150), 1, "type 0"),
        ("TRAJ", bytes(151), 1, "multiple of 150"),
        ("STATUS", bytes(29), 1, "at least 30"),
        ("STRING", b"\0\3", 1, "encoding"),
        ("STRING", b"\0\4\0\1a", 1, "encoding"),
        ("STRING", b"\0\3\0\2a", 1, "length"),
        ("POLYDATA", bytes(39), 1, "at least 40"),
        ("POLYDATA", POLYDATA[:-1], 1, "one line"),
        ("POLYDATA", POLYDATA[:36] + b"\0\0\0\1" + POLYDATA[40:], 1, "one line"),
        ("POLYDATA", POLYDATA[:-1] + b"\2", 1, "point that is missing"),
        ("POLYDATA", POLYDATA[:-9] + b"\3" + POLYDATA[-8:], 1, "another length"),
        ("STRING", b"\0\3\0\0", 2, "an extended header has 12"),
        ("STRING", struct.pack(">HHII", 12, 0, 5, 0) + b"\0\3\0\0", 2, "within the body"),
        ("STRING", struct.pack(">HHII", 11, 0, 0, 0) + b"\0\3\0\0", 3, "within the body"),
        ("STRING", struct.pack(">HHII", 12, 2, 0, 0) + b"\0\3\0\0\0\1", 2, "number of keys"),
        ("STRING", struct.pack(">HHII", 12, 10, 0, 0) + b"\0\3\0\0\0\1\0\1\0\3\0\0\0\1", 2, "sizes"),
    ],
)
def test_contents_that_break_a_rule_are_skipped(kind, content, version, reason):
    decoder = Decoder()
    packet = framed(kind, content, version)
    (skipped, after) = decoder.feed(packet + pack(EXAMPLES["TRANSFORM"]))
    assert isinstance(skipped, Skipped)
    assert reason in skipped.reason
    assert after == EXAMPLES["TRANSFORM"]


def test_an_extended_header_may_be_longer_and_have_no_metadata():
    content = struct.pack(">HHII", 14, 0, 0, 7) + b"\xff\xff" + b"\0\3\0\1x"
    decoder = Decoder()
    assert decoder.feed(framed("STRING", content, 3)) == [StringMessage(name="a", text="x")]
    assert decoder.version == 2


def test_the_order_of_a_received_line_is_kept():
    line = struct.pack(">3I", 2, 1, 0)
    (read,) = Decoder().feed(framed("POLYDATA", POLYDATA[:-12] + line))
    assert read.points == ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


def test_points_are_read_with_all_their_fields():
    (read,) = Decoder().feed(pack(EXAMPLES["POINT"]))
    assert isinstance(read, PointMessage)
    assert read.points[0] == TARGET
