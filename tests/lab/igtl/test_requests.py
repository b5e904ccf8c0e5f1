"""Requests in received messages: what is read, what is refused, and in which frame points are."""

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.igtl.messages import (
    NamedPoint,
    PointMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.igtl.requests import PathRequest, StopRequest, read_request
from flexneedle.lab.igtl.settings import IgtlAddress
from flexneedle.lab.images.frames import ImageRegistration
from igtl_messages import EXAMPLES, MATRIX

NAME = "ImageToNeedle"


def points(*named):
    return PointMessage(name="F", points=tuple(NamedPoint(name=name, position=at) for name, at in named))


@pytest.mark.parametrize("text", ["STOP", "stop", " Stop\n"])
def test_a_stop_is_the_text_of_any_string(text):
    assert read_request(StringMessage(name="anything", text=text), NAME) == StopRequest()


def test_other_messages_are_no_requests():
    unused = [one for kind, one in EXAMPLES.items() if kind not in ("POINT", "TRAJ")]
    assert [read_request(one, NAME) for one in unused] == [None] * len(unused)
    assert read_request(StringMessage(name="Command", text="don't STOP"), NAME) is None


def test_points_are_found_by_the_beginnings_of_their_names():
    sent = points(("F-1", (9.0, 9.0, 9.0)), ("Entry-1", (0.0, 1.0, 2.0)), ("TARGET", (3.0, 4.0, 5.0)))
    assert read_request(sent, NAME) == PathRequest((0.0, 1.0, 2.0), (3.0, 4.0, 5.0))
    assert read_request(points(("target", (1.0, 2.0, 3.0))), NAME) == PathRequest(None, (1.0, 2.0, 3.0))


def test_the_first_trajectory_counts():
    ways = tuple(Trajectory(name=str(x), entry=(x, 0.0, 0.0), target=(x, 1.0, 0.0)) for x in (1.0, 2.0))
    found = read_request(TrajectoryMessage(name="T", trajectories=ways), NAME)
    assert found == PathRequest((1.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    assert read_request(TrajectoryMessage(name="T", trajectories=()), NAME) is None


def test_a_registration_maps_points_of_the_image_by_its_matrix():
    registration = read_request(TransformMessage(name=NAME, matrix=MATRIX), NAME)
    assert isinstance(registration, ImageRegistration)
    point = np.array([10.0, -20.0, 35.0])
    np.testing.assert_allclose(registration.apply(point), (np.array(MATRIX) @ [*point, 1.0])[:3], atol=1e-9)


@pytest.mark.parametrize("scale", [1.01, -1.0])
def test_a_registration_that_is_not_rigid_is_refused(scale):
    matrix = tuple(tuple(scale * value for value in row) for row in MATRIX[:3])
    with pytest.raises(InputError, match="must be a rotation"):
        read_request(TransformMessage(name=NAME, matrix=(*matrix, MATRIX[3])), NAME)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("18944", IgtlAddress()),
        ("0.0.0.0:1", IgtlAddress("0.0.0.0", 1)),
        ("connect:18945", IgtlAddress(port=18945, connects=True)),
        ("connect:slicer-pc:18944", IgtlAddress("slicer-pc", connects=True)),
        ("[::1]:18944", IgtlAddress("::1")),
    ],
)
def test_addresses(text, address):
    assert IgtlAddress.parse(text) == address
    assert IgtlAddress.parse(str(address)) == address


@pytest.mark.parametrize("text", ["", "phantom", "host:", "1:2:x", "65536", "connect:", "-1", "²"])
def test_other_addresses_are_refused(text):
    with pytest.raises(InputError, match="must be PORT or HOST:PORT"):
        IgtlAddress.parse(text)
