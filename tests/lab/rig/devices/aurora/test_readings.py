"""Conversion of the link's values: only a sensor completely inside the volume has a position."""

import pytest

from flexneedle.lab.rig.devices.aurora.readings import NAMES, make_reading, make_readings, sensor_name
from flexneedle.types import VISIBLE, SensorReading

POSE = (0.5, -0.5, 0.5, -0.5, 10.0, -20.0, -200.0, 0.024)
MEASURED, DISABLED, MISSING, UNOCCUPIED = 0, 1, 2, 4


def test_a_measured_sensor_has_position_orientation_and_indicator():
    assert make_reading(MEASURED, 0x31, POSE) == SensorReading(
        (10.0, -20.0, -200.0), (0.5, -0.5, 0.5, -0.5), 0.024, VISIBLE
    )


def test_a_rounded_quaternion_is_made_unit():
    rounded = make_reading(MEASURED, 0x31, (1.0004, 0.0, 0.0, 0.0, *POSE[4:]))
    assert rounded.orientation == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "bits", "status"),
    [
        (MISSING, 0x31, "missing"),
        (MISSING, 0x71, "out of volume"),
        (MEASURED, 0x71, "out of volume"),
        (MEASURED, 0xB1, "partly out of volume"),
        (MEASURED, 0xF1, "out of volume"),
        (MISSING, 0x131, "broken coil"),
        (MEASURED, 0x131, "broken coil"),
        (MISSING, 0x1031, "processing exception"),
        (MEASURED, 0x231, "disturbed"),
        (MEASURED, 0x431, "signal too small"),
        (MEASURED, 0x831, "signal too large"),
        (MEASURED, 0x2031, "hardware failure"),
        (DISABLED, 0x11, "disabled"),
        (DISABLED, 0x00, "disabled"),
        (MEASURED, 0x30, "unplugged"),
        (UNOCCUPIED, 0x31, "missing"),
    ],
)
def test_a_sensor_with_a_fault_has_its_status_and_no_position(kind, bits, status):
    assert make_reading(kind, bits, POSE) == SensorReading(None, status=status)


@pytest.mark.parametrize(
    "pose",
    [
        (float("nan"), *POSE[1:]),
        (*POSE[:4], float("inf"), *POSE[5:]),
        (*POSE[:4], -3.697314e28, *POSE[5:]),
        (0.9, 0.0, 0.0, 0.0, *POSE[4:]),
        (0.0,) * 8,
        (*POSE[:7], float("nan")),
        POSE[:7],
        (*POSE, 0.0),
    ],
)
def test_an_invalid_pose_gives_no_position(pose):
    assert make_reading(MEASURED, 0x31, pose) == SensorReading(None, status="bad transform")


def test_a_sensor_of_an_older_frame_than_the_others_is_stale():
    found = {
        "10": (MEASURED, 0x31, 7, POSE),
        "11": (MEASURED, 0x31, 8, POSE),
        "12": (DISABLED, 0x31, 3, POSE),
    }
    result = make_readings(found, 8, {"10": "tip", "11": "ref1", "12": "ref2"})
    assert {name: r.status for name, r in result.items()} == {
        "tip": "stale",
        "ref1": "ok",
        "ref2": "disabled",
    }
    assert result["tip"].position is None


def test_the_name_of_a_sensor_depends_only_on_its_port():
    assert [sensor_name(port, "00", NAMES) for port in ("01", "04")] == ["tip", "ref3"]
    assert sensor_name("01", "00", ("ref1", "tip")) == "ref1"
    assert sensor_name("02", "01", NAMES) == "ref1.2"
    assert [sensor_name(port, "00", NAMES) for port in ("05", "0A", "00")] == ["port5", "portA", "port0"]
