"""Short versions of the campaigns of random inputs, and faults that they must notice."""

import re
import sys
from pathlib import Path

import pytest

from bench_rig import rig
from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply
from flexneedle.types import Frame, SensorReading

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import fuzz_aurora
import fuzz_aurora_line
import fuzz_galil
import fuzz_rig_file
import fuzzing

SECONDS = 600.0


@pytest.mark.parametrize(
    ("part", "inputs"),
    [
        *((part, 4000) for name, part in fuzz_aurora.PARTS.items() if name != "live"),
        (fuzz_galil.PARTS["parser"], 4000),
        (fuzz_galil.PARTS["controller"], 4000),
        (fuzz_galil.PARTS["driver"], 300),
    ],
)
def test_some_inputs_of_each_part_obey_its_rules(monkeypatch, part, inputs):
    monkeypatch.setattr(fuzz_galil, "SLACK_S", 60.0)  # a call may take long on a busy machine
    assert fuzzing.run(part, inputs, SECONDS, seed=7)[0] == inputs


@pytest.mark.parametrize("part", [fuzz_rig_file.files, fuzz_rig_file.profiles])
def test_random_files_are_read_or_refused(part):
    """Both are frequent, and nothing else occurs."""
    done, note = fuzzing.run(part, 300, SECONDS, 0)
    assert done == 300
    assert min(int(count) for count in re.findall(r"(\d+) (?:read|refused)", note)) > 15


@pytest.mark.parametrize(
    ("read", "valid"),
    [
        (fuzz_rig_file.read_rig, fuzz_rig_file.RIGS),
        (fuzz_rig_file.read_profile, fuzz_rig_file.PROFILES),
    ],
)
def test_valid_files_are_read(tmp_path, read, valid):
    """Also with the settings of each kind of device."""
    path = tmp_path / "file.toml"
    assert len(set(valid)) == 3
    for data in valid:
        path.write_bytes(data)
        assert fuzz_rig_file.outcome(path, read) == "read"


@pytest.mark.long
def test_a_line_that_damages_replies_gives_no_frame_that_was_not_sent():
    _, note = fuzzing.run(fuzz_aurora.PARTS["live"], 1000, 6.0, seed=3)
    assert int(re.search(r"(\d+) replies", note)[1]) > 100, note


# Faults that they must notice


def test_an_unusable_rig_is_noticed():
    found = rig()
    broken = found.axes.insertion.model_copy(update={"tolerance_mm": 1.0})
    axes = found.axes.model_copy(update={"insertion": broken})
    assert fuzz_rig_file.unusable(found) == ""
    assert "not ordered" in fuzz_rig_file.unusable(found.model_copy(update={"axes": axes}))


def test_a_motion_that_nothing_began_is_noticed():
    moving = advance_controller(reply(ControllerState(), "SHA;PRA=5000;BGA")[0], 50)
    with pytest.raises(fuzz_galil.Failure, match="began to move"):
        fuzz_galil.check_line(ControllerState(), "SPA=100", 0, answered=lambda *_: (moving, ":"))


def test_a_frame_that_was_not_sent_intact_is_noticed():
    sent = fuzz_aurora_line.Sent()
    pose = aurora.EmulatedPose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 0.02)
    body = b"\x01\x0a\x01" + codec.encode_pose_binary(pose) + bytes(8) + bytes(2)
    good = codec.encode_binary(body)
    assert not sent.add(good[:-1] + b"\x00", 5.0)
    assert not sent.add(good[:-1], 5.0)
    assert sent.add(good, 5.0)

    def frame(time, *position):
        return Frame(time, 1, {"tip": SensorReading(position, (1.0, 0.0, 0.0, 0.0), 0.02)})

    assert sent.problem(frame(4.9, 1.0, 2.0, 3.0)) == ""
    assert "not sent" in sent.problem(frame(4.9, 1.0, 2.0, 3.1))
    assert "dated" in sent.problem(frame(5.1, 1.0, 2.0, 3.0))
