"""DDS types of ROS messages: names, hashes and encoding."""

import json
from pathlib import Path

from flexneedle.lab.ros.dds import get_type_hash, make_idl_type, make_user_data, to_dds_name, to_dds_topic
from flexneedle.lab.ros.profile import PUBLISHED, SUBSCRIBED

PUBLISHED_HASHES = json.loads((Path(__file__).parent / "type_hashes.json").read_text())
KINDS = sorted({*PUBLISHED.values(), *SUBSCRIBED.values()})


def test_hashes_are_the_published_ones():
    assert {kind: get_type_hash(kind) for kind in KINDS} == {kind: PUBLISHED_HASHES[kind] for kind in KINDS}


def test_names_are_those_of_ros():
    assert to_dds_name("geometry_msgs/msg/PoseStamped") == "geometry_msgs::msg::dds_::PoseStamped_"
    assert make_idl_type("geometry_msgs/msg/PoseStamped").__idl__.idl_transformed_typename == to_dds_name(
        "geometry_msgs/msg/PoseStamped"
    )
    assert to_dds_topic("/needle/shape") == "rt/needle/shape"
    assert (
        make_user_data("std_msgs/msg/Bool") == f"typehash={PUBLISHED_HASHES['std_msgs/msg/Bool']};".encode()
    )
