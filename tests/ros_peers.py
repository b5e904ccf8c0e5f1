"""A ROS node of a test: publishers and subscribers of a profile's topics in the process of the test."""

import time
from collections import defaultdict
from contextlib import contextmanager
from threading import Event, Thread

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from emulated import until
from flexneedle.lab.ros.dds import TopicReader, TopicWriter, join_domain
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, SUBSCRIBED
from flexneedle.record.messages import STORE

Bool = ros.std_msgs__msg__Bool
JointState = ros.sensor_msgs__msg__JointState
PoseArray = ros.geometry_msgs__msg__PoseArray
PointStamped = ros.geometry_msgs__msg__PointStamped
PoseStamped = ros.geometry_msgs__msg__PoseStamped
Point = ros.geometry_msgs__msg__Point
Pose = ros.geometry_msgs__msg__Pose
Quaternion = ros.geometry_msgs__msg__Quaternion


def header(stamp, frame="skin"):
    seconds, rest = divmod(round(stamp * 1e9), 1_000_000_000)
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(seconds, rest), frame)


def pose(xyz=(0.0, 0.0, 0.0), xyzw=(0.0, 0.0, 0.0, 1.0)):
    return Pose(Point(*map(float, xyz)), Quaternion(*map(float, xyzw)))


def tip(stamp, xyz=(0.0, 0.0, 0.0), xyzw=(0.0, 0.0, 0.0, 1.0), frame="skin"):
    return PoseStamped(header(stamp, frame), pose(xyz, xyzw))


def shape(stamp, points, xyzw=(0.0, 0.0, 0.0, 1.0), frame="skin"):
    return PoseArray(header(stamp, frame), [pose(xyz, xyzw) for xyz in points])


def target(stamp, xyz, frame="skin"):
    return PointStamped(header(stamp, frame), Point(*map(float, xyz)))


def joints(stamp, positions, velocities=()):
    values = np.array(list(positions.values()), dtype=float)
    return JointState(
        header(stamp, ""), list(positions), values, np.array(velocities, dtype=float), np.empty(0)
    )


def cdr(message, kind=None):
    return bytes(STORE.serialize_cdr(message, kind or message.__msgtype__))


PEERS = []
"""All peers of a test, whose topics end with it (`lab/ros/conftest.py`): a test that fails keeps its variables."""


class Peer:
    """Subscribes to what a profile publishes, publishes what it subscribes to."""

    def __init__(self, profile, publish=(), subscribe=()):
        self.domain, self.taken = join_domain(), defaultdict(list)
        self.readers = {
            key: TopicReader(
                self.domain, getattr(profile.publish, key).topic, PUBLISHED[key], latched=key in LATCHED
            )
            for key in publish
        }
        self.writers = {
            key: TopicWriter(self.domain, getattr(profile.subscribe, key).topic, SUBSCRIBED[key])
            for key in subscribe
        }
        PEERS.append(self)

    def close(self):
        """End its topics."""
        self.readers, self.writers, self.domain = {}, {}, None

    def await_node(self, node):
        """Wait until the node has found this peer on all topics; return what it has received meanwhile.

        The peer may not have found the node yet: another node in the domain matches its topics, too. What is sent only
        once may be lost: use `ask`.
        """
        received = []

        def found():
            received.extend(node.poll())
            return all(map(node.subscribers.get, self.readers)) and all(
                map(node.publishers.get, self.writers)
            )

        until(found)
        return received

    def send(self, key, message):
        self.writers[key].write(message)

    def ask(self, key, make, node, kind):
        """Send messages until the node returns a record of a kind; return all that it has returned."""
        received = []

        def answered():
            self.send(key, make())
            received.extend(node.poll())
            return any(isinstance(one, kind) for one in received)

        until(answered)
        return received

    def received(self, key):
        """All messages of a topic until now."""
        found = (STORE.deserialize_cdr(data, PUBLISHED[key]) for data, _ in self.readers[key].take())
        self.taken[key] += found
        return self.taken[key]


def await_requests(node, kind, count=1):
    """The first `count` records of a kind."""
    found = []

    def enough():
        found.extend(one for one in node.poll() if isinstance(one, kind))
        return len(found) >= count

    until(enough)
    return found


@contextmanager
def publishing(*topics):
    """Another participant that publishes (topic, make a message, options of its writer) at 50 Hz; latched ones once."""
    domain, ended = join_domain(), Event()
    made = [(TopicWriter(domain, topic, make().__msgtype__, **how), make, how) for topic, make, how in topics]

    def publish():
        for writer, make, how in made:
            if "latched" in how:
                writer.write(make())
        while not ended.wait(0.02):
            for writer, make, how in made:
                if "latched" not in how:
                    writer.write(make())

    thread = Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        made.clear()


class Joints(Thread):
    """The other side of a rig of topics: joints that go at once to their goals, reported at 200 Hz.

    targets: all received goals. silent: while it is set nothing is reported. free: while it is set goals are ignored.
    """

    def __init__(self, profile, **positions):
        super().__init__(daemon=True)
        topics = profile.publish.joint_targets.topic, profile.subscribe.joint_states.topic
        self.domain = join_domain()
        self.reader = TopicReader(self.domain, topics[0], "sensor_msgs/msg/JointState")
        self.writer = TopicWriter(self.domain, topics[1], "sensor_msgs/msg/JointState")
        self.positions, self.targets = dict(positions), []
        self.silent, self.ended, self.free = Event(), Event(), Event()

    def run(self):
        while not self.ended.wait(0.005):
            for data, _ in self.reader.take():
                message = STORE.deserialize_cdr(data, "sensor_msgs/msg/JointState")
                goals = dict(zip(message.name, message.position.tolist(), strict=True))
                self.targets.append((time.monotonic(), goals))
                if not self.free.is_set():
                    self.positions |= goals
            if not self.silent.is_set():
                self.writer.write(joints(time.time(), self.positions))

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.join()
        self.reader = self.writer = self.domain = None
