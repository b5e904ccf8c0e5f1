"""ros2/flexneedle_ros agrees with the neutral profile, and its node runs with a stand-in of rclpy."""

import runpy
import subprocess
import sys
from pathlib import Path
from threading import Thread
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from emulated import until
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
    assert len(shown) == 6
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


class Rclpy:
    """A replacement for rclpy: it keeps the parts of the node, and spins until the test ends it."""

    def __init__(self, monkeypatch):
        self.sent, self.services, self.publishers, self.spinning = [], {}, 1, True
        self.node = SimpleNamespace(
            declare_parameter=lambda _name, default: SimpleNamespace(value=default),
            create_subscription=lambda _kind, topic, call, _qos, **_: setattr(self, "state", (topic, call)),
            create_publisher=lambda _kind, topic, _depth: SimpleNamespace(
                publish=lambda message: self.sent.append((topic, message.data))
            ),
            create_service=lambda _kind, name, call, **_: self.services.update({name: call}),
            count_publishers=lambda _topic: self.publishers,
            destroy_node=lambda: None,
        )
        parts = {
            "rclpy": {
                "init": lambda **_: None,
                "create_node": lambda _name: self.node,
                "try_shutdown": lambda: None,
            },
            "rclpy.callback_groups": {"ReentrantCallbackGroup": object},
            "rclpy.executors": {
                "MultiThreadedExecutor": lambda: SimpleNamespace(
                    add_node=lambda _node: None, spin=lambda: until(lambda: not self.spinning)
                ),
                "ExternalShutdownException": type("ExternalShutdownException", (Exception,), {}),
            },
            "rclpy.qos": {"DurabilityPolicy": MagicMock(), "QoSProfile": lambda **given: given},
            "std_msgs": {},
            "std_msgs.msg": {"Bool": SimpleNamespace, "String": SimpleNamespace},
            "std_srvs": {},
            "std_srvs.srv": {"Trigger": SimpleNamespace},
        }
        for name, values in parts.items():
            module = ModuleType(name)
            vars(module).update(values)
            monkeypatch.setitem(sys.modules, name, module)

    def report(self, state):
        """Report a state of the rig."""
        self.state[1](SimpleNamespace(data=state))

    def call(self, name):
        """Call a service; return whether it succeeds, and its text."""
        answered = self.services[f"~/{name}"](None, SimpleNamespace())
        return answered.success, answered.message

    def call_while(self, name, meanwhile):
        """Call a service, and do something until it answers."""
        answers = []
        caller = Thread(target=lambda: answers.append(self.call(name)))
        caller.start()
        meanwhile(answers)
        caller.join()
        return answers[0]


@pytest.fixture
def running(request, operator, monkeypatch):
    answer_s = getattr(request, "param", 20.0)  # the default is for an idle machine
    monkeypatch.setitem(operator.DEFAULTS, "answer_s", answer_s)
    rclpy = Rclpy(monkeypatch)
    thread = Thread(target=operator.main)
    thread.start()
    until(lambda: "~/arm" in rclpy.services)
    yield rclpy
    rclpy.spinning = False
    thread.join()


@pytest.mark.parametrize("before", ["inserting", "idle"])
def test_a_stop_is_repeated_until_the_rig_reports_it(running, before):
    """Also of an idle rig: its last report may be older than the stop, and an arm may be on its way."""

    def stop(_answers):
        until(lambda: len(running.sent) >= 3)
        running.report(before)  # once a second
        running.report("stopped")

    assert running.state[0] == "/flexneedle/state"
    running.report(before)
    assert running.call_while("stop", stop) == (True, "the rig reports 'stopped'")
    assert set(running.sent) == {("/flexneedle/stop", True)}


@pytest.mark.parametrize(("name", "state", "sent"), [("stop", "stopped", 3), ("arm", "armed", 1)])
def test_a_state_from_before_the_call_is_not_an_answer(running, name, state, sent):
    """It may be the state of a rig that has ended, while another one begins."""

    def report_again(answers):
        until(lambda: len(running.sent) >= sent)
        assert answers == []
        running.report(state)

    running.report(state)
    assert running.call_while(name, report_again)[0]


@pytest.mark.parametrize("running", [0.2], indirect=True)
def test_without_a_report_of_an_idle_rig_a_call_fails_and_an_arm_is_sent_once(running):
    running.report("idle")
    failed = (False, "not done within 0.2 s: the rig reports 'idle'")
    assert running.call("arm") == failed
    assert running.sent == [("/flexneedle/arm", True)]
    assert running.call("stop") == failed
    assert ("/flexneedle/stop", True) in running.sent


@pytest.mark.parametrize(
    ("before", "after", "done"),
    [
        ("idle", ("armed", "inserting"), True),
        ("idle", ("inserting",), True),  # the topic keeps one state, so that "armed" may never come
        ("inserting", ("inserting",), False),
        ("inserting", ("armed", "inserting"), True),
    ],
)
def test_an_arm_is_done_also_if_the_rig_inserts_already(operator, before, after, done):
    states = operator.States()
    states.report(before)
    published = []

    def publish():
        published.append(1)
        for state in after:
            states.report(state)

    given = {"repeat": False, "missing": ""}
    assert operator.carry_out(publish, states, operator.ARMED, 0.2, **given)[0] is done
    assert len(published) == 1


def test_without_a_rig_a_service_fails_and_a_stop_is_still_sent(running):
    running.publishers = 0
    running.report("stopped")  # of a rig that has ended
    assert running.call("stop") == (False, "no rig publishes /flexneedle/state")
    assert running.sent == [("/flexneedle/stop", True)]
    assert not running.call("arm")[0]
    assert len(running.sent) == 1
