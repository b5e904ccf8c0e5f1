"""A value of a wrong type from a user's driver or tracker is reported in one line: class, method, expected type."""

import math
import sys

import numpy as np
import pytest
import tomli_w

import bench_rig
from bench_rig import Motors, Tracker, rig
from commands import run
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.opening import open_motors, open_tracker
from flexneedle.ports import MotorState
from flexneedle.types import Frame, SensorReading
from rooms import ManualClock

STATE = MotorState(0.0, 0.0)
LONG = (0.0, 1.02, 0.0, 0.0)
FOUND = {"driver__kind": "parts:Stage", "tracker__kind": "parts:Camera"}


class Stage(Motors):
    """Motors of a user; a part of them is replaced by the test."""

    identity, address = "stage", "here"

    def __init__(self, _settings, channels):
        super().__init__(channels)

    def setup(self):
        return {}


class Camera(Tracker):
    """A tracker of a user; a part of it is replaced by the test."""

    status = "ok"

    def __init__(self, _settings, clock):
        self.clock = clock


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.setitem(sys.modules, "parts", sys.modules[__name__])


def frames(**reading):
    return (Frame(0.0, 1, {"tip": SensorReading(**{"position": (1.0, 2.0, 3.0), **reading})}),)


def opened(device):
    return open_motors(rig(**FOUND)) if device is Stage else open_tracker(rig(**FOUND), ManualClock())


def returning(value):
    return lambda _: value


@pytest.mark.parametrize(
    ("device", "part", "value", "line"),
    [
        (Stage, "read", None, "must be a mapping of each channel to a MotorState, not None"),
        (Stage, "read", {1: STATE}, "must have text as each channel, not an int"),
        (Stage, "read", {"A": 3.0}, "must have a MotorState for channel A, not a float"),
        (Stage, "read", {"A": MotorState("3", 0.0)}, "channel A: position must be a number, not '3'"),
        (Stage, "read", {"A": MotorState(0.0, 0.0, on="off")}, "channel A: on must be True or False"),
        (Stage, "read", {"A": MotorState(0.0, 0.0, stopped=None)}, "channel A: stopped must be text"),
        (Stage, "setup", None, "must be a mapping of each channel to a MotorSetup, not None"),
        (Camera, "read", frames()[0], "must be a tuple of Frame, not a Frame"),
        (Camera, "read", ("tip",), "must be a tuple of Frame, but one is a str"),
        (Camera, "read", (Frame("0", 1, {}),), "Frame: time must be a number, not '0'"),
        (Camera, "read", (Frame(0.0, 1, []),), "Frame: must be a mapping of each sensor to a SensorReading"),
        (Camera, "read", frames(position="123"), "Frame: sensor tip: position must be 3 numbers or None"),
        (Camera, "read", frames(orientation=(1, 0)), "Frame: sensor tip: orientation must be 4 numbers"),
        (Camera, "read", frames(orientation=LONG), "Frame: sensor tip: orientation must be a unit"),
        (Camera, "read", frames(indicator="0"), "Frame: sensor tip: indicator must be a number or None"),
    ],
)
def test_the_result_of_a_method_has_its_type(monkeypatch, device, part, value, line):
    monkeypatch.setattr(device, part, returning(value))
    with pytest.raises(DriverError) as caught:
        getattr(opened(device), part)()
    name = "driver parts:Stage: Stage" if device is Stage else "tracker parts:Camera: Camera"
    assert str(caught.value).startswith(f"{name}.{part}(): {line}")


@pytest.mark.parametrize(
    ("device", "part", "value", "line"),
    [
        (Stage, "identity", 3, "must be text, not an int"),
        (Stage, "setup", {}, "must be a method, not a dict"),
        (Camera, "status", returning("ok"), "must be text, not a method"),
    ],
)
def test_an_attribute_has_its_type(monkeypatch, device, part, value, line):
    monkeypatch.setattr(device, part, value, raising=False)
    with pytest.raises(DriverError, match=rf"{device.__name__}\.{part}: {line}$"):
        getattr(opened(device), part)


def test_a_rounded_orientation_is_accepted_and_nan_is_left_to_the_monitor(monkeypatch):
    for orientation in ((0.992, 0.0, 0.0, 0.0), (0.0, 0.71, 0.0, 0.71), (math.nan, 0.0, 0.0, 1.0)):
        found = frames(orientation=orientation)
        monkeypatch.setattr(Camera, "read", returning(found))
        assert opened(Camera).read() is found


def test_numbers_of_numpy_are_numbers(monkeypatch):
    state = MotorState(np.float32(1.0), np.int64(1), moving=np.bool_(False), on=1)
    monkeypatch.setattr(Stage, "read", returning({"A": state}))
    assert opened(Stage).read() == {"A": state}
    found = list(frames(position=np.zeros(3), indicator=np.float64(0.1)))
    monkeypatch.setattr(Camera, "read", returning(found))
    assert opened(Camera).read() is found


@pytest.mark.parametrize("device", [Stage, Camera])
def test_a_wrong_type_is_a_problem_in_one_line_of_rig_check(capsys, tmp_path, monkeypatch, device):
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.WallClock", ManualClock)
    monkeypatch.setattr(device, "read", returning(7))
    kinds = {key.replace("__", "."): kind for key, kind in FOUND.items()}
    file = tmp_path / "rig.toml"
    file.write_text(tomli_w.dumps(bench_rig.values(kinds)))
    status, out, err = run(capsys, "rig", "check", str(file))
    (line,) = [line for line in out.splitlines() if f"{device.__name__}.read(): must be a" in line]
    assert (status, err) == (1, "")
    assert line.startswith("PROBLEM")
