"""Insertions that ROS nodes follow, arm, aim and stop: the command in one process, the other nodes in the test's."""

import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import flexneedle
from emulated import until
from emulated_rig import emulated_rig, rig_file
from flexneedle.errors import RigError, StoppedError
from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.rig.rig_file import RigFile, RosSettings
from flexneedle.lab.rig.supervised import SupervisedRig
from flexneedle.lab.ros import bridge
from flexneedle.lab.ros.bridge import profile_of
from flexneedle.lab.ros.profile import load_profile
from flexneedle.lab.ros.records import Arm, Refused, Stop, Target
from flexneedle.record.reader import read_trace
from flexneedle.record.topics import READINGS
from ros_peers import Bool, target
from ros_rig import QUICK, quick_scenario, started
from stages import RIG
from traces import contents

NEUTRAL = load_profile("neutral")
STREAMED = ("shape", "tip", "joint_states", "diagnostics")


def events(insertion):
    return [one["event"] for one in insertion.stored["timing"]["ros"]["events"]]


@pytest.mark.long
def test_a_stop_on_its_topic_stops_the_motors_at_once(tmp_path):
    with started(tmp_path, NEUTRAL, "--yes", ros={}) as insertion:
        peer = insertion.peer(("state", "tip"))
        insertion.until_state(peer, "inserting")
        until(lambda: len(peer.received("tip")) > 2)
        sent = time.monotonic()
        peer.send("stop", Bool(True))
        insertion.until_state(peer, "stopped")
        status, out, errors = insertion.end()
    assert (status, out) == (130, "")
    why = "stopped: ROS topic /flexneedle/stop"
    assert errors[-2] == f"flexneedle: interrupted: {why}; record: {insertion.out}"
    assert errors[-1].startswith(
        "flexneedle: the needle stays where it is: withdraw it by flexneedle rig retract "
    )
    assert (insertion.stored["status"], insertion.stored["reason"]) == ("interrupted", why)
    stopped = insertion.stored["timing"]["ticks"]["states"][-1]  # by the supervisor, not at the next period
    assert (stopped["state"], stopped["why"]) == ("stopped", "ROS topic /flexneedle/stop")
    _, at, where = insertion.calls("stop")[0]
    assert 0.0 < at - sent < 0.3
    assert [one for one in insertion.calls("follow") if one[1] > at] == []
    ((_, _, rest),) = insertion.calls("close")
    assert 1000.0 < where["A"] <= rest["A"] < where["A"] + 500.0  # 0.5 mm
    assert events(insertion) == ["stop: ROS topic /flexneedle/stop"]


@pytest.mark.slow
def test_the_needle_of_the_emulated_rig_rests_after_a_stop(tmp_path):
    path, record = rig_file(tmp_path), tmp_path / "truth.csv"
    with emulated_rig(path, quick_scenario(tmp_path), "--seed", 3, "--truth", record) as rig:
        served = path.read_text().replace("127.0.0.1:0", rig.ready["ready"]["galil"])
        path.write_text(f"{served}\n[ros]\n")
        with started(tmp_path, NEUTRAL, "--yes", "--rig", str(path)) as insertion:
            peer = insertion.peer(("tip",))
            until(lambda: len(peer.received("tip")) > 8, 60.0)
            sent = time.monotonic()
            peer.send("stop", Bool(True))
            status, _, errors = insertion.end()
        ended = time.monotonic()
        until(lambda: read_truth(record).time[-1] > ended + 1.0)
    assert (status, insertion.stored["reason"]) == (130, "stopped: ROS topic /flexneedle/stop"), errors
    stopped = insertion.stored["timing"]["ticks"]["states"][-1]
    assert stopped["state"] == "stopped"
    assert 0.0 < stopped["time_s"] - sent < 0.3
    truth = read_truth(record)
    base = truth.positions["insertion"]
    reached = np.interp([sent, stopped["time_s"]], truth.time, base)
    assert reached[0] > 2.0
    assert np.all(base[-1] - reached < (2.0, 0.5))  # 0.3 s at 5 mm/s, and 0.5 mm
    assert all(np.ptp(turns[truth.time > ended]) == 0.0 for turns in truth.counts.values())


@pytest.mark.long
def test_a_rig_is_armed_on_its_topic_and_stopped_when_it_is_disarmed(tmp_path):
    with started(tmp_path, NEUTRAL, ros={"arm": True}) as insertion:
        peer = insertion.peer(("state", "diagnostics", "plan"), ("arm",))
        waits = "idle: waits for arm"

        def waiting():
            return any(
                one.message == waits and any(value.key == "tracker" for value in one.values)
                for message in peer.received("diagnostics")
                for one in message.status
            )

        until(waiting, 60.0)  # by a report of the rig, whose devices are open
        assert peer.received("plan")  # before anybody can arm it
        assert insertion.calls("power", "follow") == []
        peer.send("arm", Bool(True))
        insertion.until_state(peer, "inserting")
        peer.send("arm", Bool(False))
        status, _, errors = insertion.end()
    assert status == 130
    assert "stopped: ROS topic /flexneedle/arm (disarmed)" in errors[-2]
    assert any("waits for an arm on /flexneedle/arm; nothing moves before" in line for line in errors)
    assert insertion.calls("power")[0][1] < insertion.calls("follow")[0][1]


@pytest.mark.long
@pytest.mark.parametrize(
    "how", ["stop", *(pytest.param(how, marks=pytest.mark.slow) for how in ("Ctrl-C", "loss of the node"))]
)
def test_what_ends_the_wait_for_an_arm_leaves_the_motors_off(tmp_path, how):
    with started(tmp_path, NEUTRAL, ros={"arm": True}) as insertion:
        peer = insertion.peer()
        insertion.until_state(peer, "idle")
        until(lambda: insertion.notes.exists(), 60.0)  # devices are open
        if how == "stop":
            peer.send("stop", Bool(True))
        elif how == "Ctrl-C":
            insertion.process.send_signal(signal.SIGINT)
        else:
            insertion.node().kill()
        status, _, errors = insertion.end()
    assert status == 130
    reason = {
        "stop": "stopped: ROS topic /flexneedle/stop",
        "Ctrl-C": "stopped by the user",
        "loss of the node": "stopped: the ROS node has ended",
    }[how]
    assert insertion.stored["status"] == "interrupted"
    assert insertion.stored["reason"] == reason, errors
    assert insertion.calls("power", "follow") == []


@pytest.mark.long
@pytest.mark.parametrize("arm", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_node_that_is_killed_stops_a_rig_that_it_has_armed_and_no_other(tmp_path, arm):
    with started(tmp_path, NEUTRAL, "--yes", ros={"arm": arm}) as insertion:
        peer = insertion.peer(("state", "tip"), ("arm", "stop"))
        if arm:
            until(lambda: insertion.notes.exists(), 60.0)
            until(lambda: peer.send("arm", Bool(True)) or "armed" in str(peer.received("state")), 60.0)
        insertion.until_state(peer, "inserting")
        until(lambda: len(peer.received("tip")) > 1)
        insertion.node().kill()
        status, _, errors = insertion.end()
    lost = "the ROS node has ended"
    if arm:
        assert (status, insertion.stored["reason"]) == (130, f"stopped: {lost}")
        assert events(insertion)[-1] == f"stop: {lost}"
    else:
        line = f"{lost}: nothing is published, and no stop is received from there"
        assert (status, insertion.stored["status"]) == (0, "done")
        assert events(insertion) == [line]
        assert f"flexneedle: {line}" in errors


@pytest.mark.long
def test_a_supervisor_that_is_killed_is_a_fault_on_the_topic_of_states(tmp_path):
    with started(tmp_path, NEUTRAL, "--yes", ros={}) as insertion:
        peer = insertion.peer(("state", "tip"))
        insertion.until_state(peer, "inserting")
        until(lambda: len(peer.received("tip")) > 1)
        insertion.supervisor().kill()
        insertion.until_state(peer, "fault")
        status, _, _errors = insertion.end()
        assert [one.data for one in peer.received("state")][-1] == "fault"
    assert status == 1
    assert "the supervisor has ended: it was killed" in insertion.stored["reason"]


@pytest.mark.slow
def test_a_dry_run_takes_its_target_from_ros_and_has_the_trace_of_a_simulated_run(tmp_path):
    one, other = tmp_path / "dry", tmp_path / "simulated"
    one.mkdir(), other.mkdir()
    with started(one, NEUTRAL, "--dry-run", ros={"target": True}) as insertion:
        peer = insertion.peer(("state", "markers", *STREAMED), ("target",))
        until(lambda: "waits for target" in str(peer.received("diagnostics")), 60.0)
        peer.send("target", target(time.time(), (0.005, 0.001, 0.0), frame="map"))  # refused
        peer.send("target", target(time.time() + 1.0, (0.005, 0.001, 0.0)))
        status, _, errors = insertion.end_followed_by(peer)
        shapes = peer.received("shape")
    assert status in (0, 1), errors
    aim = insertion.stored["scenario"]["target"]
    assert (aim["depth_mm"], aim["lateral_mm"]) == pytest.approx((5.0, 1.0))
    assert insertion.calls("power", "follow") == []
    assert [line.partition(": frame_id")[0] for line in events(insertion)] == [
        "waits for a target on /flexneedle/target",
        "message 1 refused on /flexneedle/target",
        "target 5, 1, 0 mm",
    ]
    made = read_trace(insertion.out / "trace.mcap").periods
    assert len(shapes) == len(made)
    for message, period in zip(shapes, made, strict=True):
        last = message.poses[-1].position
        np.testing.assert_allclose((last.x, last.y), 1e-3 * period.shape[-1, :2], atol=1e-9)
    stamps = [message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for message in shapes]
    np.testing.assert_allclose(np.diff(stamps), np.diff([one.time for one in made]), atol=1e-6)
    assert abs(stamps[-1] - time.time()) < 30.0

    with started(other, NEUTRAL, "--ros", "neutral") as simulated:
        peer = simulated.peer(("state", *STREAMED, "plan"))
        simulated.end_followed_by(peer)
    assert {one.data for one in peer.received("state")} >= {"inserting", "idle"}
    assert len(peer.received("shape")) > 3
    assert len(peer.received("plan")) == 1
    recorded, expected = contents(insertion.out), contents(simulated.out)
    assert recorded == expected | {READINGS: recorded[READINGS]}  # another tracker


@pytest.mark.long
def test_a_target_out_of_reach_is_refused_as_on_the_command_line(tmp_path):
    with started(tmp_path, NEUTRAL, "--dry-run", ros={"target": True}) as insertion:
        peer = insertion.peer(("diagnostics",), ("target",))
        until(lambda: "waits for target" in str(peer.received("diagnostics")), 60.0)
        peer.send("target", target(time.time(), (0.5, 0.0, 0.0)))
        status, _, errors = insertion.end()
    assert status == 2
    assert errors[-1].startswith("flexneedle: target.depth_mm = 500.0: beyond the stroke")
    assert not insertion.out.exists()


@pytest.mark.long
def test_a_stop_that_was_latched_before_the_start_ends_a_simulated_insertion(tmp_path):
    from flexneedle.lab.ros.dds import Writer
    from ros_peers import Peer

    peer = Peer(NEUTRAL)
    writer = Writer(peer.domain, NEUTRAL.subscribe.stop.topic, "std_msgs/msg/Bool", latched=True)
    writer.write(Bool(True))
    with started(tmp_path, NEUTRAL, "--ros", "neutral") as insertion:
        status, _, errors = insertion.end()
    assert status == 130
    assert "stopped: ROS topic /flexneedle/stop" in errors[-1]


# What is refused before anything is opened


@pytest.mark.parametrize("key", ["arm", "target"])
def test_a_profile_without_the_topic_is_refused(tmp_path, monkeypatch, key):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text('name = "Mine"\n[subscribe]\nstop = { topic = "/stop" }\n')
    with pytest.raises(RigError) as refused:
        profile_of(RosSettings(profile="mine.toml", **{key: True}))
    assert str(refused.value) == (
        f'ros.profile = "mine.toml": must list subscribe.{key}, since ros.{key} = true'
    )


def test_from_python_a_rig_with_a_section_that_nothing_follows_is_refused():
    scenario = flexneedle.load_scenario("phantom").with_values(QUICK)
    plan = flexneedle.plan(scenario)
    rig = RigFile.model_validate(RIG | {"ros": {"arm": True}})
    with pytest.raises(RigError, match="ros: nothing listens to the stop of this section"):
        flexneedle.insert(scenario, plan, rig=SupervisedRig(rig))


class Node:
    """Stands in for the node's process: brings requests, and then fails."""

    def __init__(self, requests, error=None):
        self.requests, self.error, self.published = [tuple(requests)], error, []

    def wait(self, seconds):
        time.sleep(min(seconds, 1e-3))

    def poll(self):
        if not self.requests and self.error is not None:
            raise self.error
        return self.requests.pop() if self.requests else ()

    def publish(self, record):
        self.published.append(record)

    def close(self):
        pass


def followed(monkeypatch, node):
    monkeypatch.setattr(bridge, "open_node", lambda *_args, **_options: node)
    return bridge.Bridge(RosSettings())


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("rig", [True, False])
def test_a_connection_that_fails_is_a_stop(monkeypatch, rig):
    """Nobody would hear one any more."""
    stops = []
    node = Node((), None if rig else ValueError("a bug"))
    with followed(monkeypatch, node) as bridge_:
        if rig:
            supervisor = SimpleNamespace(now=lambda: 0.0, request_stop=stops.append, ended=None)
            bridge_.confirm(supervisor)
            node.error = ValueError("a bug")
        until(lambda: bridge_.record["events"])
        why = "the connection to ROS has failed: ValueError: a bug"
        with pytest.raises(StoppedError, match=f"stopped: {why}"):
            bridge_.check()
        until(lambda: stops == [why] if rig else node.published)
    assert [one["event"] for one in bridge_.record["events"]] == [f"stop: {why}"]


def test_a_stop_is_listed_however_much_was_refused_before(monkeypatch):
    refused = [Refused(0.0, "/sensor/tip", "old data", count) for count in range(1, 1501)]
    ignored = [Arm(0.0, "/flexneedle/arm"), Target(0.0, (35.0, 2.0, 0.0))] * 100
    with followed(monkeypatch, Node([*ignored, *refused, Stop(0.0, "/flexneedle/stop")])) as bridge_:
        until(lambda: bridge_._stopped)
    listed = [one["event"] for one in bridge_.record["events"]]
    assert len(listed) == 1001
    assert listed[:2] == [
        "arm on /flexneedle/arm: ignored, not awaited",
        "target 35, 2, 0 mm: ignored, not awaited",
    ]
    assert listed[-2:] == [
        "message 800 refused on /sensor/tip: old data; more of what is refused or ignored is not listed",
        "stop: ROS topic /flexneedle/stop",
    ]


def test_options_that_contradict_each_other_are_refused(tmp_path, capsys):
    import tomli_w

    from commands import run

    rig = tmp_path / "rig.toml"
    rig.write_text(tomli_w.dumps(RIG | {"ros": {"target": True}}))
    given = ("insert", "phantom", "--rig", str(rig), "--dry-run")
    status, _, error = run(capsys, *given, "--ros", "neutral")
    assert (status, error) == (
        2,
        "flexneedle: --ros: not with --rig, whose file has a section [ros] for it\n",
    )
    status, _, error = run(capsys, *given, "--target", "35", "0")
    assert status == 2
    assert "--target: not with target = true in [ros]" in error
    status, _, error = run(capsys, "insert", "phantom", "--ros", "nonesuch")
    assert status == 2
    assert "nonesuch" in error
    assert len(error.splitlines()) == 1
