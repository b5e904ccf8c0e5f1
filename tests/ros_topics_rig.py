"""A rig of topics in a separate process: joints, and the tip of a needle that no tissue bends.

    python -m ros_topics_rig START_MM

START_MM: depth of the tip where the insertion joint is at 0. It ends when its stdin is closed.
"""

import re
import select
import sys
import time
from pathlib import Path

from flexneedle.lab.ros.dds import TopicWriter
from flexneedle.lab.ros.profile import load_profile
from ros_peers import Joints, tip

PERIOD_S = 0.025
PAGE = Path(__file__).parents[1] / "docs" / "rig" / "ros.md"


def rig_of_page():
    """The rig file of the page about ROS."""
    blocks = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (text,) = [block for block in blocks if "[driver]" in block]
    return text


def main():
    start, profile = 1e-3 * float(sys.argv[1]), load_profile("neutral")
    with Joints(profile, insertion_joint=0.0, roll_joint=0.0, guide_joint=0.0) as joints:
        writer = TopicWriter(joints.domain, profile.subscribe.tip.topic, "geometry_msgs/msg/PoseStamped")
        print("ready", flush=True)
        number = 0
        while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
            number += 1
            # No two positions are equal, as with any tracker: a position that repeats is frozen.
            at = start + joints.positions["insertion_joint"], 1e-6 * (number % 7), 0.0
            writer.write(tip(time.time(), at))


if __name__ == "__main__":
    main()
