"""A ROS node of a test: publishers and subscribers of a profile's topics in the process of the test."""

import time
from collections import defaultdict
from threading import Event, Thread

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from emulated import until
from flexneedle.lab.ros.dds import Reader, Writer, participant
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, SUBSCRIBED
from flexneedle.record.messages import STORE

Bool, JointState, PoseArray = (
    ros.std_msgs__msg__Bool,
    ros.sensor_msgs__msg__JointState,
    ros.geometry_msgs__msg__PoseArray,
)
PointStamped, PoseStamped = ros.geometry_msgs__msg__PointStamped, ros.geometry_msgs__msg__PoseStamped
Point, Pose, Quaternion = (
    ros.geometry_msgs__msg__Point,
    ros.geometry_msgs__msg__Pose,
    ros.geometry_msgs__msg__Quaternion,
)


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
"""All peers of a test, whose topics end with it (`tests/ros/conftest.py`): a test that fails keeps its variables."""


class Peer:
    """Subscribes to what a profile publishes, publishes what it subscribes to."""

    def __init__(self, profile, publish=(), subscribe=()):
        self.domain = participant()
        self.readers = {
            key: Reader(
                self.domain, getattr(profile.publish, key).topic, PUBLISHED[key], latched=key in LATCHED
            )
            for key in publish
        }
        self.writers = {
            key: Writer(self.domain, getattr(profile.subscribe, key).topic, SUBSCRIBED[key])
            for key in subscribe
        }
        self.taken = defaultdict(list)
        PEERS.append(self)

    def close(self):
        """End its topics."""
        self.readers, self.writers, self.domain = {}, {}, None

    def await_node(self, node):
        """Wait until the node and this peer have found each other on all topics."""

        def found():
            node.poll()
            return (
                all(node.subscribers.get(key) for key in self.readers)
                and all(reader.writers for reader in self.readers.values())
                and all(writer.readers for writer in self.writers.values())
                and all(node.publishers.get(key) for key in self.writers)
            )

        until(found)

    def send(self, key, message):
        self.writers[key].write(message)

    def received(self, key):
        """All messages of a topic so far."""
        found = (STORE.deserialize_cdr(data, PUBLISHED[key]) for data, _ in self.readers[key].take())
        self.taken[key] += found
        return self.taken[key]


def await_requests(node, kind, count=1):
    """The first `count` requests of a kind."""
    found = []

    def enough():
        found.extend(one for one in node.poll() if isinstance(one, kind))
        return len(found) >= count

    until(enough)
    return found


class Joints(Thread):
    """The other side of a rig of topics: joints that go at once to their targets, reported at 200 Hz.

    targets: all that were received. silent: while it is set nothing is reported.
    """

    def __init__(self, profile, **positions):
        super().__init__(daemon=True)
        topics = profile.publish.joint_targets.topic, profile.subscribe.joint_states.topic
        self.domain = participant()
        self.reader = Reader(self.domain, topics[0], "sensor_msgs/msg/JointState")
        self.writer = Writer(self.domain, topics[1], "sensor_msgs/msg/JointState")
        self.positions, self.targets = dict(positions), []
        self.silent, self.ended, self.free = Event(), Event(), Event()

    def run(self):
        while not self.ended.wait(0.005):
            for data, _ in self.reader.take():
                message = STORE.deserialize_cdr(data, "sensor_msgs/msg/JointState")
                self.targets.append(
                    (time.monotonic(), dict(zip(message.name, message.position.tolist(), strict=True)))
                )
                if not self.free.is_set():
                    self.positions |= self.targets[-1][1]
            if not self.silent.is_set():
                self.writer.write(joints(time.time(), self.positions))

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.join()
        self.reader = self.writer = self.domain = None
