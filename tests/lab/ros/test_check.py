"""`rig check` joins the domain of `[ros]`, lists who publishes what the rig reads, and publishes nothing."""

import json
import os
import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import tomli_w

from bench_rig import rig, values
from commands import run
from emulated import DEADLINE_S, until
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.ros import client
from flexneedle.lab.ros.check import check_ros
from flexneedle.lab.ros.dds import Directory, participant

TESTS = Path(__file__).parents[2]
ROS = {"ros__profile": "neutral", "ros__arm": True}
TOPICS = {"tracker__kind": "ros"}
FOUND = re.compile(
    r"(\S+), (\S+): (\d+|no) publishers?, (\d+|no) messages? in (\S+) s(?:, the last (\S+) s old)?"
)


@contextmanager
def publishing(*topics):
    """A node in another process that publishes: `/topic=MESSAGE[,QUALITY]`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ros_publisher", *topics],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=TESTS,
    )
    try:
        assert process.stdout.readline() == "ready\n"
        yield
    finally:
        process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0


def found_when(condition, checked):
    """The findings, by item, of the first check for which a condition holds: discovery may take a while."""
    found = {}

    def holds():
        found.clear()
        found.update((one.item, one) for one in check_ros(checked, WallClock(), 0.3))
        assert {one.part for one in found.values()} == {"ros"}
        return condition(found)

    until(holds)
    return found


def problem_when(item, *topics, **changes):
    """The problem of a topic, once there is one."""
    with publishing(*topics):
        found = found_when(lambda found: item in found and found[item].problem, rig(**ROS | changes))
    assert [one.item for one in found.values() if one.problem] == [item]
    return found[item].problem


@pytest.fixture
def alone(monkeypatch):
    """A domain in which nobody else is."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(200 + os.getpid() % 30))


def test_a_rig_without_ros_has_no_finding():
    assert check_ros(rig(), WallClock(), 0.1) == []


@pytest.mark.usefixtures("alone")
def test_where_nobody_publishes_each_topic_says_so():
    found = {one.item: one for one in check_ros(rig(**ROS), WallClock(), 0.1)}
    assert found["connection"].found == f"neutral, domain {os.environ['ROS_DOMAIN_ID']}"
    assert found["other participants"].found == "0"
    assert found["stop"].found == "/flexneedle/stop, std_msgs/msg/Bool: no publishers, no messages in 0.1 s"
    unused = "/flexneedle/tracker/tip, geometry_msgs/msg/PoseStamped: no publishers, no messages in 0.1 s; not used"
    assert found["tip"].found == unused
    assert set(found) == {
        *("connection", "other participants", "stop", "arm", "target", "tip", "shape", "joint_states")
    }
    assert not any(one.problem for one in found.values())


def test_publishers_and_their_messages_are_counted():
    with publishing("/flexneedle/arm=true", "/flexneedle/tracker/tip=tip", "/flexneedle/stop=false"):
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
        assert names == [topic, kind]
        assert (publishers, seconds) == ("1", "0.3")
        assert 1 <= int(messages) <= 60
        assert 0.0 <= float(age) < 5.0
    assert int(found["other participants"].found) >= 1
    assert not any(one.problem for one in found.values())


def test_the_check_publishes_nothing():
    """So it can neither arm nor stop nor move what listens to topics."""
    domain = participant()
    directory, seen = Directory(domain), set()

    class Watching(WallClock):
        def wait(self, seconds):
            seen.update(topic for topic, _ in directory.publishers)
            super().wait(seconds)

    with publishing("/flexneedle/arm=true"):
        until(lambda: ("rt/flexneedle/arm", "std_msgs::msg::dds_::Bool_") in directory.publishers)
        check_ros(rig(**ROS), Watching(), 0.3)
    assert seen == {"rt/flexneedle/arm"}


def test_a_publisher_of_another_type_is_a_problem():
    """Its stops would never arrive."""
    rule = "a publisher has the type std_msgs/msg/String, which is not received"
    assert problem_when("stop", "/flexneedle/stop=text") == rule


def test_a_publisher_with_another_quality_of_service_is_a_problem():
    rule = "a publisher is not received: its quality of service must be reliable"
    assert problem_when("arm", "/flexneedle/arm=true,best-effort") == rule


def test_a_stop_is_taken_from_any_publisher():
    assert problem_when("stop", "/flexneedle/stop=true,best-effort") == "true: an insertion would be stopped"


def test_a_stop_that_is_still_there_is_a_problem():
    assert problem_when("stop", "/flexneedle/stop=true,latched") == "true: an insertion would be stopped"


def test_a_disarm_is_a_problem():
    assert problem_when("arm", "/flexneedle/arm=false") == "disarmed: an insertion would be stopped"


def test_a_tip_in_another_frame_is_a_problem_of_a_rig_that_reads_it():
    topic = "/flexneedle/tracker/tip=misplaced-tip"
    rule = "a message is refused: frame_id 'map': must be 'skin'"
    assert problem_when("tip", topic, **TOPICS) == rule
    with publishing(topic):
        found = found_when(lambda found: rule in found["tip"].found, rig(**ROS))
    assert found["tip"].found.endswith(f"; not used; {rule}")
    assert not any(one.problem for one in found.values())


def test_two_trackers_on_one_topic_are_a_problem():
    tips = ("/flexneedle/tracker/tip=tip", "/flexneedle/tracker/tip=tip")
    assert problem_when("tip", *tips, **TOPICS).endswith("2 publishers: measurements must come from one")


def test_a_node_that_publishes_what_the_insertion_will_is_a_problem():
    rule = "another node publishes it, as the insertion will"
    assert problem_when("state", "/flexneedle/state=text") == rule


def test_a_domain_that_cannot_be_joined_is_a_problem(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "400")
    (found,) = check_ros(rig(**ROS), WallClock(), 0.1)
    assert found.problem == "ROS_DOMAIN_ID = '400': must be a whole number from 0 to 232"


def test_a_profile_without_the_topic_of_an_arm_is_a_problem(tmp_path):
    profile = tmp_path / "mine.toml"
    profile.write_text('name = "Mine"\n[subscribe]\nstop = { topic = "/stop" }\n')
    (found,) = check_ros(rig(ros__profile=str(profile), ros__arm=True), WallClock(), 0.1)
    assert found.problem.endswith("must list subscribe.arm, since ros.arm = true")


def test_without_cyclonedds_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(client, "find_spec", lambda _name: None)
    (found,) = check_ros(rig(**ROS), WallClock(), 0.1)
    assert "pip install 'flexneedle[ros]'" in found.problem


def test_the_command_prints_what_was_found(capsys, tmp_path):
    path = tmp_path / "rig.toml"
    devices = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}
    path.write_text(tomli_w.dumps(values(devices) | {"ros": {"profile": "neutral"}}))
    _, out, _ = run(capsys, "rig", "check", str(path), "--seconds", "0.2", "--json")
    items = [one["item"] for one in json.loads(out)["findings"] if one["part"] == "ros"]
    assert items[:4] == ["connection", "other participants", "tip", "shape"]
