"""The emulated Aurora: replies to commands in each mode."""

import struct

import pytest

from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.emulators.aurora import EmulatedFrame, power_on
from flexneedle.lab.emulators.motion import SENSORS, sensor_pose

FRAME = EmulatedFrame(7, {name: sensor_pose(name, 7, 0) for name in SENSORS})


def send(device, *commands, frame=FRAME):
    """Send commands; return the device and the last reply without checksum and end."""
    reply = b""
    for command in commands:
        line = command.encode() + b"%04X" % codec.crc16(command.encode())
        device, reply = aurora.reply(device, line, frame)
    return device, reply if reply.startswith(b"\xc4\xa5") else reply[:-5].decode()


def set_up(sensors=4, **settings):
    """Return a device in set-up with enabled sensors."""
    handles = [f"{0x0A + n:02X}" for n in range(sensors)]
    pinit, pena = [f"PINIT:{h}" for h in handles], [f"PENA:{h}D" for h in handles]
    return send(power_on(sensors, **settings), "INIT:", *pinit, *pena)[0]


def test_before_init_only_queries_are_valid():
    assert send(power_on(), "PHSR:00")[1] == send(power_on(), "BX:0001")[1] == "ERROR10"
    assert "Freeze Tag: AURORA Rev 008" in send(power_on(), "VER:0")[1]
    assert send(power_on(), "INIT:")[1] == "OKAY"


def test_handles_can_be_requested_and_freed():
    device, handle = send(set_up(1), "PHRQ:*********1****")
    assert handle == "0B"
    assert send(device, "PHINF:0B0001")[1] == "UNOCCUPIED"
    assert send(device, "PINIT:0B")[1] == "ERROR0D"
    assert send(device, "PHF:0B", "PHSR:00")[1] == "010A031"


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("NONSENSE:", "01"),
        ("PINIT:0", "03"),
        ("PINIT:77", "08"),
        ("PENA:0AX", "09"),
        ("TX:0001", "0C"),
        ("PINIT:XY", "23"),
        ("COMM:5", "03"),
        ("GETINFO:Nonsense", "34"),
        ("ECHO:\u00e9", "23"),
        *((f"PINIT:{digits}", "23") for digits in ("-1", "1_", " 1", "+A")),
    ],
)
def test_an_invalid_command_returns_its_error_code(command, error):
    assert send(set_up(), command)[1] == f"ERROR{error}"
    assert send(set_up(), "ECHO:Aurora 1")[1] == "Aurora 1"


def faulty(fault, command):
    """Return the reading of a single sensor with a fault."""
    frame = EmulatedFrame(7, FRAME.poses, {"tip": fault})
    return send(set_up(1), "TSTART:", command, frame=frame)[1]


@pytest.mark.parametrize(
    ("fault", "options", "expected"),
    [
        ("missing", "0801", "MISSING00000031"),
        ("broken", "0801", "MISSING00000131"),
        ("disabled", "0801", "DISABLED00000011"),
        ("out-of-volume", "0001", "MISSING00000071"),
    ],
)
def test_a_fault_of_a_sensor_is_reported_in_text_and_status_bits(fault, options, expected):
    assert faulty(fault, f"TX:{options}") == f"010A{expected}00000007\n0000"


@pytest.mark.parametrize(("fault", "bits"), [("out-of-volume", 0x71), ("partly-out", 0xB1)])
def test_a_sensor_at_the_edge_of_the_volume_has_a_pose_and_a_status_bit(fault, bits):
    body = faulty(fault, "BX:0801")[6:-2]
    assert body[:3] == bytes((1, 0x0A, 1))
    assert struct.unpack("<II", body[35:43]) == (bits, 7)


def test_a_binary_reading_omits_missing_values():
    assert faulty("missing", "BX:0801")[6:-2] == struct.pack("<BBBIIH", 1, 0x0A, 2, 0x31, 7, 0)
    assert faulty("disabled", "BX:0801")[6:-2] == struct.pack("<BBBH", 1, 0x0A, 4, 0)


@pytest.mark.parametrize("read", ["TX", "BX"])
def test_the_system_status_is_at_the_end_of_a_reading(read):
    device, _ = send(set_up(1), "TSTART:")
    _, reply = send(device, f"{read}:0801", frame=EmulatedFrame(7, FRAME.poses, system=0x21))
    assert reply.endswith("0021") if read == "TX" else reply[-4:-2] == b"\x21\0"
