"""`rig check` joins the domain of `[ros]`, lists the publishers of the topics of the rig, and publishes nothing."""

import json
import os
import re
import time

import pytest
import rosbags.typesys.stores.ros2_humble as ros
import tomli_w
from cyclonedds.core import Policy, Qos

from bench_rig import rig, values
from commands import run
from emulated import until
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.ros import client
from flexneedle.lab.ros.dds import DomainDirectory, join_domain
from flexneedle.lab.ros.topic_check import check_ros
from ros_peers import Bool, publishing, tip

ROS, TOPICS = {"ros__profile": "neutral", "ros__arm": True}, {"tracker__kind": "ros"}
FOUND = re.compile(
    r"(\S+), (\S+): (\d+|no) publishers?, (\d+|no) messages? in (\S+) s(?:, the last (\S+) s old)?"
)
BEST_EFFORT = {"quality": Qos(Policy.Reliability.BestEffort)}
TIP = "/flexneedle/tracker/tip", lambda: tip(time.time()), {}
MISPLACED = TIP[0], lambda: tip(time.time(), frame="map"), {}


def flag(key, value=True, **how):
    return f"/flexneedle/{key}", lambda: Bool(value), how


def text(key):
    return f"/flexneedle/{key}", lambda: ros.std_msgs__msg__String("stop"), {}


def found_when(condition, checked):
    """The findings, by item, of the first check for which a condition holds: discovery may take a while."""
    found = {}

    def holds():
        found.clear()
        found.update((one.item, one) for one in check_ros(checked, WallClock(), 0.2))
        assert {one.part for one in found.values()} == {"ros"}
        return condition(found)

    until(holds)
    return found


def test_a_rig_without_ros_has_no_finding():
    assert check_ros(rig(), WallClock(), 0.1) == []


def test_without_publishers_each_topic_is_listed_without_a_problem(monkeypatch):
    domain = str(200 + os.getpid() % 30)  # with no other participant
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    found = {one.item: one for one in check_ros(rig(**ROS), WallClock(), 0.1)}
    assert found["connection"].found == f"neutral, domain {domain}"
    assert found["other participants"].found == "0"
    stop = ("/flexneedle/stop", "std_msgs/msg/Bool", "no", "no", "0.1", None)
    assert FOUND.fullmatch(found["stop"].found).groups() == stop
    assert found["tip"].found.endswith("; not used")
    sensors = "sensors.curvatures, sensors.shape, sensors.points, sensors.crossing"
    listed = f"connection, other participants, tip, shape, target, stop, arm, joint_states, {sensors}"
    assert ", ".join(found) == listed
    assert not any(one.problem for one in found.values())


def test_publishers_and_their_messages_are_counted():
    with publishing(flag("arm"), TIP, flag("stop", False)):
        found = found_when(
            lambda found: not any("no messages" in found[key].found for key in ("arm", "tip", "stop")),
            rig(**ROS | TOPICS),
        )
    for key, topic, kind in (
        ("arm", "/flexneedle/arm", "std_msgs/msg/Bool"),
        ("tip", "/flexneedle/tracker/tip", "geometry_msgs/msg/PoseStamped"),
        ("stop", "/flexneedle/stop", "std_msgs/msg/Bool"),
    ):
        *names, publishers, messages, seconds, age = FOUND.fullmatch(found[key].found).groups()
        assert (names, publishers, seconds) == ([topic, kind], "1", "0.2")
        assert 1 <= int(messages) <= 60
        assert 0.0 <= float(age) < 5.0
    assert int(found["other participants"].found) >= 1
    assert not any(one.problem for one in found.values())


def test_the_check_publishes_nothing():
    """So it can neither arm nor stop nor move what listens to topics."""
    domain = join_domain()
    directory, seen = DomainDirectory(domain), set()

    class Watching(WallClock):
        def wait(self, seconds):
            seen.update(topic for topic, _ in directory.publishers)
            super().wait(seconds)

    with publishing(flag("arm")):
        until(lambda: ("rt/flexneedle/arm", "std_msgs::msg::dds_::Bool_") in directory.publishers)
        check_ros(rig(**ROS), Watching(), 0.3)
    assert seen == {"rt/flexneedle/arm"}


@pytest.mark.parametrize(
    ("item", "topics", "words"),
    [
        ("stop", [text("stop")], "has the type std_msgs/msg/String"),  # its stops would never arrive
        ("arm", [flag("arm", **BEST_EFFORT)], "must be reliable"),
        ("stop", [flag("stop", **BEST_EFFORT)], "true: an insertion would be stopped"),
        ("stop", [flag("stop", latched=True)], "true: an insertion would be stopped"),
        ("arm", [flag("arm", False)], "disarmed: an insertion would be stopped"),
        ("tip", [MISPLACED], "frame_id 'map': must be 'skin'"),
        ("tip", [TIP, TIP], "2 publishers"),
        ("state", [text("state")], "another node publishes it"),
    ],
)
def test_a_wrong_topic_is_a_problem(item, topics, words):
    with publishing(*topics):
        found = found_when(lambda found: item in found and found[item].problem, rig(**ROS | TOPICS))
    assert [one.item for one in found.values() if one.problem] == [item]
    assert words in found[item].problem


def test_a_refused_tip_is_no_problem_of_a_rig_that_does_not_read_it():
    with publishing(MISPLACED):
        found = found_when(lambda found: "refused" in found["tip"].found, rig(**ROS))
    assert "; not used; " in found["tip"].found
    assert not any(one.problem for one in found.values())


def test_an_obstacle_to_listening_is_a_problem(monkeypatch, tmp_path):
    profile = tmp_path / "mine.toml"
    profile.write_text('name = "Mine"\n[subscribe]\nstop = { topic = "/stop" }\n')
    (found,) = check_ros(rig(ros__profile=str(profile), ros__arm=True), WallClock(), 0.1)
    assert "subscribe.arm" in found.problem
    with monkeypatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", "400")
        (found,) = check_ros(rig(**ROS), WallClock(), 0.1)
    assert "ROS_DOMAIN_ID = '400'" in found.problem
    monkeypatch.setattr(client, "find_spec", lambda _name: None)
    (found,) = check_ros(rig(**ROS), WallClock(), 0.1)
    assert "pip install 'flexneedle[ros]'" in found.problem


def test_the_command_prints_the_findings(capsys, tmp_path):
    path = tmp_path / "rig.toml"
    devices = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}
    path.write_text(tomli_w.dumps(values(devices) | {"ros": {"profile": "neutral"}}))
    _, out, _ = run(capsys, "rig", "check", str(path), "--seconds", "0.2", "--json")
    items = [one["item"] for one in json.loads(out)["findings"] if one["part"] == "ros"]
    assert items[:4] == ["connection", "other participants", "tip", "shape"]
