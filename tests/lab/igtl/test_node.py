"""Decisions of the node: which registration and target it takes, when, and what it refuses."""

from types import SimpleNamespace

import pytest

from flexneedle.lab.igtl.messages import (
    NamedPoint,
    PointMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.igtl.node import IgtlNode
from flexneedle.lab.igtl.records import InsertionBegin, NodeSetup, PeerGeometry, TargetWait
from flexneedle.lab.igtl.settings import IgtlSettings
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.link.records import LinkRefusal, LinkStop
from igtl_messages import MATRIX
from synthetic import make_periods, make_plan

PEER = "127.0.0.1:5"
IMAGE = ImageRegistration.of_matrix(MATRIX)
SHIFTED = tuple((*row[:3], row[3] + (k < 3)) for k, row in enumerate(MATRIX))
PERIOD = next(iter(make_periods(make_plan())))


class Node:
    """A node whose channel and peers are lists."""

    def __init__(self, registration=None):
        self.sent, self.published = [], []
        channel = SimpleNamespace(send=lambda record, **_: self.sent.append(record))
        self.node = IgtlNode(NodeSetup(IgtlSettings(), 0.0, registration), channel)
        self.node.endpoint = SimpleNamespace(send=self.published.append)

    @property
    def registration(self):
        return self.node._composer.registration

    def take(self, *records):
        for record in records:
            self.node.take(record)

    def receive(self, *messages):
        """Receive messages of a peer; return the records that are sent upon them."""
        self.sent.clear()
        for message in messages:
            self.node._refused_at = -1.0
            self.node.receive(message, PEER)
        return list(self.sent)


def registered(matrix=MATRIX):
    return TransformMessage(name="ImageToNeedle", matrix=matrix)


def points(**named):
    return PointMessage(
        name="F", points=tuple(NamedPoint(name=name, position=at) for name, at in named.items())
    )


@pytest.fixture
def node():
    return Node()


def test_a_stop_is_forwarded_in_any_state(node):
    (stop,) = node.receive(StringMessage(name="Command", text="STOP"))
    assert isinstance(stop, LinkStop)
    assert stop.source == PEER


def test_a_registration_is_forwarded_once_and_geometry_is_in_the_image_of_the_insertion(node):
    assert node.receive(registered(), registered()) == [PeerGeometry(PEER, IMAGE)]
    assert node.registration is None
    node.take(InsertionBegin(IMAGE), make_plan(), PERIOD)
    (again,) = node.receive(registered(SHIFTED))
    assert again.registration != IMAGE
    assert node.registration == IMAGE
    node.take(InsertionBegin())
    assert node.registration is None


def test_points_are_forwarded_while_a_target_is_awaited_with_the_last_registration(node):
    node.receive(registered())
    (note,) = node.receive(points(Target=(0.0, 0.0, 5.0)))
    assert note.text == f"POINT 'F' of {PEER}: ignored, no target is awaited"
    node.take(TargetWait())
    entry = PeerGeometry(PEER, IMAGE, entry=(1.0, 1.5, 7.0))
    assert node.receive(points(entry=(1.0, 1.5, 7.0))) == [entry]
    sent = PeerGeometry(PEER, IMAGE, (1.0, -28.5, 7.0))
    assert node.receive(points(target=(1.0, -28.5, 7.0))) == [sent]
    node.take(InsertionBegin(IMAGE))
    node.receive(points(Target=(0.0, 0.0, 5.0)))
    assert node.receive(points(Target=(0.0, 0.0, 5.0))) == []
    node.take(TargetWait())
    assert node.receive(points(Target=(0.0, 0.0, 5.0))) == [PeerGeometry(PEER, IMAGE, (0.0, 0.0, 5.0))]


def test_a_trajectory_has_entry_and_target(node):
    node.take(TargetWait())
    way = Trajectory(name="Way", entry=(0.0, 1.0, 0.0), target=(30.0, 2.0, 0.0))
    (found,) = node.receive(TrajectoryMessage(name="T", trajectories=(way,)))
    assert (found.target, found.entry) == (way.target, way.entry)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (points(Lesion=(0.0, 0.0, 5.0)), "POINT 'F': no point is named Target or Entry"),
        (registered(tuple((2.0 * a, b, c, d) for a, b, c, d in MATRIX)), "TRANSFORM 'ImageToNeedle': "),
    ],
)
def test_what_cannot_be_is_refused_and_still_awaited(node, message, reason):
    node.take(TargetWait())
    (refusal,) = node.receive(message)
    assert isinstance(refusal, LinkRefusal)
    assert refusal.reason.startswith(reason)
    (found,) = node.receive(points(Target=(30.0, 0.0, 0.0)))
    assert found.target == (30.0, 0.0, 0.0)


def test_a_flood_is_reported_once_for_each_name_and_each_tenth_of_a_second(node):
    assert len(node.receive(*[StringMessage(name="a", text=str(k)) for k in range(100)])) == 1
    assert len(node.receive(*[StringMessage(name=str(k), text="") for k in range(100)])) == 63
    node.take(TargetWait())
    node.sent.clear()
    for _ in range(100):
        node.node.receive(points(Lesion=(0.0, 0.0, 0.0)), PEER)
    assert len(node.sent) <= 2
