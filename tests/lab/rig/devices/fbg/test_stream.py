"""The stream of FBGS: frames from bytes that are written by hand here, and what is no frame."""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from flexneedle.lab.rig.devices.fbg.stream import MOST_BYTES, FrameDecoder, FrameError, decode_payload

sys.path.insert(0, str(Path(__file__).resolve().parents[5] / "campaigns"))
import fuzz_fbgs
import fuzzing

# Two values: 0.002 and 0.004 1/mm at 0.5 and -0.25 rad, of fibre 3, line 258, timestamp 1.5.
ARRAYS = {
    3: bytes.fromhex("02000000 6f12033b 6f12833b"),
    4: bytes.fromhex("02000000 0000003f 000080be"),
}
PAYLOAD = bytes.fromhex(
    "03"  # fibre
    "04000000 0000 0000"  # error
    "0a000000 0100 0201000000000000"  # line
    "0a000000 0200 000000000000f83f"  # timestamp
    "0e000000 0300 02000000 6f12033b 6f12833b"
    "0e000000 0400 02000000 0000003f 000080be"
    "0a000000 0500 0000000000000000"  # shape
    "06000000 0600 00000000"  # temperature
)
FRAME = struct.pack("<I", len(PAYLOAD)) + PAYLOAD


def field(kind, content):
    return struct.pack("<iH", len(content) + 2, kind) + content


def test_a_frame_is_read_from_its_bytes():
    (found,) = FrameDecoder().feed(FRAME)
    assert (found.fibre, found.error, found.line, found.stamp) == (3, 0, 258, 1.5)
    expected = [0.002 * np.exp(0.5j), 0.004 * np.exp(-0.25j)]
    np.testing.assert_allclose(found.bends, expected, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 3, 7, 1000])
def test_frames_may_arrive_in_pieces(size):
    decoder, data, found = FrameDecoder(), 3 * FRAME, []
    for at in range(0, len(data), size):
        found += decoder.feed(data[at : at + size])
    assert [one.line for one in found] == [258] * 3


def test_a_frame_needs_no_field_and_unknown_ones_are_skipped():
    assert len(decode_payload(b"\1").bends) == 0
    assert decode_payload(b"\1" + field(9, b"new") + field(0, b"\7\0")).error == 7


@pytest.mark.parametrize(
    ("payload", "rule"),
    [
        (b"", "empty"),
        (b"\0\1\2", "the last field is cut"),
        (PAYLOAD[:-1], "length"),
        (b"\0" + struct.pack("<iH", 1, 0), "length of 1"),
        (b"\0" + struct.pack("<iH", -5, 0), "length of -5"),
        (b"\0" + field(1, b"\0" * 7), "7 bytes, expected 8"),
        (b"\0" + field(3, ARRAYS[3][:-1]), "count"),
        (b"\0" + field(3, b""), "count"),
        (b"\0" + field(3, b"\xff\xff\xff\xff\0\0\0\0"), "count"),
        (b"\0" + field(3, ARRAYS[3]), "2 curvatures and 0 angles"),
        (b"\0" + 2 * field(2, b"\0" * 8), "two fields 2"),
    ],
)
def test_what_is_not_wholly_a_frame_is_refused(payload, rule):
    with pytest.raises(FrameError, match=rule):
        decode_payload(payload)


def test_a_wrong_payload_is_skipped_as_a_whole_and_the_next_frame_is_read():
    decoder = FrameDecoder()
    wrong = struct.pack("<I", 3) + b"\0\1\2"
    assert len(decoder.feed(FRAME + wrong + FRAME)) == 2
    assert decoder.feed(wrong) == []
    assert (decoder.skipped, decoder.refused) == ("the last field is cut", "")


@pytest.mark.parametrize("length", [0, MOST_BYTES + 1, 0xFFFFFFFF])
def test_an_impossible_length_ends_the_stream(length):
    decoder = FrameDecoder()
    assert len(decoder.feed(FRAME + struct.pack("<I", length) + FRAME)) == 1
    assert decoder.refused.startswith(f"a frame of {length} bytes")
    assert decoder.feed(FRAME) == []


def test_a_stream_of_other_bytes_ends():
    decoder = FrameDecoder()
    assert decoder.feed((struct.pack("<I", 3) + b"\0\1\2") * 10 + FRAME) == []
    assert decoder.refused


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, 1.5])
def test_a_curvature_that_no_needle_has_is_no_number(value):
    arrays = field(3, struct.pack("<Iff", 2, value, 0.001)) + field(4, struct.pack("<Iff", 2, 0.0, 0.0))
    bends = decode_payload(b"\0" + arrays).bends
    assert np.isnan(bends[0])
    assert bends[1] == pytest.approx(0.001, rel=1e-5)


def test_any_bytes_may_be_decoded():
    done, note = fuzzing.run(fuzz_fbgs.decoder, 3000, 20.0, seed=7)
    assert done == 3000
    assert all(kind in note for kind in ("frames", "with values", "skipped", "refused"))


def test_a_sensor_survives_any_bytes_and_reads_the_frames_after_them():
    assert fuzzing.run(fuzz_fbgs.live, 400, 20.0, seed=7)[0] == 400
