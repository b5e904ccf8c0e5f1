"""The wire format, compared with replies and checksums expected by NDI's clients."""

import struct

import numpy as np
import pytest

from flexneedle.lab.emulators import codec
from flexneedle.lab.emulators.motion import EmulatedPose


def test_checksums_and_replies_are_those_of_ndicapi():
    checksums = {b"INIT:": 0xE3A5, b"VER:0": 0x65EE, b"GETINFO:Features.Firmware.Version": 0x0492}
    assert {command: codec.crc16(command) for command in checksums} == checksums
    assert list(map(codec.encode_text, ("OKAY", "RESET"))) == [b"OKAYA896\r", b"RESETBE6F\r"]


def test_a_command_has_a_checksum_after_a_colon_and_none_after_a_space():
    assert codec.parse_command(b"INIT:E3A5") == codec.AuroraCommand("INIT", "")
    assert codec.parse_command(b"PENA 0AD") == codec.AuroraCommand("PENA", "0AD")
    assert codec.parse_command(b"BEEP") == codec.AuroraCommand("BEEP", "")


@pytest.mark.parametrize("line", [b"INIT:E3A6", b"INIT:", b"INIT:E3", b"INITX:E3A5"])
def test_a_wrong_checksum_is_detected(line):
    assert not codec.parse_command(line).intact


def test_bytes_outside_ascii_are_no_command_and_no_failure():
    assert codec.parse_command(b"\xff\xfe\x00").name not in ("INIT", "BX")


def test_a_binary_reply_has_two_checksums_lowest_byte_first():
    reply = codec.encode_binary(b"abc")
    start, length, of_header = struct.unpack("<HHH", reply[:6])
    assert (start, length) == (0xA5C4, 3)
    assert of_header == codec.crc16(reply[:4])
    assert struct.unpack("<H", reply[-2:])[0] == codec.crc16(b"abc")


def test_a_checksum_over_all_of_a_binary_reply_is_the_same():
    """ndicapi computes the checksum of header and body together: a header with its own checksum has 0."""
    reply = codec.encode_binary(b"abc")
    assert codec.crc16(reply[:-2]) == codec.crc16(b"abc")


def test_a_pose_is_fixed_point_with_signs_in_text_and_eight_singles_in_binary():
    pose = EmulatedPose((1.5, -20.25, -200.0), (0.5, -0.5, 0.5, -0.5), 0.0239)
    assert codec.encode_pose_text(pose) == "+05000-05000+05000-05000+000150-002025-020000+00239"
    values = struct.unpack("<8f", codec.encode_pose_binary(pose))
    np.testing.assert_allclose(values, (0.5, -0.5, 0.5, -0.5, 1.5, -20.25, -200.0, 0.0239), rtol=1e-6)


def test_a_value_too_large_for_the_format_is_not_a_number_or_infinite():
    far = EmulatedPose((1e39, -1e39, 100_000.0), (1.0, 0.0, 0.0, 0.0), 100.0)
    assert codec.encode_pose_text(far)[24:] == "    nan    nan    nan   nan"
    near = EmulatedPose((9999.99, -9999.99, 0.0), (1.0, 0.0, 0.0, 0.0), 9.9999)
    assert codec.encode_pose_text(near)[24:] == "+999999-999999+000000+99999"
    values = struct.unpack("<8f", codec.encode_pose_binary(far))
    assert values[4:7] == (np.inf, -np.inf, 100_000.0)
