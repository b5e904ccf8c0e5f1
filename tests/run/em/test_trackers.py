"""From what a user writes to a tracker."""

import pytest

from flexneedle.devices.clock import WallClock
from flexneedle.devices.replay import Replay
from flexneedle.errors import InputError
from flexneedle.run.em import trackers
from flexneedle.run.em.trackers import open_tracker

RECORDING = "time_s,frame_number,sensor,x_mm,y_mm,z_mm\n0.0,1,tip,1,2,3\n1.0,2,tip,1,2,3\n"


@pytest.mark.parametrize(("ending", "due"), [("", 1.0), ("@2", 0.5), ("@0.5", 2.0)])
def test_a_file_is_replayed_at_its_speed(tmp_path, ending, due):
    class Now:
        time = 0.0

        def now(self):
            return self.time

    path, clock = tmp_path / "recorded.csv", Now()
    path.write_text(RECORDING)
    with open_tracker(f"replay:{path}{ending}", clock) as replay:
        assert isinstance(replay, Replay)
        assert len(replay.read()) == 1
        clock.time = 0.99 * due
        assert replay.read() == ()
        clock.time = 1.01 * due
        assert len(replay.read()) == 1


@pytest.mark.parametrize(
    ("spec", "port", "names"),
    [
        ("aurora:/dev/ttyUSB0", "/dev/ttyUSB0", ("tip", "ref1", "ref2", "ref3")),
        ("aurora:/dev/serial/by-path/pci-0:1=ref1,tip", "/dev/serial/by-path/pci-0:1", ("ref1", "tip")),
    ],
)
def test_an_aurora_has_a_port_and_names(monkeypatch, spec, port, names):
    monkeypatch.setattr(trackers, "Aurora", lambda *given: given)
    clock = WallClock()
    assert open_tracker(spec, clock) == (port, clock, names)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("polaris:/dev/ttyUSB0", "must be aurora:PORT"),
        ("aurora", "must be aurora:PORT"),
        ("replay:", "must be aurora:PORT"),
        ("replay:file.csv@fast", "fast is no speed"),
        ("aurora:/dev/ttyUSB0=tip,tip", "each once"),
        ("aurora:/dev/ttyUSB0=tip,", "each once"),
    ],
)
def test_anything_else_is_refused_with_the_forms_that_there_are(spec, says):
    with pytest.raises(InputError, match=says):
        open_tracker(spec, WallClock())
