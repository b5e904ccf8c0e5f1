"""ros2/flexneedle_ros agrees with the neutral profile, and its node runs with a stand-in of rclpy."""

import runpy
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from emulated import DEADLINE_S
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, load_profile

FOLDER = Path(__file__).parents[3] / "ros2" / "flexneedle_ros"
NEUTRAL = load_profile("neutral")
DISPLAYS = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Path": "nav_msgs/msg/Path",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "PoseArray": "geometry_msgs/msg/PoseArray",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


@pytest.fixture
def operator(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    sys.modules.pop("flexneedle_ros.operator", None)
    import flexneedle_ros.operator

    return flexneedle_ros.operator


@pytest.fixture
def stand_ins(monkeypatch):
    """Replacements for modules of ROS, by name."""

    def stand_in(*names):
        modules = {name: MagicMock(name=name) for name in names}
        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, name, module)
        return modules

    return stand_in


def parameters():
    text = (FOLDER / "config" / "operator.yaml").read_text()
    return YAML(typ="safe").load(text)["flexneedle_operator"]["ros__parameters"]


def test_without_ros_the_node_reports_what_it_needs():
    script = "import sys; from flexneedle_ros.operator import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", script], env={"PYTHONPATH": str(FOLDER)}, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr == (
        "flexneedle_ros needs ROS 2 (no module rclpy): source /opt/ros/DISTRIBUTION/setup.bash first\n"
    )


def test_topics_are_those_of_the_neutral_profile(operator):
    topics = {
        "stop_topic": NEUTRAL.subscribe.stop.topic,
        "arm_topic": NEUTRAL.subscribe.arm.topic,
        "state_topic": NEUTRAL.publish.state.topic,
    }
    assert {key: parameters()[key] for key in topics} == topics
    assert parameters() == operator.DEFAULTS


def test_rviz_shows_topics_of_the_neutral_profile_by_their_types():
    config = YAML(typ="safe").load((FOLDER / "config" / "flexneedle.rviz").read_text())[
        "Visualization Manager"
    ]
    assert config["Global Options"]["Fixed Frame"] == NEUTRAL.frames["skin"].id
    keys = {topic.topic: key.removeprefix("publish.") for key, topic in NEUTRAL.list_topics()}
    shown = [display for display in config["Displays"] if "Topic" in display]
    assert len(shown) == 8
    for display in shown:
        key = keys[display["Topic"]["Value"]]
        assert PUBLISHED[key] == DISPLAYS[display["Class"].rpartition("/")[2]]
        assert (display["Topic"]["Durability Policy"] == "Transient Local") is (key in LATCHED)


def test_installed_files_exist_and_the_launch_file_starts_them(stand_ins):
    setup = stand_ins("setuptools")["setuptools"].setup
    runpy.run_path(str(FOLDER / "setup.py"))
    given = setup.call_args.kwargs
    files = [FOLDER / file for _, files in given["data_files"] for file in files]
    assert [file for file in files if not file.is_file()] == []
    assert given["entry_points"]["console_scripts"] == ["operator = flexneedle_ros.operator:main"]

    modules = stand_ins(
        "ament_index_python", "ament_index_python.packages", "launch", "launch.actions", "launch.conditions",
        "launch.substitutions", "launch_ros", "launch_ros.actions",
    )  # fmt: skip
    modules["ament_index_python.packages"].get_package_share_directory.return_value = str(FOLDER)
    runpy.run_path(str(FOLDER / "launch" / "flexneedle.launch.py"))["generate_launch_description"]()
    operator, rviz = (call.kwargs for call in modules["launch_ros.actions"].Node.call_args_list)
    names = [operator[key] for key in ("package", "executable", "name")]
    assert names == ["flexneedle_ros", "operator", "flexneedle_operator"]
    assert Path(rviz["arguments"][1]).is_file()
    defaults = [
        c.kwargs["default_value"] for c in modules["launch.actions"].DeclareLaunchArgument.call_args_list
    ]
    assert Path(defaults[1]).is_file()


def test_the_manifest_names_the_imported_packages():
    manifest = ElementTree.parse(FOLDER / "package.xml").getroot()
    assert manifest.findtext("name") == "flexneedle_ros"
    assert manifest.findtext("export/build_type") == "ament_python"
    needed = {entry.text for entry in manifest.findall("exec_depend")}
    assert needed >= {"rclpy", "std_msgs", "std_srvs", "launch", "launch_ros", "rviz2"}


@pytest.mark.parametrize(
    ("service", "before", "reports", "done", "published"),
    [
        # Published, repeatedly for a stop, until the state is reported; its last report may be older than the call.
        ("stop", "inserting", ["", "inserting", "stopped"], True, 3),
        ("stop", "idle", ["", "idle", "stopped"], True, 3),
        ("stop", "stopped", ["", "stopped"], True, 2),
        ("stop", "idle", [], False, None),
        ("arm", "armed", ["armed"], True, 1),
        ("arm", "armed", [], False, 1),
        ("arm", "idle", [], False, 1),
        # An arm is done also if the rig inserts already: the topic keeps one state, so that "armed" may never come.
        ("arm", "idle", ["inserting"], True, 1),
        ("arm", "inserting", ["inserting"], False, 1),
        ("arm", "inserting", ["armed"], True, 1),
    ],
)
def test_a_call_is_done_when_the_rig_then_reports_its_effect(
    operator, service, before, reports, done, published
):
    states, left, sent = operator.States(), iter(reports), []
    states.report(before)

    def publish():
        sent.append(1)
        if state := next(left, ""):
            states.report(state)

    wanted, repeat = (operator.STOPPED, True) if service == "stop" else (operator.ARMED, False)
    seconds = DEADLINE_S if done else 0.2
    found, text = operator.carry_out(publish, states, wanted, seconds, repeat=repeat, missing="")
    assert (found, text) == (
        done,
        f"{'' if done else 'not done within 0.2 s: '}the rig reports {states.last!r}",
    )
    assert len(sent) == published or (published is None and sent)


def test_the_node_serves_stops_and_arms(operator, stand_ins):
    """Without a rig a call fails, and a stop is still sent."""
    modules = stand_ins(
        "rclpy", "rclpy.callback_groups", "rclpy.executors", "rclpy.qos", "std_msgs", "std_msgs.msg", "std_srvs",
        "std_srvs.srv",
    )  # fmt: skip
    modules["std_msgs.msg"].Bool = SimpleNamespace
    node, publishers = modules["rclpy"].create_node.return_value, defaultdict(MagicMock)
    node.declare_parameter.side_effect = lambda _name, default: SimpleNamespace(value=default)
    node.create_publisher.side_effect = lambda _kind, topic, _depth: publishers[topic]
    node.count_publishers.return_value = 1
    assert operator.main() == 0
    _, topic, report, _ = node.create_subscription.call_args.args
    services = {call.args[1]: call.args[2] for call in node.create_service.call_args_list}
    assert (topic, list(services)) == ("/flexneedle/state", ["~/stop", "~/arm"])
    for key, state in (("stop", "stopped"), ("arm", "armed")):
        publish = publishers[f"/flexneedle/{key}"].publish
        publish.side_effect = lambda _message, state=state: report(SimpleNamespace(data=state))
        answered = services[f"~/{key}"](None, SimpleNamespace())
        assert (answered.success, answered.message) == (True, f"the rig reports {state!r}")
        publish.assert_called_once_with(SimpleNamespace(data=True))
    node.count_publishers.return_value = 0
    for key, sent in (("stop", 2), ("arm", 1)):
        answered = services[f"~/{key}"](None, SimpleNamespace())
        assert (answered.success, answered.message) == (False, "no rig publishes /flexneedle/state")
        assert publishers[f"/flexneedle/{key}"].publish.call_count == sent
