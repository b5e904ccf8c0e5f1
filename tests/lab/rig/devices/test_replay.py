"""Replay of a recording on any clock."""

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.replay import ENDED, Replay
from flexneedle.types import VISIBLE, Frame, SensorReading

FRAMES = [Frame(100.0 + n / 40, 7 + n, {"tip": SensorReading((float(n), 0.0, 0.0))}) for n in range(5)]


class ManualClock:
    """A clock that is set by the test."""

    def __init__(self, time=0.0):
        self.time = time

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds


def test_frames_arrive_at_their_time_and_only_once():
    clock = ManualClock(3.0)
    replay = Replay(FRAMES, clock)
    assert [f.number for f in replay.read()] == [7]
    assert replay.read() == ()
    clock.time = 3.06
    later = replay.read()
    assert [f.number for f in later] == [8, 9]
    assert [f.time for f in later] == pytest.approx([3.025, 3.05])
    assert later[0].readings == FRAMES[1].readings
    clock.time = 99.0
    assert [f.number for f in replay.read()] == [10, 11]
    assert replay.ended
    assert replay.read() == ()


def test_its_status_reports_the_end():
    clock = ManualClock()
    with Replay(FRAMES, clock) as replay:
        assert replay.status == VISIBLE
        clock.time = 1.0
        replay.read()
        assert replay.status == ENDED == "the recording has ended"


def test_a_replay_without_frames_is_rejected():
    with pytest.raises(InputError, match="at least one frame"):
        Replay([], ManualClock())
