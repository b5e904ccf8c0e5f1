"""docs/rig/ros.md: its tables agree with the profiles and a node, and its rig file is valid."""

import re
import tomllib
from pathlib import Path

import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import Policy

from emulated import until
from flexneedle.lab.rig.rig_file import RigFile, check_settings
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.dds import join_domain
from flexneedle.lab.ros.motors import RosDriverSettings
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, SUBSCRIBED, SensorTopic, load_profile
from flexneedle.lab.ros.sensor import RosFbgSettings
from flexneedle.lab.ros.tracker import RosTrackerSettings
from ros_topics_rig import rig_of_page

PAGE = (Path(__file__).parents[3] / "docs" / "rig" / "ros.md").read_text(encoding="utf-8")


def row(key, topic, frames):
    section, _, name = key.partition(".")
    listed = {"publish": PUBLISHED, "subscribe": SUBSCRIBED}
    kind = topic.type if section == "sensors" else listed[section][name]
    verb = {"publish": "publishes", "subscribe": "reads", "sensors": "sensor"}[section]
    latched = ", latched" if section == "publish" and name in LATCHED else ""
    placed = f"{frames[topic.frame].id}|{topic.unit}" if getattr(topic, "frame", "") else "|"
    return f"|{verb} `{name}`{latched}|`{topic.topic}`|{kind}|{placed}|"


def test_the_table_has_each_topic_of_the_neutral_profile():
    profile = load_profile("neutral")
    expected = [row(key, topic, profile.frames) for key, topic in profile.list_topics()]
    table = re.search(r"<!-- table: neutral -->\n\n(.*?)\n\n", PAGE, re.DOTALL).group(1)
    assert table.splitlines()[2:] == expected


def test_the_page_names_each_topic_of_smartneedle():
    topics = [
        topic.topic.removeprefix("/flexneedle/") for _, topic in load_profile("smartneedle").list_topics()
    ]
    assert len(topics) == 17
    assert [topic for topic in topics if f"`{topic}`" not in PAGE and f"/{topic}`" not in PAGE] == []


def announced(domain, kind, counts):
    """Qualities of service of the endpoints of topics, as DDS announces them; counts: how many, by topic."""
    reader, found = BuiltinDataReader(domain, kind), {topic: {} for topic in counts}

    def complete():
        for one in reader.take(N=100):
            topic = (getattr(one, "topic_name", None) or "").removeprefix("rt")
            if topic in found:
                found[topic][one.key] = quality(one.qos)
        return all(len(found[topic]) >= count for topic, count in counts.items())

    until(complete)
    return {topic: sorted(qualities.values()) for topic, qualities in found.items()}


def quality(qos):
    """Reliability, durability and history in the words of the page."""
    reliable = isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable)
    latched = qos[Policy.Durability] == Policy.Durability.TransientLocal
    return (
        "reliable" if reliable else "best effort",
        "transient local" if latched else "volatile",
        f"last {qos[Policy.History].depth}",
    )


def table_of_qualities():
    """The table of the page: qualities by its first column; qualities of several readers are separated by `;`."""
    table = re.search(r"<!-- table: quality -->\n\n(.*?)\n\n", PAGE, re.DOTALL).group(1)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    columns = {name: [cell.split("; ") for cell in cells] for name, *cells in rows}
    return {
        name: sorted(zip(reliable, durable, history * len(reliable), strict=True))
        for name, (reliable, durable, history) in columns.items()
    }


def first_column(key):
    """The row of the table of qualities for a key such as `publish.tip`."""
    section, _, name = key.partition(".")
    if section == "publish":
        return "published, latched" if name in LATCHED else "published"
    rows = (
        "reads `stop`: three readers",
        "reads `target`, `arm`",
        "reads `tip`, `shape`, `joint_states`, sensors",
    )
    return next(row for row in rows if ("sensors" if section == "sensors" else f"`{name}`") in row)


def test_qualities_of_service_agree_with_the_node():
    profile, page, domain = load_profile("neutral"), table_of_qualities(), join_domain()
    kinds = {"publish": BuiltinTopicDcpsPublication} | dict.fromkeys(
        ("subscribe", "sensors"), BuiltinTopicDcpsSubscription
    )
    with NodeClient(profile):
        for section, kind in kinds.items():
            wanted = {
                topic.topic: page[first_column(key)]
                for key, topic in profile.list_topics()
                if key.startswith(section)
            }
            counts = {topic: len(qualities) for topic, qualities in wanted.items()}
            assert announced(domain, kind, counts) == wanted


def test_the_sensor_and_its_profile_are_valid():
    blocks = re.findall(r"```toml[^\n]*\n(\[.*?)```", PAGE, re.DOTALL)
    (sensor,) = next(tomllib.loads(block)["sensor"] for block in blocks if "[[sensor]]" in block)
    assert sensor.pop("kind") == "ros"
    sensor.pop("name")
    check_settings(RosFbgSettings, sensor)
    (topic,) = next(tomllib.loads(block)["sensors"].values() for block in blocks if "[sensors." in block)
    assert set(topic) == set(SensorTopic.model_fields) - {"order"}
    SensorTopic.model_validate(topic)


def test_the_rig_file_is_valid():
    rig = RigFile.model_validate(tomllib.loads(rig_of_page()))
    assert (rig.driver.kind, rig.tracker.kind) == ("ros", "ros")
    check_settings(RosDriverSettings, rig.driver.settings)
    check_settings(RosTrackerSettings, rig.tracker.settings)
    assert rig.axes.insertion.scale == 0.001
    assert rig.axes.rotation.scale == pytest.approx(1.0)
