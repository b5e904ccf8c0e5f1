"""Messages of the records of an insertion: the messages of the trace, and messages of SmartNeedle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

import flexneedle
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.lab.link.records import LinkState, LinkTarget
from flexneedle.lab.ros.composer import (
    UNKNOWN_TURN,
    MessageComposer,
    measure_length,
    resample,
    turn_about_axis,
)
from flexneedle.lab.ros.profile import PUBLISHED, load_profile
from flexneedle.lab.ros.records import JointTargets
from flexneedle.lab.ros.zones import make_clearance, make_zones
from flexneedle.record.messages import STORE, pose
from flexneedle.record.writer import TraceWriter
from flexneedle.simulator.zones import NO_ZONES, zones_of
from flexneedle.types import Measurement, Pose, SensorState, Shape
from synthetic import blind, make_periods, make_plan
from zoned import HALF_SPACE, SPHERE, with_zones

PLAN = replace(make_plan(), scenario=flexneedle.load_scenario("phantom"))
PERIODS = [
    replace(one, predicted=Shape(one.shape + 0.1, one.shape[:, 1:3] ** 2))
    for one in list(make_periods(PLAN))[40:44]
]
PERIOD = PERIODS[-1]
SAME = {  # key of `publish`: topic of the trace
    "shape": "/needle/shape",
    "predicted_shape": "/needle/predicted_shape",
    "tip": "/tip/estimate",
    "plan": "/plan/path",
    "joint_states": "/joint_states",
}


def circle(s, curvature=2e-3):
    """Poses (n, 5) of a needle bent to a circle, at arc lengths (n,)."""
    slope = curvature * s
    return np.column_stack([np.sin(slope) / curvature, (1 - np.cos(slope)) / curvature, 0 * s, slope, 0 * s])


BENT = replace(PERIOD, shape=circle(np.linspace(0.0, 150.0, 61)))


def composed(*records, profile="neutral", epoch=0.0):
    """Messages by key, the last of each, decoded from the bytes that are sent."""
    composer = MessageComposer(load_profile(profile), epoch)
    found = [one for record in records for one in composer.compose(record)]
    return {
        one.key: STORE.deserialize_cdr(
            STORE.serialize_cdr(one.message, PUBLISHED[one.key]), PUBLISHED[one.key]
        )
        for one in found
    }


def xyz(at):
    return np.array([at.x, at.y, at.z])


def matrix_of(turn):
    return to_matrix(np.array([turn.w, turn.x, turn.y, turn.z]))


def positions(message):
    return np.array([xyz(one.position) for one in message.poses])


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """Messages of `trace.mcap` by topic, of the plan and of the last period."""
    path = tmp_path_factory.mktemp("trace") / "trace.mcap"
    with TraceWriter(path, PLAN, about={}, scenario={}) as writer:
        for period in PERIODS:
            writer.add(period)
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        return {c.topic: STORE.deserialize_cdr(m.data, s.name) for s, c, m in found}


@pytest.mark.parametrize(("key", "topic"), SAME.items())
def test_topics_agree_with_the_trace(traced, key, topic):
    sent, kept = composed(PLAN, *PERIODS)[key], traced[topic]
    assert sent.header.stamp == kept.header.stamp
    match key:
        case "shape" | "predicted_shape":
            assert sent.poses == [stamped.pose for stamped in kept.poses]
            assert sent.header == kept.header
        case "joint_states":
            assert sent.name == kept.name
            np.testing.assert_array_equal(sent.position, kept.position)
        case _:
            assert sent == kept


def test_diagnostics_have_the_scalars_readings_and_durations_of_the_trace(traced):
    sent = composed(PERIOD)["diagnostics"]
    kept = [s for topic in ("/control/status", "/tracker/readings", "/timing") for s in traced[topic].status]
    assert [(s.name, s.level, s.message, s.values) for s in sent.status] == [
        (f"flexneedle: {s.name}", s.level, s.message, s.values) for s in kept
    ]


def test_shapes_of_smartneedle_are_half_a_millimetre_apart_and_end_at_the_tip():
    """The z of each pose is along the needle."""
    sent = composed(BENT, profile="smartneedle")["shape"]
    steps = np.linalg.norm(np.diff(positions(sent), axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.5, rtol=1e-5)
    x, y, z = BENT.shape[-1, :3]
    np.testing.assert_allclose(positions(sent)[-1], (-z, y, x))
    assert (len(sent.poses), sent.header.frame_id) == (300, "needle")
    axes = np.array([matrix_of(one.orientation)[:, 2] for one in sent.poses])
    chords = np.gradient(positions(sent), axis=0)
    np.testing.assert_allclose(axes, chords / np.linalg.norm(chords, axis=1)[:, None], atol=1e-3)
    at, moved = composed(PERIOD)["tip"].header.stamp, composed(PERIOD, epoch=1.7e9)["tip"].header.stamp
    assert (moved.sec - at.sec, moved.nanosec) == (1_700_000_000, at.nanosec)


@given(st.floats(0.1, 5.0), st.floats(1e-3, 8e-3))
def test_poses_are_on_the_needle_at_equal_distances_from_the_tip(spacing, curvature):
    """A circle: positions and slopes are known everywhere."""
    nodes = circle(np.linspace(0.0, 100.0, 41), curvature)
    found, length = resample(nodes, spacing), measure_length(nodes)
    expected = circle((length - spacing * np.arange(len(found))[::-1]) * 100.0 / length, curvature)
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert 0.0 <= length - spacing * (len(found) - 1) < spacing


def test_the_needle_pose_is_the_inserted_length_and_the_roll():
    straight = np.zeros((61, 5))
    straight[:, 0] = np.linspace(-110.0, 40.0, 61)
    period = replace(
        PERIOD, shape=straight, base=Pose(-110.0, 0.0, 0.0, 0.0, 0.0), roll=math.pi / 2, guide=(3.0, -1.0)
    )
    sent = composed(period, profile="smartneedle")
    np.testing.assert_allclose(xyz(sent["needle_pose"].pose.position), (0.0, 0.0, 40.0), atol=1e-12)
    turn = sent["needle_pose"].pose.orientation
    np.testing.assert_allclose((turn.w, turn.x, turn.y, turn.z), (0.5**0.5, 0, 0, 0.5**0.5), atol=1e-12)
    np.testing.assert_allclose(xyz(sent["guide_pose"].point), (-1.0, 40.0, 3.0), atol=1e-12)
    assert sent["guide_pose"].header.frame_id == "stage"


def test_a_roll_turns_about_the_needles_own_axis():
    at = pose(0.0, Pose(1.0, 2.0, 3.0, 0.3, -0.2)).pose
    before, after = matrix_of(at.orientation), matrix_of(turn_about_axis(at, 0.7).orientation)
    np.testing.assert_allclose(after[:, 0], before[:, 0])
    np.testing.assert_allclose(after[:, 1] @ before[:, 1], math.cos(0.7))
    np.testing.assert_allclose(after[:, 1] @ before[:, 2], math.sin(0.7))


def test_a_measured_tip_has_its_covariance():
    matrix = ((1e-2, 2e-3, 0.0), (2e-3, 4e-2, 0.0), (0.0, 0.0, 9e-2))
    slopes = ((1e-4, 5e-5), (5e-5, 4e-4))
    measured = Measurement(
        1.5, 1.0, 2.0, 3.0, direction=(0.1, 0.2), covariance=matrix, direction_covariance=slopes
    )
    period = replace(PERIOD, measurement=measured)
    sent = composed(period)["measured_tip"]
    found = sent.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(found[:3, :3], 1e-6 * np.array(matrix))
    turns = [[UNKNOWN_TURN, 0.0, 0.0], [0.0, 4e-4, -5e-5], [0.0, -5e-5, 1e-4]]  # ψ turns about −y, θ about z
    np.testing.assert_allclose(found[3:, 3:], turns)
    undirected = replace(PERIOD, measurement=replace(measured, direction=None, direction_covariance=None))
    found = composed(undirected)["measured_tip"].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(found[3:, 3:], UNKNOWN_TURN * np.eye(3))
    assert sent.pose.pose == pose(1.5, Pose(1.0, 2.0, 3.0, 0.1, 0.2)).pose
    assert sent.header.stamp.sec == 1


def test_an_estimated_tip_with_sensors_has_its_covariance():
    matrix = ((1e-2, 2e-3, 0.0), (2e-3, 4e-2, 0.0), (0.0, 0.0, 9e-2))
    period = replace(PERIOD, tip_covariance=matrix, sensors=(SensorState("fbg", nis=1.5),))
    sent = composed(period)
    found = sent["tip_covariance"].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(found[:3, :3], 1e-6 * np.array(matrix))
    assert sent["tip_covariance"].pose.pose == sent["tip"].pose
    assert [pair.value for one in sent["diagnostics"].status for pair in one.values if pair.key == "nis"] == [
        "1.5"
    ]
    assert "tip_covariance" not in composed(PERIOD)


def test_unknown_values_and_topics_that_a_profile_does_not_list_are_not_published():
    """A tip without a covariance or an accepted reading, and a shape that was not predicted."""
    listed = {"predicted_shape", "tip", "plan", "markers", "joint_states", "diagnostics"}
    assert set(composed(PLAN, PERIOD, profile="smartneedle-fbg")) == listed
    for period in (PERIOD, blind(PERIOD)):
        assert "measured_tip" not in composed(period)
    assert "predicted_shape" not in composed(replace(PERIOD, predicted=None))


def test_markers_are_the_layers_and_the_target():
    sent = composed(PLAN)["markers"].markers
    assert [(m.ns, m.text) for m in sent] == [
        ("tissue", "superficial"),
        ("tissue", "deep"),
        ("target", "target"),
    ]
    first, second, ball = sent
    assert first.pose.position.x + first.scale.x / 2 == pytest.approx(0.020)
    assert first.pose.position.x - first.scale.x / 2 == pytest.approx(0.0)
    assert second.pose.position.x - second.scale.x / 2 == pytest.approx(0.020)
    assert second.pose.position.x + second.scale.x / 2 > PLAN.target[0] * 1e-3
    np.testing.assert_allclose(xyz(ball.pose.position), 1e-3 * np.array(PLAN.target))
    assert ball.scale.x == pytest.approx(0.002)
    sent = composed(PLAN, LinkTarget(3.0, (35.0, -4.0, 1.0)))["markers"].markers
    assert [m.ns for m in sent] == ["tissue", "tissue", "target"], "a new target keeps the layers"
    np.testing.assert_allclose(xyz(sent[-1].pose.position), (0.035, -0.004, 0.001))
    assert [m.ns for m in composed(replace(PLAN, scenario=None))["markers"].markers] == ["target"]


ZONED = with_zones("phantom3d", SPHERE, HALF_SPACE)
STRAIGHT = replace(
    PERIOD, clearance=5.5, shape=np.pad(np.arange(-60.0, 40.5, 0.5)[:, None], ((0, 0), (0, 4)))
)


@pytest.mark.parametrize(("profile", "unit"), [("neutral", 1e-3), ("smartneedle", 1.0)])
def test_zones_and_their_margins_are_triangles_in_the_axes_of_the_topic(profile, unit):
    sent = composed(make_zones(ZONED), profile=profile)["zones"].markers
    assert [(m.ns, m.text, m.type) for m in sent] == [
        (ns, name, 11) for name in ("node", "bone") for ns in ("zones", "margins")
    ]
    assert len({m.id for m in sent}) == 4
    (first, *_), kept = sent, zones_of(ZONED).kept[0]
    assert (first.scale.x, first.scale.y, first.scale.z) == (1.0, 1.0, 1.0)
    center = np.array(SPHERE["center_mm"])
    for marker, radius in zip(sent, (3.0, 3.0 + kept), strict=False):
        points = np.array([xyz(point) for point in marker.points]) / unit
        assert len(points) % 3 == 0
        np.testing.assert_allclose(np.linalg.norm(points - center, axis=1), radius, atol=0.05)
        np.testing.assert_allclose(xyz(marker.pose.position), 0.0)
    expected = load_profile(profile).frames[load_profile(profile).publish.zones.frame].rotation
    np.testing.assert_allclose(matrix_of(first.pose.orientation), expected, atol=1e-12)


def test_the_clearance_is_a_line_to_the_nearest_zone_with_a_text():
    zones = zones_of(ZONED)
    sent = composed(make_clearance(zones, STRAIGHT))["clearance"].markers
    line, text = sent
    np.testing.assert_allclose(
        [xyz(point) for point in line.points], [[0.025, 0, 0], [0.025, 0.006, 0]], atol=1e-6
    )
    assert (line.type, text.type, text.text) == (5, 9, "5.50 mm to node")
    assert line.header.stamp == composed(STRAIGHT)["tip"].header.stamp
    before = replace(STRAIGHT, shape=STRAIGHT.shape - [100.0, 0.0, 0.0, 0.0, 0.0])
    assert make_clearance(zones, before) is None
    assert make_clearance(NO_ZONES, STRAIGHT) is None


def test_the_state_is_a_word_and_a_diagnostic_and_targets_of_joints_are_joint_states():
    goals = composed(JointTargets(1.0, {"insertion": 0.01, "roll": 3.0}))["joint_targets"]
    assert (goals.name, goals.position.tolist()) == (["insertion", "roll"], [0.01, 3.0])
    assert len(goals.velocity) == len(goals.effort) == 0
    sent = composed(LinkState(1.0, "fault", "motor A is off", good=False, values={"axis": "A"}))
    assert sent["state"].data == "fault"
    (status,) = sent["diagnostics"].status
    assert (status.level, status.name, status.message) == (1, "flexneedle: rig", "fault: motor A is off")
    assert [(pair.key, pair.value) for pair in status.values] == [("axis", "A")]
