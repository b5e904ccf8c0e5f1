"""The tracker `ros`: a tip on a topic becomes frames."""

import time
from dataclasses import replace

import numpy as np
import pytest

from emulated import until
from flexneedle.errors import RigError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.link.records import LinkRefusal, NodeLoss
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import TipReading
from flexneedle.lab.ros.tracker import RosTracker, make_tracker
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.types import VISIBLE
from rooms import ManualClock
from ros_peers import Peer, tip


class Node:
    """A node with records of the test."""

    status = VISIBLE

    def __init__(self):
        self.records = []

    def poll(self):
        found, self.records = self.records, []
        return found


def reading(number=1, at=None, **values):
    return replace(TipReading(at or time.monotonic(), number, (1.0, 2.0, 3.0), None), **values)


@pytest.fixture
def node():
    return Node()


@pytest.fixture
def tracker(node):
    return RosTracker(node, WallClock(), late_s=0.25)


def test_a_reading_is_a_frame_once_on_the_clock_of_the_run(node, tracker):
    clock = ManualClock()
    clock.time = 12.0
    before = time.monotonic()
    late = RosTracker(node, clock, late_s=0.25)
    after = time.monotonic()
    node.records = [reading(at=before - 0.01, position=None, status="position (nan, 0, 0): not a number")]
    (frame,) = late.read()
    assert 11.99 - (after - before) - 1e-9 <= frame.time <= 11.99 + 1e-9
    assert frame.readings["tip"].status == "position (nan, 0, 0): not a number"
    node.records = [reading(7), reading(9)]
    frames = tracker.read()
    assert [frame.number for frame in frames] == [7, 9]
    assert [frame.readings["tip"].position for frame in frames] == [(1.0, 2.0, 3.0)] * 2
    assert tracker.read() == ()


def test_the_status_is_the_reason_why_no_frame_arrives(node):
    tracker = RosTracker(node, WallClock(), late_s=60.0)
    node.records = [reading()]
    tracker.read()
    assert tracker.status == VISIBLE
    tracker._late = 0.0
    assert tracker.status.startswith("no frame for ")
    node.records = [LinkRefusal(0.0, "/tip", "old data")]
    assert tracker.read() == ()
    assert tracker.status == "/tip: old data"
    tracker._late = 60.0
    node.records = [reading(2)]
    tracker.read()
    assert tracker.status == VISIBLE
    node.records, node.status = [NodeLoss(0.0, "the ROS node has ended")], "the ROS node has ended"
    assert tracker.read() == ()
    assert tracker.status == "the ROS node has ended"


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"profile": "nobody"}, "nobody"),
        ({"source": "nose"}, 'source = "nose"'),
        ({"late_ms": -1.0}, "late_ms = -1.0"),
        ({"topic": "/tip"}, 'topic = "/tip"'),
        ({"profile": "smartneedle", "source": "shape"}, 'profile = "smartneedle"'),
    ],
)
def test_invalid_settings_are_one_line(settings, key):
    with pytest.raises(RigError) as caught:
        make_tracker(settings, WallClock())
    (line,) = caught.value.problems
    assert line.startswith(f"{key}: ")


def test_tips_of_smartneedle_reach_the_stage_of_the_insertion():
    """Its /sensor/tip: mm, insertion along y."""
    with make_tracker({"profile": "smartneedle"}, WallClock()) as tracker:
        peer, measured = Peer(load_profile("smartneedle"), subscribe=("tip",)), []
        peer.await_node(tracker._node)
        stage, along_y = OnStage(tracker, identity()), (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # its z is along y

        def three():
            depth = 10.0 * (len(measured) + 1)
            peer.send("tip", tip(time.time(), (-1.0, depth, 2.0), along_y, "stage"))
            measured.extend(stage.read())
            return len(measured) >= 3

        until(three)
    found = np.array([(m.x, m.y, m.z) for m in measured])
    np.testing.assert_allclose(found[:, 1:], np.tile((2.0, -1.0), (len(found), 1)), atol=1e-9)
    np.testing.assert_allclose(found[:, 0], np.round(found[:, 0], -1))
    assert (found[:, 0] > 5.0).all()
    np.testing.assert_allclose([m.direction for m in measured], 0.0, atol=1e-9)
    assert (np.diff([m.time for m in measured]) > 0).all()
