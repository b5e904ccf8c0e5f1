"""The node, a separate process, against a ROS node in the process of the test; both directions."""

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from cyclonedds.core import Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

import flexneedle
from emulated import DEADLINE_S, until
from flexneedle.errors import InputError, RunError
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkState, LinkStop, LinkTarget, NodeLoss
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.ros.client import NodeClient, open_node
from flexneedle.lab.ros.composer import MessageComposer
from flexneedle.lab.ros.dds import TopicReader, TopicWriter, make_user_data
from flexneedle.lab.ros.node import RosNode, make_memory
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import JointTargets, RosHeartbeat, TipReading
from flexneedle.types import VISIBLE, Measurement, Shape
from ros_peers import Bool, Peer, await_requests, cdr, shape, target, tip
from synthetic import make_periods, make_plan

NEUTRAL = load_profile("neutral")
BOOL = "std_msgs/msg/Bool"
STOP = NEUTRAL.subscribe.stop.topic
PLAN = replace(make_plan(), scenario=flexneedle.load_scenario("phantom"))
MEASURED = Measurement(1.5, 1.0, 2.0, 3.0, covariance=((1e-2, 0, 0), (0, 1e-2, 0), (0, 0, 1e-2)))
PERIODS = [
    replace(one, predicted=Shape(one.shape, one.shape[:, 1:3] ** 2), measurement=MEASURED)
    for one in list(make_periods(PLAN))[40:43]
]
STREAMED = ("shape", "predicted_shape", "tip", "measured_tip", "joint_states", "diagnostics")


def of_kind(kind, records):
    return [one for one in records if isinstance(one, kind)]


@pytest.fixture(scope="module")
def node():
    with open_node(NEUTRAL) as node:
        yield node


@pytest.fixture(scope="module")
def measuring():
    """A node that reads measurements and stops, and publishes goals of joints."""
    with NodeClient(NEUTRAL.select(publish=("joint_targets",), subscribe=("tip", "shape", "stop"))) as node:
        yield node


# Published


def test_periods_reach_a_subscriber_as_they_are_composed(node):
    peer, composer = Peer(NEUTRAL, publish=STREAMED), MessageComposer(NEUTRAL)
    peer.await_node(node)
    for period in PERIODS:
        node.publish(period)
    until(lambda: all(len(peer.received(key)) == len(PERIODS) for key in STREAMED))
    reader = peer.readers["shape"]._reader  # the announced type
    data = reader.get_matched_publication_data(reader.get_matched_publications()[0])
    assert data.qos[Policy.Userdata].data == make_user_data("geometry_msgs/msg/PoseArray")
    assert (data.type_name, data.topic_name) == (
        "geometry_msgs::msg::dds_::PoseArray_",
        "rt/flexneedle/needle/shape",
    )
    for number, period in enumerate(PERIODS):
        for key, message in composer.compose(period):
            assert cdr(peer.taken[key][number]) == cdr(message)


def test_late_subscribers_get_plan_scene_and_state(node):
    latched = ("plan", "markers", "state")
    node.publish(PLAN)
    node.publish(LinkState(0.0, "armed"))
    node.publish(LinkState(1.0, "inserting"))
    peer = Peer(NEUTRAL, publish=latched)
    until(lambda: all(peer.received(key) for key in latched))
    until(lambda: peer.received("state")[-1].data == "inserting")
    assert len(peer.taken["plan"]) == 1
    assert len(peer.taken["plan"][0].poses) == len(PLAN.tips)


def test_late_targets_of_joints_are_not_sent(measuring):
    peer = Peer(NEUTRAL, publish=("joint_targets",))
    peer.await_node(measuring)
    measuring.publish(JointTargets(time.monotonic() - 0.2, {"a": 1.0}))
    measuring.publish(JointTargets(time.monotonic() + 60.0, {"a": 2.0}))
    until(lambda: peer.received("joint_targets"))
    assert [message.position.tolist() for message in peer.taken["joint_targets"]] == [[2.0]]


# Received


def test_stops_that_readers_have_in_another_order_are_forwarded_once():
    """Of two stops one reader has the second, when another still has both."""
    sent, stops = [], Subscription(NEUTRAL, "stop")
    node = SimpleNamespace(
        _read=make_memory(),
        _is_repeated=lambda _: False,
        _channel=SimpleNamespace(send=lambda record, **_: sent.append(record)),
    )
    for sources in ((1, 2), (2,), (1, 2)):
        messages = [(cdr(Bool(True)), (7, source)) for source in sources]
        RosNode._forward(node, stops, SimpleNamespace(writers=1, take=lambda messages=messages: messages))
    assert [type(record) for record in sent] == [LinkStop, LinkStop]


def test_a_stop_an_arm_and_a_target_reach_the_rig(node):
    peer, before = Peer(NEUTRAL, subscribe=("stop", "arm", "target")), time.monotonic()
    peer.await_node(node)
    (stop, *_) = of_kind(LinkStop, peer.ask("stop", lambda: Bool(True), node, LinkStop))
    (arm, *_) = of_kind(LinkArm, peer.ask("arm", lambda: Bool(True), node, LinkArm))
    point = (0.035, -0.005, 0.0)
    (wanted, *_) = of_kind(
        LinkTarget, peer.ask("target", lambda: target(time.time(), point), node, LinkTarget)
    )
    assert before < stop.time < arm.time < wanted.time < time.monotonic()
    np.testing.assert_allclose(wanted.point, (35.0, -5.0, 0.0))
    node.poll()
    peer.send("stop", Bool(True))
    stops = await_requests(node, LinkStop) + peer.ask("arm", lambda: Bool(True), node, LinkArm)
    assert len(of_kind(LinkStop, stops)) == 1, "three readers of stops forward one stop"
    unreliable = Peer(NEUTRAL)  # a publisher that does not repeat lost messages
    unreliable.writers["stop"] = TopicWriter(
        unreliable.domain, STOP, BOOL, Qos(Policy.Reliability.BestEffort)
    )
    (stop, *_) = of_kind(LinkStop, unreliable.ask("stop", lambda: Bool(True), node, LinkStop))
    assert stop.source == STOP


def test_a_latched_stop_is_received_at_the_start_and_a_latched_arm_never():
    peer = Peer(NEUTRAL, subscribe=("target",))
    for key in ("stop", "arm"):
        topic = getattr(NEUTRAL.subscribe, key).topic
        peer.writers[key] = TopicWriter(peer.domain, topic, BOOL, latched=True)
        peer.send(key, Bool(True))
    with open_node(NEUTRAL) as node:
        received = peer.await_node(node)
        until(lambda: received.extend(node.poll()) or of_kind(LinkStop, received))
        point = (0.035, 0.0, 0.0)  # a target that is sent later has come, and no arm
        received += peer.ask("target", lambda: target(time.time(), point), node, LinkTarget)
    assert of_kind(LinkStop, received)[0].source == STOP
    assert of_kind(LinkArm, received) == []


def test_a_stop_before_the_first_sign_of_life_is_received(monkeypatch):
    class Process:
        def __init__(self, _module, **_):
            self.channel, self.other = map(MessageChannel, socket.socketpair())
            self.other.send(LinkStop(1.0, "/stop"))
            self.other.send(RosHeartbeat(time.monotonic(), {}, {}))

        def end(self, _seconds):
            self.other.close()

        def close(self):
            self.channel.close()

    monkeypatch.setattr("flexneedle.lab.link.client.ChildProcess", Process)
    with open_node(NEUTRAL) as node:
        assert LinkStop(1.0, "/stop") in node.poll()


def test_tips_and_shapes_reach_the_rig(measuring):
    peer, received, sent = Peer(NEUTRAL, subscribe=("tip", "shape")), [], count()
    while len(tips := of_kind(TipReading, received)) < 20:
        received += peer.ask(
            "tip", lambda: tip(time.time(), (1e-3 * next(sent), 0, 0)), measuring, TipReading
        )
    assert (np.diff([one.number for one in tips]) > 0).all()
    places = np.array([one.position[0] for one in tips])
    np.testing.assert_allclose(places, np.round(places), atol=1e-9)
    assert (np.diff(places) > 0.5).all()
    points = [(0.0, 0.0, 0.0), (0.0013, 0.0, 0.0)]
    ends = []
    while not any(one.position == pytest.approx((1.3, 0.0, 0.0)) for one in of_kind(TipReading, ends)):
        ends += peer.ask("shape", lambda: shape(time.time(), points), measuring, TipReading)


def test_refused_messages_and_a_second_tracker_are_reported(measuring):
    peer = Peer(NEUTRAL, subscribe=("tip",))
    received = peer.ask("tip", lambda: tip(time.time(), frame="map"), measuring, LinkRefusal)
    refused = of_kind(LinkRefusal, received)[0]
    assert refused.source == NEUTRAL.subscribe.tip.topic
    assert "frame_id 'map'" in refused.reason
    Peer(NEUTRAL, subscribe=("tip",)).await_node(measuring)

    def is_refused():
        received = peer.ask("tip", lambda: tip(time.time()), measuring, LinkRefusal | TipReading)
        return any("2 publishers" in refusal.reason for refusal in of_kind(LinkRefusal, received))

    until(is_refused)


def test_a_stop_arrives_in_a_flood_of_measurements_whose_refusals_are_limited(measuring):
    peer = Peer(NEUTRAL, subscribe=("tip", "stop"))
    peer.await_node(measuring)
    begun = time.monotonic()
    for number in range(1000):  # good and bad ones, as fast as they can be sent
        peer.send("tip", tip(time.time(), frame="skin" if number % 2 else "map"))
    received = peer.ask("stop", lambda: Bool(True), measuring, LinkStop)
    seconds = time.monotonic() - begun
    assert len(of_kind(LinkRefusal, received)) <= 2 + seconds / 0.1  # one in 0.1 s


@pytest.mark.parametrize(
    ("kind", "asked", "number"),
    [
        (DataWriter, "_get_matched_subscriptions", lambda domain: TopicWriter(domain, STOP, BOOL).readers),
        (DataReader, "_get_matched_publications", lambda domain: TopicReader(domain, STOP, BOOL).writers),
    ],
)
def test_an_endpoint_that_appears_during_the_count_is_counted(monkeypatch, kind, asked, number):
    found = iter((1, 2, 2, 2))  # Cyclone DDS asks for the number, then for the list
    monkeypatch.setattr(kind, asked, lambda *_: next(found))
    assert number(Peer(NEUTRAL).domain) == 2


# Its process


def test_a_node_that_is_killed_is_lost_once():
    with open_node(NEUTRAL) as node:
        assert node.status == VISIBLE
        os.kill(node.pid, signal.SIGKILL)
        (lost,) = await_requests(node, NodeLoss)
        assert "has ended" in lost.reason
        assert node.status == lost.reason
        assert node.poll() == []
        node.publish(PERIODS[0])  # nothing happens


def test_a_node_that_hangs_is_lost_and_ends_with_the_rig():
    with open_node(NEUTRAL) as node:
        os.kill(node.pid, signal.SIGSTOP)
        (lost,) = await_requests(node, NodeLoss)
        assert "does not answer" in lost.reason
        os.kill(node.pid, signal.SIGCONT)
        node._process.channel.close()  # as if the rig had ended
        assert node._process.wait(DEADLINE_S) == 0


def test_an_obstacle_to_a_node_is_one_line(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", "400")
        with pytest.raises(RunError, match=r"^ROS_DOMAIN_ID = '400'"):
            open_node(NEUTRAL)
    monkeypatch.setattr("flexneedle.lab.ros.client.find_spec", lambda _name: None)
    with pytest.raises(InputError, match=r"pip install 'flexneedle\[ros\]'"):
        open_node(NEUTRAL)


def test_the_rig_itself_runs_no_thread_of_dds():
    """Only the node's process loads the library."""
    script = (
        "import sys\n"
        "import flexneedle.lab.ros.client, flexneedle.lab.ros.tracker, flexneedle.lab.ros.motors\n"
        "assert not any(name.startswith('cyclonedds') for name in sys.modules), sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
