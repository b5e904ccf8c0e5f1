"""A second vendor: eProsima Fast DDS receives what the node publishes and publishes what the node reads."""

import os
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from emulated import DEADLINE_S, until
from flexneedle.lab.link.records import LinkState, LinkStop
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.composer import MessageComposer
from flexneedle.lab.ros.dds import TopicReader, TopicWriter
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, load_profile
from flexneedle.lab.ros.records import JointTargets, TipReading
from flexneedle.types import Measurement, Shape
from lab.ros.fastdds.build import build, label, missing
from ros_peers import Bool, Peer, cdr
from synthetic import make_periods, make_plan

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(missing()), reason=missing())]

NEUTRAL, SMARTNEEDLE = load_profile("neutral"), load_profile("smartneedle")
KINDS = (*dict.fromkeys(PUBLISHED.values()), "std_msgs/msg/Bool")
PLAN = replace(make_plan(), scenario=flexneedle.load_scenario("phantom"))
MEASURED = Measurement(1.5, 1.0, 2.0, 3.0, covariance=((1e-2, 0, 0), (0, 1e-2, 0), (0, 0, 1e-2)))
PERIOD = replace(next(iter(make_periods(PLAN))), measurement=MEASURED)
PERIOD = replace(PERIOD, predicted=Shape(PERIOD.shape, PERIOD.shape[:, 1:3] ** 2))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build(tmp_path_factory.mktemp("fastdds"), KINDS)


@contextmanager
def fast_dds(program, *links):
    """Run the peer."""
    command = [str(program), os.environ["ROS_DOMAIN_ID"], *links]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        yield
    finally:
        process.stdin.close()
        process.wait(DEADLINE_S)
        process.stdout.close()


@pytest.mark.parametrize("profile", [NEUTRAL, SMARTNEEDLE], ids=["neutral", "smartneedle"])
def test_every_message_of_the_node_returns_unchanged(program, profile):
    """Node to Fast DDS to a subscriber: decoded and encoded by the other vendor's code, equal to the last byte."""
    own = profile.select(publish=[key for key in PUBLISHED if getattr(profile.publish, key)])
    topics = {key: getattr(own.publish, key).topic for key in PUBLISHED if getattr(own.publish, key)}
    links = [
        f"{label(PUBLISHED[key])}:{topic}:/echo{topic}{':latched' if key in LATCHED else ''}"
        for key, topic in topics.items()
    ]
    records = [
        PLAN,
        PERIOD,
        LinkState(1.0, "armed"),
        JointTargets(time.monotonic() + 30.0, {"a": 1.0, "b": 2.0}),
    ]
    composer = MessageComposer(own)
    expected = {one.key: cdr(one.message) for record in records for one in composer.compose(record)}
    with NodeClient(own) as node, fast_dds(program, *links):
        peer = Peer(own)
        readers = {
            key: TopicReader(peer.domain, f"/echo{topic}", PUBLISHED[key], latched=key in LATCHED)
            for key, topic in topics.items()
        }
        until(lambda: all(reader.writers for reader in readers.values()))
        until(lambda: node.poll() or all(node.subscribers[key] for key in topics))
        found, sent = {}, []

        def have_returned():
            """Send repeatedly: messages from before two topics have found each other are lost."""
            if not sent or time.monotonic() > sent[-1] + 0.5:
                sent.append(time.monotonic())
                for record in records:
                    node.publish(record)
            for key, reader in readers.items():
                for data, _ in reader.take():
                    found[key] = data[: len(expected[key])]
            return found == expected

        until(have_returned)


def test_messages_of_fast_dds_are_read(program):
    """The node receives its own tip, shape and a stop through Fast DDS as measurements and a request."""
    publish, subscribe = NEUTRAL.publish, NEUTRAL.subscribe
    links = [
        f"PoseStamped:{publish.tip.topic}:{subscribe.tip.topic}",
        f"PoseArray:{publish.shape.topic}:{subscribe.shape.topic}",
        f"Bool:/button:{subscribe.stop.topic}",
    ]
    with NodeClient(NEUTRAL, epoch=1e9) as node, fast_dds(program, *links):
        peer = Peer(NEUTRAL)
        button = TopicWriter(peer.domain, "/button", "std_msgs/msg/Bool")
        until(lambda: button.readers)
        requests = []

        def answered():
            node.publish(replace(PERIOD, time=PERIOD.time + 0.01 * len(requests)))
            button.write(Bool(True))
            requests.extend(node.poll())
            tips = [one.position for one in requests if isinstance(one, TipReading)]
            ends = PERIOD.estimate.point, PERIOD.shape[-1, :3]
            read = [any(np.allclose(end, tip, atol=1e-9) for tip in tips) for end in ends]
            return all(read) and any(isinstance(one, LinkStop) for one in requests)

        until(answered)
