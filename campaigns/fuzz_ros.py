"""Random and damaged messages to all readers of ROS topics: no crash, no hang, no motion (`make fuzz-ros`).

    python campaigns/fuzz_ros.py [--inputs N] [--seconds S] [--seed N] [--part messages|live]

Inputs are random bytes, messages with changed, missing or repeated bytes, and valid messages with odd numbers (not a
number, infinite, huge, tiny), texts, counts and stamps, on every topic of a profile. Each must give a record or a
refusal with its reason, within a second; positions must be finite and near, and only a valid `true` may arm. Driver
and tracker `ros` get the records: the driver must not send a target. The part `live` sends the bytes over DDS to a
running node, which must not arm, and still forward stops. Each part ends after N inputs (default: a million) or S
seconds (default: 600). Prints the inputs; at the first failure its seed and input, and exit status 1.
"""

import itertools
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from random import Random
from typing import Any

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from flexneedle.errors import DriverError
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, LinkTarget
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.fbg.mounting import MountingSettings, SiteMap
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.frames import FARTHEST_MM
from flexneedle.lab.ros.motors import JointLink, RosMotors
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import CURVATURES, POINT, SHAPE, SUBSCRIBED, load_profile
from flexneedle.lab.ros.records import JointReading, Received, TipReading
from flexneedle.lab.ros.sensor import RosFbg, RosSensor
from flexneedle.lab.ros.tracker import RosTracker
from flexneedle.record.messages import STORE
from flexneedle.types import VISIBLE, Reading
from fuzzing import Failure, main

SLOWEST_S = 1.0
HEADER_BYTES, FALSE = 4, b"\0"  # of a Bool
PROFILES = ("neutral", "smartneedle", "smartneedle-fbg")
ODD = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-3, 0.04, 35.0, 9.9, 1e4, -1e9, 1e300, math.inf, -math.inf, math.nan)
TEXTS = ("", "skin", "/skin", "needle", "stage", "map", "é\u2028\x1b", "x" * 5000)
STAMPS = (0, 1, -1, 2**31 - 1, -(2**31))

Bytes = Callable[[np.random.Generator, str], bytes]


# Inputs


def random_bytes(rng: np.random.Generator, _key: str) -> bytes:
    """Any bytes, half of them with a header of CDR."""
    header = bytes([0, rng.integers(2), 0, 0]) if rng.random() < 0.5 else b""
    return header + rng.bytes(int(rng.integers(200)))


def damage(rng: np.random.Generator, key: str) -> bytes:
    """A valid message with changed, missing or repeated bytes."""
    data = bytearray(valid(rng, key))
    for _ in range(int(rng.integers(1, 6))):
        place = int(rng.integers(len(data))) if data else 0
        match int(rng.integers(5)):
            case 0 if data:
                data[place] = int(rng.integers(256))
            case 1:
                data[place : place + int(rng.integers(1, 20))] = b""
            case 2:
                data[place:place] = data[place : place + int(rng.integers(1, 40))]
            case 3:
                data[place : place + 4] = (0xFFFFFFFF - int(rng.integers(3))).to_bytes(4, "little")
            case _:
                data += rng.bytes(int(rng.integers(10)))
    return bytes(data)


def valid(rng: np.random.Generator, key: str) -> bytes:
    """A message that can be read, with odd contents."""
    message = MESSAGES[key](rng)
    return bytes(STORE.serialize_cdr(message, TYPES[key], little_endian=bool(rng.random() < 0.9)))


def _number(rng: np.random.Generator) -> float:
    return float(rng.choice(ODD)) if rng.random() < 0.3 else float(rng.normal(scale=0.05))


def _header(rng: np.random.Generator) -> ros.std_msgs__msg__Header:
    second = int(rng.choice(STAMPS)) if rng.random() < 0.2 else int(rng.integers(1_000_000))
    text = str(rng.choice(TEXTS)) if rng.random() < 0.2 else str(rng.choice(("skin", "stage", "needle")))
    return ros.std_msgs__msg__Header(
        ros.builtin_interfaces__msg__Time(second, int(rng.integers(2**32))), text
    )


def _point(rng: np.random.Generator) -> ros.geometry_msgs__msg__Point:
    return ros.geometry_msgs__msg__Point(_number(rng), _number(rng), _number(rng))


def _pose(rng: np.random.Generator) -> ros.geometry_msgs__msg__Pose:
    turn = rng.normal(size=4)
    turn = turn / np.linalg.norm(turn) if rng.random() < 0.7 else [_number(rng) for _ in range(4)]
    return ros.geometry_msgs__msg__Pose(_point(rng), ros.geometry_msgs__msg__Quaternion(*map(float, turn)))


def _shape(rng: np.random.Generator) -> ros.geometry_msgs__msg__PoseArray:
    count = int(rng.choice((0, 1, 2, 30, 300), p=(0.2, 0.2, 0.3, 0.2, 0.1)))
    return ros.geometry_msgs__msg__PoseArray(_header(rng), [_pose(rng) for _ in range(count)])


def _curvatures(rng: np.random.Generator) -> ros.std_msgs__msg__Float64MultiArray:
    count = int(rng.choice((0, 1, 4, 6, 36)))
    sizes = rng.choice((0, 2, 3, 16, 24, 2**32 - 1), size=int(rng.choice((0, 0, 1, 2, 2, 3))))
    dimensions = [ros.std_msgs__msg__MultiArrayDimension("x", int(size), 8) for size in sizes]
    layout = ros.std_msgs__msg__MultiArrayLayout(dimensions, int(rng.random() < 0.1))
    return ros.std_msgs__msg__Float64MultiArray(layout, np.array([_number(rng) for _ in range(count)]))


def _joints(rng: np.random.Generator) -> ros.sensor_msgs__msg__JointState:
    counts = rng.integers(0, 5, size=4) if rng.random() < 0.3 else [int(rng.integers(1, 5))] * 4
    names = [str(name) for name in rng.choice(("a", "b", "c", "d", *TEXTS), size=counts[0])]
    if rng.random() < 0.5:
        names, counts = ["a", "b"], [2, 2, *counts[2:]]
        counts[2] = int(rng.choice((0, 2)))
    position, velocity, effort = (np.array([_number(rng) for _ in range(count)]) for count in counts[1:])
    return ros.sensor_msgs__msg__JointState(_header(rng), names, position, velocity, effort)


def _flag(rng: np.random.Generator) -> ros.std_msgs__msg__Bool:
    return ros.std_msgs__msg__Bool(bool(rng.integers(2)))


MESSAGES = {
    "tip": lambda rng: ros.geometry_msgs__msg__PoseStamped(_header(rng), _pose(rng)),
    "shape": _shape,
    "target": lambda rng: ros.geometry_msgs__msg__PointStamped(_header(rng), _point(rng)),
    "stop": _flag,
    "arm": _flag,
    "joint_states": _joints,
}
MESSAGES |= {
    "sensors.curvatures": _curvatures,
    "sensors.shape": _shape,
    "sensors.points": _shape,
    "sensors.crossing": MESSAGES["target"],
}
TYPES = SUBSCRIBED | {
    "sensors.curvatures": CURVATURES,
    "sensors.shape": SHAPE,
    "sensors.points": SHAPE,
    "sensors.crossing": POINT,
}
KINDS: dict[str, Bytes] = {"random": random_bytes, "damaged": damage, "valid": valid}


# What must hold


def problem(key: str, data: bytes, record: Received | None) -> str:
    """Return why a record must not be made of these bytes, or ""."""
    match record:
        case None:
            nothing = key == "stop" and data[HEADER_BYTES : HEADER_BYTES + 1] == FALSE
            return "" if nothing else "no record"
        case LinkArm():
            fine = key == "arm" and len(data) >= 5 and data[4] == 1
            return "" if fine else "armed"
        case LinkStop(reason=reason):
            fine = key in ("stop", "arm")
            return "" if fine and reason == " ".join(reason.split()) else f"stop from {key}"
        case LinkRefusal(reason=reason):
            return "" if reason and reason.isprintable() and len(reason) < 300 else f"reason {reason!r}"
        case LinkTarget(point=point):
            return _far([point])
        case TipReading(position=position, orientation=turn, status=status):
            if (position is None) is (status == VISIBLE):
                return f"position {position}, status {status}"
            unit = turn is None or abs(math.hypot(*turn) - 1.0) < 1e-6
            return _far([position] if position else []) or ("" if unit else f"orientation {turn}")
        case JointReading(positions=positions):
            return "" if positions else "no joint"
        case Reading(rows=rows, status=status):
            if bool(rows) is (status != VISIBLE):
                return f"{len(rows)} rows, status {status}"
            return (
                "" if key == "sensors.curvatures" else _far([row for row in rows if not math.isnan(row[0])])
            )
    return f"a record of type {type(record).__name__}"


def _far(points: Iterable[Sequence[float]]) -> str:
    far = [point for point in points if not math.hypot(*point) <= FARTHEST_MM * (1 + 1e-9)]
    return f"position {far[0]}" if far else ""


class SilentNode:
    """In place of a node: hands out records, and keeps what would be published."""

    status, obstacles = VISIBLE, dict[str, str]()

    def __init__(self) -> None:
        self.records: list[Received] = []
        self.published: list[object] = []

    def poll(self) -> list[Received]:
        """The records."""
        found, self.records = self.records, []
        return found

    def publish(self, record: object) -> None:
        """Keep a record."""
        self.published.append(record)


class Consumers:
    """Driver, tracker and sensors on one silent node each."""

    def __init__(self) -> None:
        self.nodes = SilentNode(), SilentNode(), SilentNode(), SilentNode()
        sites = SiteMap((30.0, 20.0, 10.0), (15.0, 30.0), MountingSettings())
        self.sensors = (
            RosSensor(self.nodes[2], WallClock(), 0.25, "sensors.shape", 0.1),
            RosFbg(self.nodes[3], WallClock(), 0.25, "sensors.curvatures", 0.02, sites),
        )
        self.tracker = RosTracker(self.nodes[0], WallClock(), 0.25)
        link = JointLink.__new__(JointLink)
        vars(link).update(
            _channels=("a", "b"),
            _stale=1e9,
            _topic="joints",
            _reading=None,
            _refused="",
            _lost="",
            _node=self.nodes[1],
        )
        self.motors = RosMotors(("a", "b"), lambda: link)
        for channel in ("a", "b"):
            self.motors.set_speed(channel, 1.0, 1.0)

    def take(self, record: Received) -> str:
        """Return why they must not do what they do with a record, or ""."""
        for node in self.nodes:
            node.records.append(record)
        for frame in self.tracker.read():
            if not math.isfinite(frame.time):
                return f"a frame at {frame.time} s"
        for sensor in self.sensors:
            if not all(math.isfinite(reading.time) for reading in sensor.read()):
                return "a reading without a time"
            _ = sensor.status
        _ = self.tracker.status
        try:
            states = self.motors.read()
        except DriverError as error:
            return "" if len(str(error).splitlines()) == 1 else f"message {str(error)!r}"
        finally:
            self.motors.stop()
        sent = self.nodes[1].published
        finite = all(map(math.isfinite, (state.position for state in states.values())))
        return f"sent {sent[0]}" if sent else "" if finite else f"states {states}"


def messages(random: Random) -> Iterator[str]:
    """Read one message after another, and hand its record to driver and tracker."""
    rng, consumers = np.random.default_rng(random.getrandbits(64)), Consumers()
    outcomes, slowest = Counter[str](), 0.0
    while True:
        everything = list(_subscriptions())  # stamps must grow: a new subscription takes any stamp first
        for _ in range(50):
            subscription, kind = everything[rng.integers(len(everything))], str(rng.choice(list(KINDS)))
            data = KINDS[kind](rng, subscription.key)
            begun = time.perf_counter()
            record = _take(consumers, subscription, data)
            took = time.perf_counter() - begun
            if took > SLOWEST_S:
                raise Failure(f"{subscription.topic}: {data.hex()} took {took:.1f} s")
            outcomes[f"{kind} {record}"] += 1
            slowest = max(slowest, took)
            yield f": {dict(outcomes)}, slowest {1e3 * slowest:.1f} ms"


def _subscriptions() -> Iterator[Subscription]:
    for name in PROFILES:
        profile = load_profile(name)
        for key in profile.read_topics:
            yield Subscription(profile, key)


def _take(consumers: Consumers, subscription: Subscription, data: bytes) -> str:
    """Return the type of the record of a message. Raises Failure."""
    try:
        record = subscription.read(data, time.monotonic(), sent=time.time())
        found = problem(subscription.key, data, record)
        if record is not None and not found:
            found = consumers.take(record)
    except Exception as error:
        raise Failure(f"{subscription.topic}: {data.hex()}: {error!r}") from error
    if found:
        raise Failure(f"{subscription.topic}: {data.hex()}: {found}")
    return type(record).__name__


def live(random: Random) -> Iterator[str]:
    """Send bytes over DDS to a node, which must not arm, and still forward a stop after each hundred."""
    from cyclonedds.core import DDSException

    from flexneedle.lab.ros.dds import CdrSample, TopicWriter, join_domain

    profile, rng = load_profile("neutral"), np.random.default_rng(random.getrandbits(64))
    domain = join_domain()
    with NodeClient(profile) as node:
        topics = profile.read_topics
        writers = {key: TopicWriter(domain, topic.topic, kind) for key, (topic, kind) in topics.items()}
        if not _within(20.0, lambda: all(writer.readers for writer in writers.values())):
            raise Failure("the node was not found")
        for count in itertools.count(1):
            key = str(rng.choice([key for key in topics if key != "stop"]))
            data = KINDS[str(rng.choice(list(KINDS)))](rng, key)
            if key == "arm" and data[HEADER_BYTES : HEADER_BYTES + 1] not in (b"", FALSE):
                continue  # true: Cyclone DDS hands on any other byte as 1
            with suppress(DDSException):  # less than a header, or no room
                writers[key]._writer.write(CdrSample(data))  # bytes that no message would give
            _requests(node)
            if count % 100 == 0 and not _within(20.0, lambda: _stops(writers["stop"], node)):
                raise Failure(f"no stop is forwarded: {node.status}")
            yield ""


def _requests(node: NodeClient) -> list[Received]:
    """Return what was received. Raises Failure for an arm, which was not sent."""
    requests = node.poll()
    if any(isinstance(one, LinkArm) for one in requests):
        raise Failure("armed")
    return requests


def _stops(writer: Any, node: NodeClient) -> bool:
    writer.write(ros.std_msgs__msg__Bool(True))
    return any(isinstance(one, LinkStop) for one in _requests(node))


def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + seconds
    while not (holds := condition()) and time.monotonic() < deadline:
        time.sleep(0.005)
    return holds


if __name__ == "__main__":
    sys.exit(main(__doc__, {"messages": messages, "live": live}))
