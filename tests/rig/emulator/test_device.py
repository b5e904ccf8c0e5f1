"""The emulated Aurora as a function: commands in, replies out, modes kept."""

import struct

import pytest

from flexneedle.rig.emulator import codec
from flexneedle.rig.emulator.aurora import Seen, answer, fresh
from flexneedle.rig.emulator.motion import SENSORS, pose

SEEN = Seen(7, {name: pose(name, 7, 0) for name in SENSORS})


def say(device, *commands, seen=SEEN):
    """Give commands; return the device and the last reply without checksum and end."""
    reply = b""
    for command in commands:
        line = command.encode() + b"%04X" % codec.crc16(command.encode())
        device, reply = answer(device, line, seen)
    return device, reply if reply.startswith(b"\xc4\xa5") else reply[:-5].decode()


def set_up(sensors=4, **settings):
    """Return a device that is set up as far as enabled sensors."""
    handles = [f"{0x0A + n:02X}" for n in range(sensors)]
    pinit, pena = [f"PINIT:{h}" for h in handles], [f"PENA:{h}D" for h in handles]
    return say(fresh(sensors, **settings), "INIT:", *pinit, *pena)[0]


def test_nothing_but_questions_is_answered_before_init():
    assert say(fresh(), "PHSR:00")[1] == "ERROR10"
    assert say(fresh(), "BX:0001")[1] == "ERROR10"
    assert "Freeze Tag: AURORA Rev 008" in say(fresh(), "VER:0")[1]
    assert say(fresh(), "INIT:")[1] == "OKAY"


def test_sensors_go_from_found_to_initialised_to_enabled():
    device, _ = say(fresh(2), "INIT:")
    assert say(device, "PHSR:02")[1] == "020A0010B001"
    device, _ = say(device, "PINIT:0A")
    assert say(device, "PHSR:02")[1] == "010B001"
    assert say(device, "PHSR:03")[1] == "010A011"
    device, _ = say(device, "PENA:0AD")
    assert say(device, "PHSR:04")[1] == "010A031"
    assert say(device, "PDIS:0A", "PHSR:03")[1] == "010A011"


def test_a_sensor_says_where_it_is_plugged_in():
    assert say(set_up(), "PHINF:0C0020")[1] == "00000000100300"
    assert len(say(set_up(), "PHINF:0C0001")[1]) == 33


def test_handles_can_be_asked_for_and_freed():
    device, handle = say(set_up(1), "PHRQ:*********1****")
    assert handle == "0B"
    assert say(device, "PHINF:0B0001")[1] == "UNOCCUPIED"
    assert say(device, "PINIT:0B")[1] == "ERROR0D"
    assert say(device, "PHF:0B", "PHSR:00")[1] == "010A031"


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("NONSENSE:", "01"),
        ("PINIT:0", "03"),
        ("PINIT:77", "08"),
        ("PENA:0AX", "09"),
        ("TX:0001", "0C"),
        ("TSTOP:", "0C"),
        ("PHSR:09", "23"),
        ("PINIT:XY", "23"),
        ("COMM:90000", "23"),
        ("COMM:5", "03"),
        ("SFLIST:00", "23"),
        ("GETINFO:Nonsense", "34"),
        ("BEEP:0", "23"),
    ],
)
def test_what_cannot_be_done_is_refused_with_its_code(command, error):
    assert say(set_up(), command)[1] == f"ERROR{error}"


def test_a_sensor_is_initialised_before_it_is_enabled():
    assert say(fresh(), "INIT:", "PENA:0AD")[1] == "ERROR0E"


def test_a_command_with_a_wrong_checksum_is_refused():
    assert answer(fresh(), b"INIT:0000", SEEN)[1] == codec.text("ERROR04")


def test_nothing_is_set_up_while_it_tracks_and_init_ends_that():
    device, _ = say(set_up(), "TSTART:")
    assert say(device, "PINIT:0A")[1] == "ERROR0C"
    assert say(device, "TSTOP:", "PHSR:04")[1].startswith("04")
    assert say(device, "INIT:", "PHSR:02")[1].startswith("04")


def test_old_firmware_does_not_know_bx():
    device, _ = say(set_up(knows_bx=False), "TSTART:")
    assert say(device, "BX:0801")[1] == "ERROR01"
    assert say(device, "TX:0801")[1].startswith("04")


def test_a_reading_in_text_has_pose_status_and_frame_number():
    _, reply = say(set_up(1), "TSTART:", "TX:0001")
    assert reply == f"010A{codec.transform_text(SEEN.poses['tip'])}0000003100000007\n0000"


def ailing(ailment, command):
    """Return what is read of a single sensor that ails."""
    seen = Seen(7, SEEN.poses, {"tip": ailment})
    return say(set_up(1), "TSTART:", command, seen=seen)[1]


@pytest.mark.parametrize(
    ("ailment", "options", "told"),
    [
        ("missing", "0801", "MISSING00000031"),
        ("broken", "0801", "MISSING00000131"),
        ("disabled", "0801", "DISABLED00000011"),
        ("out-of-volume", "0001", "MISSING00000071"),
    ],
)
def test_what_ails_a_sensor_is_told_in_words_and_bits(ailment, options, told):
    assert ailing(ailment, f"TX:{options}") == f"010A{told}00000007\n0000"


@pytest.mark.parametrize(("ailment", "bits"), [("out-of-volume", 0x71), ("partly-out", 0xB1)])
def test_a_sensor_at_the_edge_of_the_volume_has_a_pose_and_a_bit(ailment, bits):
    body = ailing(ailment, "BX:0801")[6:-2]
    assert body[:3] == bytes((1, 0x0A, 1))
    assert struct.unpack("<II", body[35:43]) == (bits, 7)


def test_a_reading_in_binary_leaves_out_what_is_not_known():
    assert ailing("missing", "BX:0801")[6:-2] == struct.pack("<BBBIIH", 1, 0x0A, 2, 0x31, 7, 0)
    assert ailing("disabled", "BX:0801")[6:-2] == struct.pack("<BBBH", 1, 0x0A, 4, 0)


@pytest.mark.parametrize("letters", ["TX", "BX"])
def test_what_ails_the_whole_system_stands_at_the_end_of_a_reading(letters):
    device, _ = say(set_up(1), "TSTART:")
    _, reply = say(device, f"{letters}:0801", seen=Seen(7, SEEN.poses, system=0x21))
    assert reply.endswith("0021") if letters == "TX" else reply[-4:-2] == b"\x21\0"
