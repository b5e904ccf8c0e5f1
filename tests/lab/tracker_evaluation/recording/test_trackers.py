"""Trackers named on the command line."""

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.replay import Replay
from flexneedle.lab.tracker_evaluation.recording import trackers
from flexneedle.lab.tracker_evaluation.recording.trackers import make_clock, open_tracker

RECORDING = "time_s,frame_number,sensor,x_mm,y_mm,z_mm\n0.0,1,tip,1,2,3\n1.0,2,tip,1,2,3\n"


def test_a_recording_is_replayed_at_its_own_times(tmp_path):
    class Now:
        time = 0.0

        def now(self):
            return self.time

    path, clock = tmp_path / "recorded.csv", Now()
    path.write_text(RECORDING)
    with open_tracker(f"replay:{path}@2", clock) as replay:
        assert isinstance(replay, Replay)
        assert len(replay.read()) == 1
        clock.time = 0.99
        assert replay.read() == ()
        clock.time = 1.01
        assert len(replay.read()) == 1


def test_a_file_may_have_an_at_sign_in_its_name(tmp_path, monkeypatch):
    monkeypatch.setattr(trackers, "WallClock", lambda speed: speed)
    path = tmp_path / "k@home.csv"
    path.write_text(RECORDING)
    assert [make_clock(f"replay:{path}"), make_clock(f"replay:{path}@2")] == [1.0, 2.0]
    for spec in (f"replay:{path}", f"replay:{path}@2"):
        with open_tracker(spec, WallClock()) as replay:
            assert len(replay.read()) == 1


def test_a_faster_replay_has_a_faster_clock(monkeypatch):
    now, slept = [100.0], []
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.monotonic", lambda: now[0])
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.sleep", slept.append)
    clocks = [make_clock(spec) for spec in ("replay:a.csv@4", "replay:a.csv", "aurora:/dev/tty@4")]
    now[0] = 101.0
    assert [clock.now() for clock in clocks] == [4.0, 1.0, 1.0]
    for clock in clocks:
        clock.wait(1.0)
    assert slept == [0.25, 1.0, 1.0]


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_an_invalid_speed_is_refused(speed):
    with pytest.raises(InputError, match="the speed must be finite and above 0"):
        make_clock(f"replay:a.csv@{speed}")


@pytest.mark.parametrize(
    ("spec", "port", "names"),
    [
        ("aurora:/dev/ttyUSB0", "/dev/ttyUSB0", ("tip", "ref1", "ref2", "ref3")),
        ("aurora:/dev/serial/by-path/pci-0:1=ref1,tip", "/dev/serial/by-path/pci-0:1", ("ref1", "tip")),
    ],
)
def test_an_aurora_has_a_port_and_names(monkeypatch, spec, port, names):
    monkeypatch.setattr("flexneedle.lab.rig.devices.trackers.Aurora", lambda *given: given)
    clock = WallClock()
    assert open_tracker(spec, clock) == (port, clock, names)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("polaris:/dev/ttyUSB0", "must be aurora:PORT"),
        ("aurora", "must be aurora:PORT"),
        ("replay:", "must be aurora:PORT"),
        ("replay:file.csv@fast", "fast is not a speed, and the file file.csv@fast does not exist"),
        ("aurora:/dev/ttyUSB0=tip,tip", "must be different identifiers"),
        ("aurora:/dev/ttyUSB0=tip,", "must be different identifiers"),
    ],
)
def test_an_invalid_tracker_is_refused_with_the_valid_forms(spec, message):
    with pytest.raises(InputError, match=message):
        open_tracker(spec, WallClock())


def test_a_run_without_a_trace_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"trace\.mcap: cannot be read"):
        open_tracker(f"replay:{tmp_path}", WallClock())
