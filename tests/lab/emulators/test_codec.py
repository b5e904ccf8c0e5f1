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


def test_a_value_too_large_for_the_format_is_not_a_number_or_infinite():
    far = EmulatedPose((1e39, -1e39, 100_000.0), (1.0, 0.0, 0.0, 0.0), 100.0)
    assert codec.encode_pose_text(far)[24:] == "    nan    nan    nan   nan"
    near = EmulatedPose((9999.99, -9999.99, 0.0), (1.0, 0.0, 0.0, 0.0), 9.9999)
    assert codec.encode_pose_text(near)[24:] == "+999999-999999+000000+99999"
    values = struct.unpack("<8f", codec.encode_pose_binary(far))
    assert values[4:7] == (np.inf, -np.inf, 100_000.0)
