"""The tracker `ros`: a tip on a topic becomes frames."""

import time
from dataclasses import replace

import numpy as np
import pytest

from emulated import until
from flexneedle.errors import RigError
from flexneedle.geometry.registration import identity
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import Lost, Refused, ShapeReading, TipReading
from flexneedle.lab.ros.tracker import RosTracker, make_tracker
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.types import VISIBLE
from rooms import ManualClock
from ros_peers import Peer, shape, tip

NEUTRAL = load_profile("neutral")


class Node:
    """A node of whose records the test disposes."""

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


def test_a_reading_is_a_frame_once(node, tracker):
    node.records = [reading(7), reading(9)]
    frames = tracker.read()
    assert [frame.number for frame in frames] == [7, 9]
    assert frames[0].readings["tip"].position == (1.0, 2.0, 3.0)
    assert tracker.read() == ()


def test_times_are_on_the_clock_of_the_run(node):
    clock = ManualClock()
    clock.time = 12.0
    tracker, now = RosTracker(node, clock, late_s=0.25), time.monotonic()
    node.records = [reading(at=now - 0.01)]
    (frame,) = tracker.read()
    assert frame.time == pytest.approx(11.99, abs=0.005)


def test_the_last_pose_of_a_shape_is_the_tip(node, tracker):
    node.records = [ShapeReading(((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)), reading())]
    assert tracker.read()[0].readings["tip"].position == (1.0, 2.0, 3.0)


def test_a_tip_that_is_nowhere_has_its_reason(node, tracker):
    node.records = [reading(position=None, status="position (nan, 0, 0): not a number")]
    (frame,) = tracker.read()
    assert frame.readings["tip"].status == "position (nan, 0, 0): not a number"


def test_the_status_is_why_no_frame_arrives(node, tracker):
    node.records = [reading()]
    tracker.read()
    assert tracker.status == VISIBLE
    until(lambda: tracker.status != VISIBLE)
    assert tracker.status.startswith("no frame for 0.")
    node.records = [Refused(0.0, "/tip", "old data: its stamp is 0.000 s before that of the last message")]
    assert tracker.read() == ()
    assert tracker.status == "/tip: old data: its stamp is 0.000 s before that of the last message"
    node.records = [reading(2)]
    tracker.read()
    assert tracker.status == VISIBLE


def test_a_lost_node_is_the_status(node, tracker):
    node.records, node.status = [Lost(0.0, "the ROS node has ended")], "the ROS node has ended"
    assert tracker.read() == ()
    assert tracker.status == "the ROS node has ended"


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"profile": "nobody"}, "nobody: no such file, and no such profile"),
        ({"source": "nose"}, 'source = "nose": must be one of tip, shape'),
        ({"late_ms": -1.0}, "late_ms = -1.0: must be above 0"),
        ({"topic": "/tip"}, 'topic = "/tip": unknown key'),
        ({"profile": "smartneedle", "source": "shape"}, 'profile = "smartneedle": must list subscribe.shape'),
    ],
)
def test_invalid_settings_are_one_line(settings, line):
    with pytest.raises(RigError) as caught:
        make_tracker(settings, WallClock())
    assert caught.value.problems[0].startswith(line)


def test_tips_of_smartneedle_reach_the_stage_of_the_insertion():
    """Its /sensor/tip: mm, insertion along y, sent by a process that is not ours."""
    profile = load_profile("smartneedle")
    with make_tracker({"profile": "smartneedle"}, WallClock()) as tracker:
        peer, measured = Peer(profile, subscribe=("tip",)), []
        peer.await_node(tracker._node)
        stage = OnStage(tracker, identity())
        for depth in (10.0, 20.0, 30.0):
            along_y = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # its z, along the needle, is y of its stage
            peer.send("tip", tip(time.time(), (-1.0, depth, 2.0), along_y, "stage"))
        until(lambda: measured.extend(stage.read()) or len(measured) == 3)
    np.testing.assert_allclose([(m.x, m.y, m.z) for m in measured], [(d, 2.0, -1.0) for d in (10, 20, 30)])
    np.testing.assert_allclose([m.direction for m in measured], 0.0, atol=1e-9)
    assert (np.diff([m.time for m in measured]) > 0).all()


def test_a_shape_of_the_fibre_optic_needle():
    profile = load_profile("smartneedle-fbg")
    with make_tracker({"profile": "smartneedle-fbg", "source": "shape"}, WallClock()) as tracker:
        peer, frames = Peer(profile, subscribe=("shape",)), []
        peer.await_node(tracker._node)
        peer.send("shape", shape(time.time(), [(0.0, 0.0, z) for z in (0.0, 5.0, 10.0)], frame="needle"))
        until(lambda: frames.extend(tracker.read()) or frames)
    assert frames[0].readings["tip"].position == pytest.approx((10.0, 0.0, 0.0))
