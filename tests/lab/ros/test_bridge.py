"""Insertions that ROS nodes follow, arm, aim and stop: the command in a process, the other nodes in the test."""

import re
import time
from contextlib import ExitStack, suppress
from threading import Thread

import numpy as np
import pytest
import tomli_w

import flexneedle
from commands import run
from emulated import DEADLINE_S, until
from flexneedle.errors import RigError, StoppedError
from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkState, LinkStop, LinkTarget, NodeLoss
from flexneedle.lab.rig.rig_file import RigFile, RosSettings
from flexneedle.lab.rig.supervised import SupervisedRig
from flexneedle.lab.ros import bridge as module
from flexneedle.lab.ros.bridge import Bridge, load_checked_profile
from flexneedle.lab.ros.profile import load_profile
from flexneedle.loop.events import Ended, PeriodEnded, Planned, Stream
from flexneedle.planning.events import Iterated
from flexneedle.record.reader import read_trace
from flexneedle.record.topics import READINGS
from flexneedle.results import Period
from ros_peers import Bool, target
from ros_rig import started
from stages import RIG
from synthetic import make_periods, make_plan
from traces import contents

SCENARIO = flexneedle.load_scenario("phantom")
NEUTRAL = load_profile("neutral")
STREAMED = ("shape", "tip", "joint_states", "diagnostics")


def events(insertion):
    return [one["event"] for one in insertion.stored["timing"]["ros"]["events"]]


@pytest.mark.long
def test_a_stop_on_its_topic_stops_the_motors_at_once(tmp_path):
    with started(tmp_path, NEUTRAL, "--yes", ros={}) as insertion:
        peer = insertion.peer(("state", "tip"))
        insertion.until_state(peer, "inserting")
        until(lambda: any(where["A"] > 1000.0 for *_, where in insertion.calls("follow")))
        sent = time.monotonic()
        peer.send("stop", Bool(True))
        insertion.until_state(peer, "stopped")
        status, out, errors = insertion.end()
    assert (status, out) == (130, "")
    why = "stopped: ROS topic /flexneedle/stop"
    assert re.fullmatch(rf"flexneedle: interrupted .* mm .* periods: {why}; record: .*", errors[-2])
    assert errors[-1].startswith(
        "flexneedle: the needle stays in place: withdraw it with flexneedle rig retract "
    )
    assert (insertion.stored["status"], insertion.stored["reason"]) == ("interrupted", why)
    stopped = insertion.stored["timing"]["ticks"]["states"][-1]  # by the supervisor, not at the next period
    assert (stopped["state"], stopped["why"]) == ("stopped", "ROS topic /flexneedle/stop")
    _, at, where = insertion.calls("stop")[0]
    assert sent < at
    assert [one for one in insertion.calls("follow") if one[1] > at] == []
    ((_, _, rest),) = insertion.calls("close")
    # 0.5 mm; a stop may come before the first count.
    assert 1000.0 <= where["A"] <= rest["A"] < where["A"] + 500.0
    assert events(insertion) == ["stop: ROS topic /flexneedle/stop"]


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

        insertion.await_that(waiting)  # by a report of the rig, whose devices are open
        assert peer.received("plan")  # before anybody can arm it
        assert insertion.calls("power", "follow") == []
        peer.send("arm", Bool(True))
        insertion.until_state(peer, "inserting")
        peer.send("arm", Bool(False))
        status, _, errors = insertion.end()
    assert status == 130
    assert "stopped: ROS topic /flexneedle/arm (disarmed)" in errors[-2]
    assert any("an arm on /flexneedle/arm" in line for line in errors)
    assert insertion.calls("power")[0][1] < insertion.calls("follow")[0][1]


@pytest.mark.slow
def test_a_dry_run_takes_its_target_from_ros_and_has_the_trace_of_a_simulated_run(tmp_path):
    one, other = tmp_path / "dry", tmp_path / "simulated"
    one.mkdir(), other.mkdir()
    with started(one, NEUTRAL, "--dry-run", ros={"target": True}) as insertion:
        peer = insertion.peer(("state", "markers", *STREAMED), ("target",))
        insertion.await_that(lambda: "waits for target" in str(peer.received("diagnostics")))
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

    with started(other, NEUTRAL, "--ros", "neutral") as simulated:
        peer = simulated.peer(("state", *STREAMED, "plan"))
        simulated.end_followed_by(peer)
    assert {one.data for one in peer.received("state")} >= {"inserting", "idle"}
    assert len(peer.received("shape")) > 3
    assert len(peer.received("plan")) == 1
    recorded, expected = contents(insertion.out), contents(simulated.out)
    assert recorded == expected | {READINGS: recorded[READINGS]}  # another tracker


# Refusals before anything is opened


@pytest.mark.parametrize("key", ["arm", "target"])
def test_a_profile_without_the_topic_is_refused(tmp_path, key):
    path = tmp_path / "mine.toml"
    path.write_text('name = "Mine"\n[subscribe]\nstop = { topic = "/stop" }\n')
    with pytest.raises(RigError, match=rf"^ros\.profile = .*: must list subscribe\.{key}"):
        load_checked_profile(RosSettings(profile=str(path), **{key: True}))


def test_a_rig_with_topics_needs_a_bridge_among_the_listeners():
    rig = SupervisedRig(RigFile.model_validate(RIG | {"ros": {"arm": True}}))
    with pytest.raises(RigError, match=r"^ros: "), rig.open(SCENARIO, make_plan(), 0, Stream()):
        pass


@pytest.mark.parametrize(
    ("options", "key"),
    [
        (("--rig", "rig.toml", "--dry-run", "--ros", "neutral"), "--ros"),
        (("--rig", "rig.toml", "--dry-run", "--target", "35", "0"), "--target"),
        (("--ros", "nonesuch"), "nonesuch"),
    ],
)
def test_options_that_contradict_each_other_are_refused(tmp_path, monkeypatch, capsys, options, key):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(RIG | {"ros": {"target": True}}))
    status, _, error = run(capsys, "insert", "phantom", *options)
    (line,) = error.splitlines()
    assert (status, line.startswith(f"flexneedle: {key}: ")) == (2, True), line


# A bridge without its node's process


class Node:
    """A replacement for the node's process: it returns records, and then fails."""

    def __init__(self, records=(), error=None):
        self.records, self.error, self.published = [tuple(records)], error, []

    def wait(self, seconds):
        time.sleep(min(seconds, 1e-3))

    def poll(self):
        if not self.records and self.error is not None:
            raise self.error
        return self.records.pop() if self.records else ()

    def publish(self, record):
        self.published.append(record)

    def close(self):
        pass


class Rig:
    """A replacement for the client of a supervisor."""

    ended = None

    def __init__(self):
        self.stops = []

    def now(self):
        return 0.0

    def request_stop(self, why):
        self.stops.append(why)

    def wait(self, seconds):
        time.sleep(seconds)


@pytest.fixture
def bridge(monkeypatch):
    """Make a bridge on a node without a process."""
    with ExitStack() as stack:

        def make(node, **settings):
            monkeypatch.setattr(module, "open_node", lambda *_args, **_options: node)
            return stack.enter_context(Bridge(RosSettings(**settings)))

        yield make


def listed(bridge):
    return [one["event"] for one in bridge.record["events"]]


def test_events_are_published_and_a_stop_ends_the_insertion_at_the_next(bridge):
    node, plan = Node(), make_plan()
    made = bridge(node)
    period = next(iter(make_periods(plan)))
    made(Planned(plan))
    made(PeriodEnded(period))
    (sent,) = [one for one in node.published if isinstance(one, Period)]
    assert sent.time > period.time - 60.0  # on the clock of the node
    assert [one.state for one in node.published if isinstance(one, LinkState)][-1] == "inserting"
    node.records.append((LinkStop(0.0, "/stop", "why"),))
    until(lambda: listed(made))
    for event in (Iterated("feedforward", {}), Planned(plan), PeriodEnded(period)):
        with pytest.raises(StoppedError, match=r"^stopped: ROS topic /stop \(why\)$"):
            made(event)
    made(Ended(None))  # the record is complete


def test_an_arm_counts_while_it_is_awaited_only(bridge):
    node, rig = Node([LinkArm(0.0, "/arm")]), Rig()
    made = bridge(node, arm=True)
    until(lambda: listed(made))
    thread = Thread(target=made.confirm, args=(rig,))
    thread.start()
    until(lambda: len(listed(made)) == 2)
    assert thread.is_alive()
    node.records.append((LinkArm(1.0, "/arm"),))
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    ignored, waits, arm = listed(made)
    assert "ignored" in ignored
    assert "/flexneedle/arm" in waits
    assert arm == "arm on /arm"


@pytest.mark.parametrize("arm", [True, False])
def test_a_stop_before_the_question_stops_the_rig(bridge, arm):
    """It arrives while the insertion is planned, before there is a supervisor."""
    rig, made = Rig(), bridge(Node([LinkStop(0.0, "/stop", "")]), arm=arm)
    until(lambda: listed(made))
    with suppress(StoppedError):
        made.confirm(rig)
    assert rig.stops == ["ROS topic /stop"]  # before anything is armed
    with pytest.raises(StoppedError, match=r"^stopped: ROS topic /stop$"):
        made.check()


@pytest.mark.parametrize("arm", [True, False])
def test_a_lost_node_stops_a_rig_that_it_arms_and_no_other(bridge, arm):
    rig, made = Rig(), bridge(node := Node(), arm=arm)
    made.settings = RosSettings()  # the rig is armed
    made.confirm(rig)
    made.settings = RosSettings(arm=arm)
    node.records.append((NodeLoss(0.0, "gone"),))
    until(lambda: listed(made))
    assert rig.stops == (["gone"] if arm else [])
    assert listed(made)[0].startswith("stop: gone" if arm else "gone: nothing is published")


def test_a_supervisor_that_has_ended_is_a_fault_on_the_topic_of_states(bridge):
    rig, made = Rig(), bridge(node := Node())
    made.confirm(rig)
    rig.ended = "killed"
    until(lambda: any(isinstance(one, LinkState) and one.state == "fault" for one in node.published))
    last = [one for one in node.published if isinstance(one, LinkState)][-1]
    assert (last.good, last.reason) == (False, "the supervisor has ended: killed")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("with_rig", [True, False])
def test_a_connection_that_fails_is_a_stop(bridge, with_rig):
    """No later stop would be received."""
    node, rig = Node(error=None if with_rig else ValueError("a bug")), Rig()
    made = bridge(node)
    if with_rig:
        made.confirm(rig)
        node.error = ValueError("a bug")
    until(lambda: listed(made))
    with pytest.raises(StoppedError, match=r"ValueError: a bug$"):
        made.check()
    until(lambda: rig.stops if with_rig else node.published)
    (event,) = listed(made)
    assert event.endswith("ValueError: a bug")
    assert all(f"stop: {why}" == event for why in rig.stops)


def test_a_stop_is_listed_however_much_was_refused_before(bridge):
    refused = [LinkRefusal(0.0, "/sensor/tip", "old data", count) for count in range(1, 1501)]
    ignored = [LinkArm(0.0, "/flexneedle/arm"), LinkTarget(0.0, (35.0, 2.0, 0.0))] * 100
    made = bridge(Node([*ignored, *refused, LinkStop(0.0, "/flexneedle/stop")]))
    until(lambda: made._stopped)
    until(lambda: "stop: ROS topic /flexneedle/stop" in listed(made))
    found = listed(made)
    assert len(found) == 1001
    assert found[0].startswith("arm on /flexneedle/arm: ignored")
    assert found[1].startswith("target 35, 2, 0 mm: ignored")
    assert found[-2].startswith("message 800 refused on /sensor/tip: old data; ")
