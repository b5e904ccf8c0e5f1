"""Trackers named on the command line."""

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.replay import Replay
from flexneedle.lab.tracker_evaluation.recording.trackers import open_tracker

RECORDING = "time_s,frame_number,sensor,x_mm,y_mm,z_mm\n0.0,1,tip,1,2,3\n1.0,2,tip,1,2,3\n"


def test_a_recording_is_replayed_at_its_own_times(tmp_path):
    class Now:
        time = 0.0

        def now(self):
            return self.time

    path, clock = tmp_path / "k@home.csv", Now()
    path.write_text(RECORDING)
    with open_tracker(f"replay:{path}", clock) as replay:
        assert isinstance(replay, Replay)
        assert len(replay.read()) == 1
        clock.time = 0.99
        assert replay.read() == ()
        clock.time = 1.01
        assert len(replay.read()) == 1


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
        ("replay:.", r"trace\.mcap: cannot be read"),
        ("aurora:/dev/ttyUSB0=tip,tip", "must be different identifiers"),
        ("aurora:/dev/ttyUSB0=tip,", "must be different identifiers"),
    ],
)
def test_an_invalid_tracker_is_refused_with_the_valid_forms(spec, message):
    with pytest.raises(InputError, match=message):
        open_tracker(spec, WallClock())
