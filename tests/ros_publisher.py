"""A ROS node in a process of its own, which publishes messages on topics until its stdin is closed.

    python -m ros_publisher TOPIC=MESSAGE[,QUALITY] ...

QUALITY: latched (sent once, also to later subscribers), best-effort; else it is sent fifty times a second.
"""

import select
import sys
import time

import rosbags.typesys.stores.ros2_humble as ros
from cyclonedds.core import Policy, Qos

from flexneedle.lab.ros.dds import Writer, participant
from ros_peers import Bool, tip

MESSAGES = {
    "true": lambda: Bool(True),
    "false": lambda: Bool(False),
    "text": lambda: ros.std_msgs__msg__String("stop"),
    "tip": lambda: tip(time.time()),
    "misplaced-tip": lambda: tip(time.time(), frame="map"),
}
QUALITIES = {
    "": {},
    "latched": {"latched": True},
    "best-effort": {"quality": Qos(Policy.Reliability.BestEffort)},
}


def main():
    domain, repeated = participant(), []
    kept = []  # a latched message is there as long as its writer
    for argument in sys.argv[1:]:
        topic, _, what = argument.partition("=")
        name, _, quality = what.partition(",")
        make = MESSAGES[name]
        writer = Writer(domain, topic, make().__msgtype__, **QUALITIES[quality])
        (kept if quality == "latched" else repeated).append((writer, make))
    for writer, make in kept:
        writer.write(make())
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.02)[0]:
        for writer, make in repeated:
            writer.write(make())


if __name__ == "__main__":
    main()
