"""The trackers that come with the package, made from the settings of a rig file."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from flexneedle.errors import InputError, RigError
from flexneedle.lab.rig.devices.replay import ENDED, Replay
from flexneedle.lab.rig.devices.trackers import aurora, read_run_frames, replay
from flexneedle.types import VISIBLE, CheckedMeasurement, Frame, Measurement, SensorReading
from rooms import ManualClock

FRAMES = [Frame(100.0 + n / 40, 7 + n, {"tip": SensorReading((float(n), 0.0, 0.0))}) for n in range(5)]
RECORDING = "time_s,frame_number,sensor,x_mm,y_mm,z_mm\n5.0,1,tip,1,2,3\n6.0,2,tip,1,2,3\n"


def test_recorded_frames_arrive_at_their_time_and_only_once_until_the_end():
    clock = ManualClock()
    clock.wait(3.0)
    with Replay(FRAMES, clock) as made:
        assert [frame.number for frame in made.read()] == [7]
        assert made.read() == ()
        clock.wait(0.06)
        later = made.read()
        assert [frame.number for frame in later] == [8, 9]
        assert [frame.time for frame in later] == pytest.approx([3.025, 3.05])
        assert later[0].readings == FRAMES[1].readings
        assert made.status == VISIBLE
        clock.wait(96.0)
        assert [frame.number for frame in made.read()] == [10, 11]
        assert (made.ended, made.status, made.read()) == (True, ENDED, ())


@pytest.mark.parametrize(("speed", "due"), [({"speed": 4}, 0.25), ({"speed": 0.5}, 2.0)])
def test_a_recording_is_replayed_at_its_speed(tmp_path, speed, due):
    path, clock = tmp_path / "recorded.csv", ManualClock()
    path.write_text(RECORDING)
    clock.wait(3.0)
    tracker = replay({"file": str(path), **speed}, clock)
    (first,) = tracker.read()
    clock.wait(due - 1e-3)
    assert tracker.read() == ()
    clock.wait(2e-3)
    (second,) = tracker.read()
    assert second.time - first.time == pytest.approx(due)
    assert (first.time, [first.number, second.number]) == (3.0, [1, 2])


@pytest.mark.parametrize(
    ("sensors", "names"),
    [({}, ("tip", "ref1", "ref2", "ref3")), ({"sensors": ["ref1", "tip"]}, ("ref1", "tip"))],
)
def test_an_aurora_has_a_port_and_names(monkeypatch, sensors, names):
    monkeypatch.setattr("flexneedle.lab.rig.devices.trackers.Aurora", lambda *given: given)
    clock = ManualClock()
    assert aurora({"port": "/dev/ttyUSB0", **sensors}, clock) == ("/dev/ttyUSB0", clock, names)


@pytest.mark.parametrize(
    ("factory", "settings", "line"),
    [
        (aurora, {}, "port: missing"),
        (aurora, {"port": 3}, "port = 3: must be text in quotes"),
        (aurora, {"port": "a", "prot": 1}, "prot = 1: unknown key; did you mean port?"),
        (aurora, {"port": "a", "sensors": ["tip", "tip"]}, "sensor names must be different identifiers"),
        (aurora, {"port": "a", "sensors": []}, "sensor names must be different identifiers"),
        (replay, {"file": "a", "speed": 0}, "speed = 0: must be above 0"),
        (replay, {"file": "a", "speed": float("inf")}, "speed = inf: must be a finite number"),
        (replay, {"speed": 1}, "file: missing"),
    ],
)
def test_invalid_settings_are_refused(factory, settings, line):
    with pytest.raises(RigError) as caught:
        factory(settings, ManualClock())
    assert line in str(caught.value)


def test_a_recording_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"gone\.csv: cannot be read"):
        replay({"file": str(tmp_path / "gone.csv")}, ManualClock())


def read_run(monkeypatch, *samples):
    """Return the frames of a run with these readings in two periods."""
    checked = [CheckedMeasurement(sample, "ok") for sample in samples]
    periods = [SimpleNamespace(readings=checked[:1]), SimpleNamespace(readings=checked[1:])]
    monkeypatch.setattr("flexneedle.record.reader.read_trace", lambda _: SimpleNamespace(periods=periods))
    return read_run_frames(Path("run"))


def test_a_run_returns_each_frame_of_its_tracker_once(monkeypatch):
    frames = [Frame(n / 40, 7 + n, {"tip": SensorReading((1.0, 2.0, 3.0))}) for n in range(2)]
    first, second = (Measurement(frame.time, 5.0, 6.0, 7.0, frame) for frame in frames)
    assert read_run(monkeypatch, first, second, second) == tuple(frames)


def test_a_run_with_a_tracker_of_the_tip_alone_gives_frames_of_the_tip(monkeypatch):
    measured, lost = read_run(monkeypatch, Measurement(0.1, 5.0, 6.0), Measurement(0.2, None, None))
    assert measured == Frame(0.1, 0, {"tip": SensorReading((5.0, 6.0, 0.0))})
    assert lost == Frame(0.2, 1, {"tip": SensorReading(None, status="missing")})


def test_a_run_without_readings_is_refused(monkeypatch):
    with pytest.raises(InputError, match="has no tracker readings"):
        read_run(monkeypatch)
