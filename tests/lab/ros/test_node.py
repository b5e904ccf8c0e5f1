"""The node, a process of its own, against a ROS node in the process of the test; both directions."""

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from cyclonedds.core import Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

import flexneedle
from emulated import until
from flexneedle.errors import InputError, RunError
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.ros import client
from flexneedle.lab.ros.client import NodeClient, open_node
from flexneedle.lab.ros.dds import Reader, Writer
from flexneedle.lab.ros.idl import type_hash
from flexneedle.lab.ros.messages import Composer
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import (
    Arm,
    Beat,
    JointTargets,
    Lost,
    Refused,
    RigState,
    ShapeReading,
    Stop,
    Target,
    TipReading,
)
from flexneedle.types import VISIBLE, Measurement, Shape
from ros_peers import Bool, Peer, await_requests, cdr, shape, target, tip
from synthetic import make_periods, make_plan

NEUTRAL = load_profile("neutral")
TOPIC = NEUTRAL.subscribe.stop.topic, "std_msgs/msg/Bool"
PLAN = replace(make_plan(), scenario=flexneedle.load_scenario("phantom"))
MEASURED = Measurement(1.5, 1.0, 2.0, 3.0, covariance=((1e-2, 0, 0), (0, 1e-2, 0), (0, 0, 1e-2)))
PERIODS = [
    replace(one, predicted=Shape(one.shape, one.shape[:, 1:3] ** 2), measurement=MEASURED)
    for one in list(make_periods(PLAN))[40:43]
]
STREAMED = ("shape", "predicted_shape", "tip", "measured_tip", "joint_states", "diagnostics")


@pytest.fixture(scope="module")
def node():
    with open_node(NEUTRAL) as node:
        yield node


@pytest.fixture(scope="module")
def measuring():
    """A node that reads all that is measured."""
    with NodeClient(NEUTRAL.only(subscribe=("tip", "shape"))) as node:
        yield node


def test_periods_reach_a_subscriber_as_they_are_composed(node):
    peer = Peer(NEUTRAL, publish=STREAMED)
    peer.await_node(node)
    for period in PERIODS:
        node.publish(period)
    until(lambda: all(len(peer.received(key)) == len(PERIODS) for key in STREAMED))
    composer = Composer(NEUTRAL)
    for number, period in enumerate(PERIODS):
        for key, message in composer.messages(period):
            assert cdr(peer.taken[key][number]) == cdr(message)


@pytest.mark.parametrize("profile", ["neutral", "smartneedle"])
def test_late_subscribers_get_plan_scene_and_state(profile):
    profile = load_profile(profile)
    latched = [key for key in ("plan", "markers", "skin_entry", "state") if getattr(profile.publish, key)]
    with open_node(profile) as node:
        node.publish(PLAN)
        node.publish(RigState(0.0, "armed"))
        node.publish(RigState(1.0, "inserting"))
        peer = Peer(profile, publish=latched)
        until(lambda: all(peer.received(key) for key in latched))
        until(lambda: peer.received("state")[-1].data == "inserting")
    assert len(peer.taken["plan"]) == 1
    assert len(peer.taken["plan"][0].poses) == len(PLAN.tips)


def test_a_stop_an_arm_and_a_target_reach_the_rig(node):
    peer = Peer(NEUTRAL, subscribe=("stop", "arm", "target"))
    peer.await_node(node)
    before = time.monotonic()
    peer.send("stop", Bool(True))
    (stop,) = await_requests(node, Stop)
    peer.send("arm", Bool(True))
    (arm,) = await_requests(node, Arm)
    peer.send("target", target(time.time(), (0.035, -0.005, 0.0)))
    (wanted,) = await_requests(node, Target)
    assert before < stop.time < arm.time < wanted.time < time.monotonic()
    np.testing.assert_allclose(wanted.point, (35.0, -5.0, 0.0))
    assert node.poll() == []  # the three readers of stops forward one stop


def test_a_stop_is_taken_from_a_publisher_that_does_not_repeat_what_is_lost(node):
    peer = Peer(NEUTRAL)
    once = Qos(Policy.Reliability.BestEffort)
    writer = Writer(peer.domain, NEUTRAL.subscribe.stop.topic, "std_msgs/msg/Bool", once)

    found = []

    def stopped():
        writer.write(Bool(True))
        found.extend(request for request in node.poll() if isinstance(request, Stop))
        return found

    until(stopped)
    assert found[0].topic == NEUTRAL.subscribe.stop.topic


@pytest.mark.parametrize(
    ("kind", "asked", "count"),
    [
        (DataWriter, "_get_matched_subscriptions", lambda domain: Writer(domain, *TOPIC).readers),
        (DataReader, "_get_matched_publications", lambda domain: Reader(domain, *TOPIC).writers),
    ],
)
def test_one_that_comes_while_they_are_counted_is_counted(monkeypatch, kind, asked, count):
    found = iter((1, 2, 2, 2))  # Cyclone DDS asks for the number, then for as many
    monkeypatch.setattr(kind, asked, lambda *_: next(found))
    assert count(Peer(NEUTRAL).domain) == 2


def test_a_stop_that_was_latched_before_the_start_is_received():
    peer = Peer(NEUTRAL)
    writer = Writer(peer.domain, NEUTRAL.subscribe.stop.topic, "std_msgs/msg/Bool", latched=True)
    writer.write(Bool(True))
    with open_node(NEUTRAL) as node:
        (stop, *_) = await_requests(node, Stop)
    assert stop.topic == NEUTRAL.subscribe.stop.topic


def test_a_stop_that_comes_before_the_first_sign_of_life_is_received(monkeypatch):
    class Process:
        def __init__(self, _module, **_):
            self.channel, self.other = map(MessageChannel, socket.socketpair())
            self.other.send(Stop(1.0, "/stop"))
            self.other.send(Beat(time.monotonic(), {}, {}))

        def end(self, _seconds):
            self.other.close()

        def close(self):
            self.channel.close()

    monkeypatch.setattr(client, "ChildProcess", Process)
    with open_node(NEUTRAL) as node:
        assert Stop(1.0, "/stop") in node.poll()


def test_an_arm_that_was_latched_before_the_start_is_not_received():
    peer = Peer(NEUTRAL, subscribe=("stop",))
    writer = Writer(peer.domain, NEUTRAL.subscribe.arm.topic, "std_msgs/msg/Bool", latched=True)
    writer.write(Bool(True))
    with open_node(NEUTRAL) as node:
        peer.await_node(node)
        until(lambda: writer.readers)
        peer.send("stop", Bool(True))
        requests = []
        until(lambda: requests.extend(node.poll()) or any(isinstance(one, Stop) for one in requests))
    assert not any(isinstance(one, Arm) for one in requests)


def test_tips_and_shapes_reach_the_rig(measuring):
    peer = Peer(NEUTRAL, subscribe=("tip", "shape"))
    peer.await_node(measuring)
    begun = time.time()
    for number in range(20):
        peer.send("tip", tip(begun + 0.025 * number, (0.001 * number, 0.0, 0.0)))
    found = await_requests(measuring, TipReading, 20)
    assert [one.number for one in found] == list(range(found[0].number, found[0].number + 20))
    np.testing.assert_allclose([one.position[0] for one in found], range(20))
    peer.send("shape", shape(begun, [(0.0, 0.0, 0.0), (0.0013, 0.0, 0.0)]))
    (curve,) = await_requests(measuring, ShapeReading)
    np.testing.assert_allclose(curve.points, [(0, 0, 0), (1.3, 0, 0)])


def test_what_is_refused_is_reported(measuring):
    peer = Peer(NEUTRAL, subscribe=("tip",))
    peer.await_node(measuring)
    refused = []

    def sent():
        peer.send("tip", tip(time.time(), frame="map"))  # again, since a best-effort message may be lost
        refused.extend(one for one in measuring.poll() if isinstance(one, Refused))
        return refused

    until(sent)
    assert refused[0].topic == "/flexneedle/tracker/tip"
    assert refused[0].reason == "frame_id 'map': must be 'skin'"


def test_two_trackers_on_one_topic_are_refused(measuring):
    one, other = Peer(NEUTRAL, subscribe=("tip",)), Peer(NEUTRAL, subscribe=("tip",))
    one.await_node(measuring)
    other.await_node(measuring)

    refused = []

    def both():
        one.send("tip", tip(time.time()))
        refused.extend(r for r in measuring.poll() if isinstance(r, Refused) and "2 publishers" in r.reason)
        return refused

    until(both)
    assert refused[0].topic == "/flexneedle/tracker/tip"


def test_a_flood_of_measurements_does_not_hold_up_a_stop():
    with NodeClient(NEUTRAL.only(subscribe=("tip", "stop"))) as node:
        peer = Peer(NEUTRAL, subscribe=("tip", "stop"))
        peer.await_node(node)
        begun = time.time()
        for number in range(3000):  # good and bad ones, as fast as they can be sent
            peer.send("tip", tip(begun + number, frame="skin" if number % 2 else "map"))
        sent = time.monotonic()
        peer.send("stop", Bool(True))
        requests = []
        until(lambda: requests.extend(node.poll()) or any(isinstance(one, Stop) for one in requests))
    stop = next(one for one in requests if isinstance(one, Stop))
    assert stop.time - sent < 1.0
    assert sum(isinstance(one, Refused) for one in requests) < 60  # one in 0.1 s


def test_targets_of_joints_that_are_late_are_not_sent():
    profile = NEUTRAL.only(publish=("joint_targets",))
    with NodeClient(profile) as node:
        peer = Peer(profile, publish=("joint_targets",))
        peer.await_node(node)
        node.publish(JointTargets(time.monotonic() - 0.2, {"a": 1.0}))
        node.publish(JointTargets(time.monotonic() + 10.0, {"a": 2.0}))
        until(lambda: peer.received("joint_targets"))
    assert [message.position.tolist() for message in peer.taken["joint_targets"]] == [[2.0]]


def test_what_the_node_publishes_is_not_read_back():
    """Cyclone could deliver a participant's own samples; a profile cannot have a topic both ways, either."""
    topic = NEUTRAL.subscribe.target.topic
    peer = Peer(NEUTRAL)
    own = Reader(peer.domain, topic, "geometry_msgs/msg/PointStamped")
    writer = Writer(peer.domain, topic, "geometry_msgs/msg/PointStamped")
    other = Peer(NEUTRAL)
    seen = Reader(other.domain, topic, "geometry_msgs/msg/PointStamped")
    until(lambda: seen.writers)
    writer.write(target(1.0, (0.0, 0.0, 0.0)))
    until(lambda: list(seen.take()))
    assert list(own.take()) == []


def test_a_node_that_is_killed_is_lost_once():
    with open_node(NEUTRAL) as node:
        assert node.status == VISIBLE
        os.kill(node.pid, signal.SIGKILL)
        (lost,) = await_requests(node, Lost)
        assert lost.reason == "the ROS node has ended"
        assert node.status == lost.reason
        assert node.poll() == []
        node.publish(PERIODS[0])  # nothing happens


def test_a_node_that_hangs_is_lost():
    with open_node(NEUTRAL) as node:
        os.kill(node.pid, signal.SIGSTOP)
        (lost,) = await_requests(node, Lost)
        assert "does not answer for 1." in lost.reason
        os.kill(node.pid, signal.SIGCONT)


def test_publishing_does_not_wait_for_a_node_that_hangs():
    with open_node(NEUTRAL) as node:
        os.kill(node.pid, signal.SIGSTOP)
        longest = 0.0
        for _ in range(1000):  # 10 MB
            before = time.perf_counter()
            node.publish(PERIODS[0])
            longest = max(longest, time.perf_counter() - before)
        os.kill(node.pid, signal.SIGCONT)
        assert node.dropped > 0
    assert longest < 0.5


def test_the_node_ends_with_the_rig():
    node = open_node(NEUTRAL)
    process = node._process
    process.channel.close()
    assert process.wait(20.0) == 0
    process.close()


def test_a_wrong_domain_is_one_line(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "400")
    with pytest.raises(RunError, match="ROS_DOMAIN_ID = '400': must be a whole number from 0 to 232"):
        open_node(NEUTRAL)


def test_without_cyclonedds_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(client, "find_spec", lambda _name: None)
    with pytest.raises(InputError, match=r"pip install 'flexneedle\[ros\]'"):
        open_node(NEUTRAL)


def test_type_hashes_are_announced(node):
    peer = Peer(NEUTRAL, publish=("shape",), subscribe=("stop",))
    peer.await_node(node)
    reader = peer.readers["shape"]._reader
    data = reader.get_matched_publication_data(reader.get_matched_publications()[0])
    assert data.qos[Policy.Userdata].data == f"typehash={type_hash('geometry_msgs/msg/PoseArray')};".encode()
    assert data.type_name == "geometry_msgs::msg::dds_::PoseArray_"
    assert data.topic_name == "rt/flexneedle/needle/shape"


def test_the_rig_itself_runs_no_thread_of_dds():
    """Only the node's process loads the library."""
    script = (
        "import sys\n"
        "from flexneedle.lab.ros.client import open_node\n"
        "from flexneedle.lab.ros.profile import load_profile\n"
        "import flexneedle.lab.ros.tracker, flexneedle.lab.ros.motors\n"
        "with open_node(load_profile('neutral')) as node:\n"
        "    assert node.poll() == []\n"
        "assert not any(name.startswith('cyclonedds') for name in sys.modules), sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
