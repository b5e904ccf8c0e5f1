"""Trackers named on the command line."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from flexneedle.em.recording import trackers
from flexneedle.em.recording.trackers import clock_for, frames_of_run, open_tracker
from flexneedle.errors import InputError
from flexneedle.rig.devices.clock import WallClock
from flexneedle.rig.devices.replay import Replay
from flexneedle.types import CheckedMeasurement, Frame, Measurement, SensorReading

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
    assert [clock_for(f"replay:{path}"), clock_for(f"replay:{path}@2")] == [1.0, 2.0]
    for spec in (f"replay:{path}", f"replay:{path}@2"):
        with open_tracker(spec, WallClock()) as replay:
            assert len(replay.read()) == 1


def test_a_faster_replay_has_a_faster_clock(monkeypatch):
    now, slept = [100.0], []
    monkeypatch.setattr("flexneedle.rig.devices.clock.monotonic", lambda: now[0])
    monkeypatch.setattr("flexneedle.rig.devices.clock.sleep", slept.append)
    clocks = [clock_for(spec) for spec in ("replay:a.csv@4", "replay:a.csv", "aurora:/dev/tty@4")]
    now[0] = 101.0
    assert [clock.now() for clock in clocks] == [4.0, 1.0, 1.0]
    for clock in clocks:
        clock.wait(1.0)
    assert slept == [0.25, 1.0, 1.0]


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_an_invalid_speed_is_refused(speed):
    with pytest.raises(InputError, match="the speed must be finite and above 0"):
        clock_for(f"replay:a.csv@{speed}")


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


def read_run(monkeypatch, *samples):
    """Return the frames of a run with these readings in two periods."""
    checked = [CheckedMeasurement(sample, "ok") for sample in samples]
    periods = [SimpleNamespace(readings=checked[:1]), SimpleNamespace(readings=checked[1:])]
    monkeypatch.setattr(trackers, "read_trace", lambda _: SimpleNamespace(periods=periods))
    return frames_of_run(Path("run"))


def test_a_run_returns_each_frame_of_its_tracker_once(monkeypatch):
    frames = [Frame(n / 40, 7 + n, {"tip": SensorReading((1.0, 2.0, 3.0))}) for n in range(2)]
    first, second = (Measurement(frame.time, 5.0, 6.0, 7.0, frame) for frame in frames)
    assert read_run(monkeypatch, first, second, second) == tuple(frames)


def test_a_run_with_a_tracker_of_the_tip_alone_gives_frames_of_the_tip(monkeypatch):
    measured, lost = read_run(monkeypatch, Measurement(0.1, 5.0, 6.0), Measurement(0.2, None, None))
    assert measured == Frame(0.1, 0, {"tip": SensorReading((5.0, 6.0, 0.0))})
    assert lost == Frame(0.2, 1, {"tip": SensorReading(None, status="missing")})


def test_a_run_without_readings_is_refused(monkeypatch, tmp_path):
    with pytest.raises(InputError, match="has no tracker readings"):
        read_run(monkeypatch)
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"trace\.mcap: cannot be read"):
        open_tracker(f"replay:{tmp_path}", WallClock())
