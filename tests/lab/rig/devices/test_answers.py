"""A value of a wrong type from a user's driver or tracker is reported in one line: class, method, expected type."""

import math
import sys

import numpy as np
import pytest
import tomli_w

import bench_rig
from bench_rig import Clock, Motors, Tracker, rig
from commands import run
from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.opening import open_motors, open_tracker
from flexneedle.ports import MotorState
from flexneedle.types import Frame, SensorReading

STATE = MotorState(0.0, 0.0)


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.setitem(sys.modules, "parts", sys.modules[__name__])


class Stage(Motors):
    """Motors of a user; what they return is set by the test."""

    answer, identity, address, setup = {"A": STATE, "B": STATE, "C": STATE}, "stage", "here", dict

    def read(self):
        return self.answer


class Camera(Tracker):
    """A tracker of a user."""

    answer = ()

    def read(self):
        return self.answer


def open_stage(_settings, channels):
    return Stage(channels)


def open_camera(_settings, clock):
    return Camera(clock)


FOUND = {"driver__kind": "parts:open_stage", "tracker__kind": "parts:open_camera"}


def frame(**reading):
    return (Frame(0.0, 1, {"tip": SensorReading(**{"position": (1.0, 2.0, 3.0), **reading})}),)


def refusal(call):
    with pytest.raises(DriverError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (None, "must be a mapping of each channel to a MotorState, not None"),
        ({1: STATE}, "must have text as each channel, not an int"),
        ({"A": 3.0}, "must have a MotorState for channel A, not a float"),
        ({"A": MotorState("3", 0.0)}, "channel A: position must be a number, not '3'"),
        ({"A": MotorState(0.0, 0.0, on="off")}, "channel A: on must be True or False, not 'off'"),
        ({"A": MotorState(0.0, 0.0, stopped=None)}, "channel A: stopped must be text, not None"),
    ],
)
def test_states_of_motors_have_their_type(monkeypatch, answer, line):
    monkeypatch.setattr(Stage, "answer", answer)
    found = refusal(open_motors(rig(**FOUND)).read)
    assert found == f"driver parts:open_stage: Stage.read(): {line}"


@pytest.mark.parametrize(
    ("part", "value", "line"),
    [
        ("identity", 3, "identity: must be text, not an int"),
        ("address", ("10.0.0.1", 23), "address: must be text, not a tuple"),
        ("setup", {}, "setup: must be a method, not a dict"),
        ("setup", lambda _: None, "setup(): must be a mapping of each channel to a MotorSetup, not None"),
    ],
)
def test_other_parts_of_a_driver_have_their_type(monkeypatch, part, value, line):
    monkeypatch.setattr(Stage, part, value)
    motors = open_motors(rig(**FOUND))
    found = refusal(lambda: getattr(motors, part)() if callable(value) else getattr(motors, part))
    assert found == f"driver parts:open_stage: Stage.{line}"


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (frame()[0], "must be a tuple of Frame, not a Frame"),
        (("tip",), "must be a tuple of Frame, but one is a str"),
        ((Frame("0", 1, {}),), "Frame: time must be a number, not '0'"),
        ((Frame(0.0, 1, []),), "Frame: must be a mapping of each sensor to a SensorReading, not a list"),
        (frame(position=(1.0, 2.0)), "Frame: sensor tip: position must be 3 numbers or None, not (1.0, 2.0)"),
        (frame(position="123"), "Frame: sensor tip: position must be 3 numbers or None, not '123'"),
        (frame(orientation=(1, 0)), "Frame: sensor tip: orientation must be 4 numbers or None, not (1, 0)"),
        (
            frame(orientation=(0.0, 1.02, 0.0, 0.0)),
            "Frame: sensor tip: orientation must be a unit quaternion w, x, y, z, not one of length 1.02",
        ),
        (frame(indicator="0"), "Frame: sensor tip: indicator must be a number or None, not '0'"),
    ],
)
def test_frames_have_their_type(monkeypatch, answer, line):
    monkeypatch.setattr(Camera, "answer", answer)
    found = refusal(open_tracker(rig(**FOUND), Clock()).read)
    assert found == f"tracker parts:open_camera: Camera.read(): {line}"


def test_a_rounded_orientation_is_accepted_and_nan_is_left_to_the_monitor(monkeypatch):
    for orientation in ((0.992, 0.0, 0.0, 0.0), (0.0, 0.71, 0.0, 0.71), (math.nan, 0.0, 0.0, 1.0)):
        frames = frame(orientation=orientation)
        monkeypatch.setattr(Camera, "answer", frames)
        assert open_tracker(rig(**FOUND), Clock()).read() is frames


def test_a_status_must_not_be_a_method(monkeypatch):
    monkeypatch.setattr(Tracker, "__init__", lambda self, clock: None)  # noqa: ARG005
    monkeypatch.setattr(Camera, "status", lambda _: "ok", raising=False)
    tracker = open_tracker(rig(**FOUND), Clock())
    with pytest.raises(DriverError, match=r"Camera\.status: must be text, not a method$"):
        _ = tracker.status


def test_numbers_of_numpy_are_numbers(monkeypatch):
    state = MotorState(np.float32(1.0), np.int64(1), moving=np.bool_(False), on=1)
    monkeypatch.setattr(Stage, "answer", {"A": state})
    assert open_motors(rig(**FOUND)).read() == {"A": state}
    frames = list(frame(position=np.zeros(3), indicator=np.float64(0.1)))
    monkeypatch.setattr(Camera, "answer", frames)
    assert open_tracker(rig(**FOUND), Clock()).read() is frames


@pytest.mark.parametrize(
    ("device", "name"),
    [(Stage, "driver parts:open_stage: Stage"), (Camera, "tracker parts:open_camera: Camera")],
)
def test_a_wrong_type_is_a_problem_in_one_line_of_rig_check(capsys, tmp_path, monkeypatch, device, name):
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.WallClock", Clock)
    monkeypatch.setattr(device, "answer", 7)
    kinds = {key.replace("__", "."): kind for key, kind in FOUND.items()}
    file = tmp_path / "rig.toml"
    file.write_text(tomli_w.dumps(bench_rig.values(kinds)))
    status, out, err = run(capsys, "rig", "check", str(file))
    lines = [line for line in out.splitlines() if f"{name}.read(): must be a" in line]
    assert (status, err) == (1, "")
    assert len(lines) == 1
    assert lines[0].startswith("PROBLEM")
