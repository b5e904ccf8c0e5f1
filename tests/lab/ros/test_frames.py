"""Coordinates of the insertion in the frame of a topic, and back."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import to_matrix, z_axis
from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.profile import FrameAxes, PlacedTopic, TopicProfile, load_profile
from flexneedle.record.messages import PointMessage, Quaternion, pose
from flexneedle.types import Pose

SMARTNEEDLE = load_profile("smartneedle")
AXES = [
    (f"{a}{x}", f"{b}{y}", f"{c}{z}")
    for x, y, z in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
    for a in ("", "-")
    for b in ("", "-")
    for c in ("", "-")
    if (a + b + c).count("-") % 2 == ((x + y + z) in ("xzy", "yxz", "zyx"))
]
COORDINATES = st.floats(-500.0, 500.0)
SLOPES = st.floats(-0.6, 0.6)
POSES = st.builds(Pose, COORDINATES, COORDINATES, COORDINATES, SLOPES, SLOPES)


def frame(axes, body=("x", "y", "z"), unit="m", origin=(0.0, 0.0, 0.0)):
    x, y, z = axes
    profile = TopicProfile(
        name="a profile",
        needle=dict(zip("xyz", body, strict=True)),
        frames={"f": FrameAxes(id="f", x=x, y=y, z=z, origin_mm=origin)},
    )
    return FrameMap.of(profile, PlacedTopic(topic="/t", frame="f", unit=unit))


def smartneedle(name):
    return FrameMap.of(SMARTNEEDLE, PlacedTopic(topic="/t", frame=name, unit="mm"))


def xyz(point):
    return np.array([point.x, point.y, point.z])


def wxyz(turn):
    return np.array([turn.w, turn.x, turn.y, turn.z])


@given(
    POSES,
    st.sampled_from(AXES),
    st.sampled_from(AXES),
    st.sampled_from(["m", "mm"]),
    st.tuples(*[COORDINATES] * 3),
)
def test_a_pose_is_restored(at, axes, body, unit, origin):
    there = frame(axes, body, unit, origin)
    sent = there.map_pose(pose(0.0, at).pose)
    np.testing.assert_allclose(there.to_point(sent.position), at.point, atol=1e-9)
    np.testing.assert_allclose(z_axis(np.array(there.to_orientation(sent.orientation))), at.axis, atol=1e-12)


@given(POSES, st.sampled_from(AXES), st.sampled_from(AXES))
def test_the_needles_own_axis_points_along_it(at, axes, body):
    """In the topic's frame the pose's own axis along the needle is the tangent, turned into that frame."""
    there = frame(axes, body)
    turn = to_matrix(wxyz(there.map_pose(pose(0.0, at).pose).orientation))
    along = TopicProfile(name="p", needle=dict(zip("xyz", body, strict=True))).needle.rotation[:, 0]
    np.testing.assert_allclose(turn @ along, there.rotation @ np.array(at.axis), atol=1e-12)


def test_metres_along_x_are_unchanged_to_the_last_bit():
    at = pose(0.0, Pose(1.1, -2.2, 3.3, 0.1, 0.2)).pose
    assert frame(("x", "y", "z")).map_pose(at) == at


def test_the_origin_is_the_skin_entry():
    there = frame(("z", "y", "-x"), unit="mm", origin=(1.0, 2.0, 28.5))
    np.testing.assert_allclose(xyz(there.map_point(PointMessage(0.0, 0.0, 0.0))), (1.0, 2.0, 28.5))
    np.testing.assert_allclose(there.to_point(PointMessage(1.0, 2.0, 0.0)), (-28.5, 0.0, 0.0), atol=1e-12)


def test_impossible_positions_and_orientations_are_refused():
    for bad in (math.nan, math.inf, -math.inf, 1e300, 10.1):
        with pytest.raises(InputError, match="position"):
            frame(("x", "y", "z")).to_point(PointMessage(0.0, bad, 0.0))
    for turn in ((0, 0, 0, 0), (math.nan, 0, 0, 1), (0, 0, 0, 2), (1e308, 1e308, 0, 0)):
        with pytest.raises(InputError, match="not a unit quaternion"):
            frame(("x", "y", "z")).to_orientation(Quaternion(*map(float, turn)))


def test_the_frames_of_smartneedle():
    """A point 40 mm deep is at z of the needle and at y of the stage; variances have its unit squared."""
    needle, stage = smartneedle("needle"), smartneedle("stage")
    deep, straight = PointMessage(0.040, 0.003, -0.002), pose(0.0, Pose(10.0, 0.0, 0.0, 0.0, 0.0)).pose
    np.testing.assert_allclose(xyz(needle.map_point(deep)), (2.0, 3.0, 40.0))
    np.testing.assert_allclose(xyz(stage.map_point(deep)), (-2.0, 40.0, 3.0))
    np.testing.assert_allclose(wxyz(needle.map_pose(straight).orientation), (1, 0, 0, 0), atol=1e-15)
    turn = to_matrix(wxyz(stage.map_pose(straight).orientation))
    np.testing.assert_allclose(turn @ (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), atol=1e-15)  # z of the needle along y
    turned = needle.map_covariance(np.diag([1.0, 4.0, 9.0]) * 1e-6)
    np.testing.assert_allclose(turned, np.diag([9.0, 4.0, 1.0]))
