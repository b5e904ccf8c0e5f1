"""Watching: every frame is shown and recorded, with a verdict on each."""

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.replay import ENDED, Replay
from flexneedle.lab.rig.devices.tracker_recording import read_frames
from flexneedle.lab.tracker_evaluation.recording.watch import check_field, make_field_check, watch_tracker
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import VISIBLE, Frame, Measurement, SensorReading


class Clock:
    """Time passes only by waiting."""

    time = 0.0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds


def frames(count, indicator=0.02, **readings):
    sensors = {
        name: SensorReading((1.0, 2.0, 3.0), None, indicator) for name in ("tip", "ref1", "ref2", "ref3")
    }
    return [Frame(n / 40, n, sensors | readings) for n in range(count)]


class Silent:
    """A tracker without frames, with its status."""

    status = "no reply"

    def read(self):
        return ()


def test_each_frame_is_shown_once_with_its_verdict():
    clock, snapshots = Clock(), []
    assert watch_tracker(Replay(frames(60), clock), clock, snapshots.append) == 60
    assert [snapshot.frame.number for snapshot in snapshots if snapshot.is_new] == list(range(60))
    verdicts = [snapshot.verdict for snapshot in snapshots if snapshot.is_new]
    assert all(verdict.startswith("field not known: observed for") for verdict in verdicts[:20])
    assert set(verdicts[20:]) == {VISIBLE}


def test_it_stops_after_the_given_seconds_or_at_the_end_of_a_replay():
    clock = Clock()
    assert watch_tracker(Replay(frames(60), clock), clock, lambda _: None, seconds=0.5) == 20
    clock, snapshots = Clock(), []
    assert watch_tracker(Silent(), clock, snapshots.append, seconds=3.0) == 0
    assert 4 <= len(snapshots) <= 6, "the status, twice a second"
    assert {(snapshot.frame, snapshot.verdict) for snapshot in snapshots} == {(None, "no reply")}
    clock, tracker = Clock(), Silent()
    tracker.status = ENDED
    assert watch_tracker(tracker, clock, lambda _: None, seconds=3.0) == 0
    assert clock.time == 0.0


def test_what_is_recorded_can_be_replayed(tmp_path):
    path, clock = tmp_path / "kept.csv", Clock()
    watch_tracker(
        Replay(frames(60, tip=SensorReading(None, status="missing")), clock),
        clock,
        lambda _: None,
        record=path,
    )
    kept = read_frames(path)
    assert [frame.number for frame in kept] == list(range(60))
    assert kept[7].readings["tip"] == SensorReading(None, status="missing")
    assert kept[7].readings["ref1"].indicator == 0.02


@pytest.mark.parametrize(
    ("name", "rule"), [("kept.csv", "already exists"), ("kept.parquet", "the output is CSV")]
)
def test_a_recording_is_a_new_csv_file(tmp_path, name, rule):
    (tmp_path / "kept.csv").write_text("mine")
    with pytest.raises(InputError, match=rule):
        watch_tracker(Replay(frames(1), Clock()), Clock(), lambda _: None, record=tmp_path / name)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("kept.csv", "mine")]


def verdict(history, settings=None, distorted=False):
    return check_field(history, settings or MonitorSettings(), distorted)[0]


def test_a_good_field_is_ok_and_a_distorted_one_is_not():
    assert check_field(frames(40), MonitorSettings()) == (VISIBLE, False)
    found, distorted = check_field(frames(40, indicator=0.06), MonitorSettings())
    assert "field distorted" in found
    assert distorted


def test_the_field_is_judged_from_the_last_second_at_the_references():
    improved = frames(100, indicator=0.06)[:60] + frames(100)[60:]
    assert verdict(improved) == VISIBLE
    at_the_tip = SensorReading((1.0, 2.0, 3.0), None, 0.5)
    assert verdict(frames(40, tip=at_the_tip)) == VISIBLE


def test_the_verdict_names_a_missing_sensor_and_too_few_references():
    lost = SensorReading(None, status="out of volume")
    assert verdict(frames(5, ref2=lost)) == "ref2: out of volume"
    for position, fault in (
        ((0.0, 0.0, 0.0), "exactly (0, 0, 0)"),
        ((1e30, 0.0, 0.0), "its position is beyond 10 m"),
    ):
        (frame,) = frames(1, tip=SensorReading(position))
        assert check_field([frame], MonitorSettings())[0].startswith(f"tip: {fault}")
    alone = [Frame(0.0, 1, {"tip": SensorReading((1.0, 2.0, 3.0), None, 0.02)})]
    assert "field not known: 0 of 3" in verdict(alone)
    assert verdict(alone, MonitorSettings(references=0)) == VISIBLE


def stretch(begin, seconds, **readings):
    """Frames from time `begin` (s), with these readings of the sensors."""
    first = round(begin * 40)
    return [Frame(n / 40, n, readings) for n in range(first, first + round(seconds * 40))]


def readings_of(indicator, tip_status=VISIBLE):
    measured = SensorReading((1.0, 2.0, 3.0), None, indicator)
    tip = measured if tip_status == VISIBLE else SensorReading(None, status=tip_status)
    return {"tip": tip, "ref1": measured, "ref2": measured, "ref3": measured}


def test_the_verdict_follows_the_monitor_of_a_held_insertion():
    """Indicator above the limit, between the limits, unknown, between the limits, good, between the limits again.

    Then some of these with a missing tip, which the verdict names first.
    """
    levels = (0.02, 0.06, 0.052, None, 0.052, 0.02, 0.052)
    script = [(level, VISIBLE) for level in levels] + [(level, "missing") for level in levels[1:3]]
    script += [(0.052, VISIBLE)]
    measured = [f for k, one in enumerate(script) for f in stretch(1.5 * k, 1.5, **readings_of(*one))]
    clock, snapshots, monitor = Clock(), [], Monitor(MonitorSettings())
    watch_tracker(Replay(measured, clock), clock, snapshots.append)
    assert len(snapshots) == len(measured)
    for frame, snapshot in zip(measured, snapshots, strict=True):
        monitor, _ = monitor.check(
            Measurement(frame.time, 0.0, 0.0, 0.0, frame), lambda _: (0.0, 0.0), frame.time, 1.0, 1000.0
        )
        monitor, held = monitor.check_field()
        is_missing = frame.readings["tip"].status != VISIBLE
        assert snapshot.verdict == ("tip: missing" if is_missing else str(held)), frame.number
    last = [snapshots[60 * (k + 1) - 1].verdict for k in range(len(script))]
    assert [verdict.split(":")[0] for verdict in last] == [
        *("ok", "field distorted", "field distorted", "field not known", "field distorted", "ok", "ok"),
        *("tip", "tip", "field distorted"),
    ]


@pytest.mark.parametrize(
    ("names", "indicator", "references", "expected"),
    [
        (("tip", "ref1"), 0.02, None, VISIBLE),
        (("tip", "ref1"), 0.06, None, "field distorted"),
        (("tip",), 0.02, None, "field not known"),
        (("tip", "ref1", "ref2", "ref3", "ref4"), 0.02, None, VISIBLE),
        (("tip", "tip2", "ref1"), 0.02, None, VISIBLE),  # a second sensor in the needle is no reference
        (("tip", "ref1"), 0.02, 2, "field not known: 1 of 2"),
        (("tip",), 0.02, 0, VISIBLE),
    ],
)
def test_without_a_given_number_all_present_references_are_used(names, indicator, references, expected):
    readings = {name: SensorReading((1.0, 2.0, 3.0), None, indicator) for name in names}
    found = make_field_check(references)([Frame(n / 40, n, readings) for n in range(40)], False)[0]
    assert found.startswith(expected)
