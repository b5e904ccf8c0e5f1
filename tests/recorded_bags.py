"""Bags of ROS messages."""

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)


def message(kind, **fields):
    return STORE.types[kind](**fields)


def header(seconds, frame="tracker"):
    stamp = message("builtin_interfaces/msg/Time", sec=int(seconds), nanosec=0)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def point(values):
    return message("geometry_msgs/msg/Point", **dict(zip("xyz", values, strict=True)))


def turn(axis):
    """Return the quaternion that turns x into an axis by the shortest way."""
    quaternion = np.array([0.0, -axis[2], axis[1], 1.0 + axis[0]])
    values = quaternion / np.linalg.norm(quaternion)
    return message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", values, strict=True)))


def write_bag(folder, storage, topics):
    """Write messages (time in s, topic, message) as a bag."""
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        known = {}
        for seconds, topic, each in topics:
            kind = each.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(known[topic], int(1e9 * seconds), STORE.serialize_cdr(each, kind))
    return folder
