"""The tracker `igtl`: transforms of a Plus server become frames, once, with their times, and stale ones never."""

import socket
import time
from itertools import count

import numpy as np
import pytest

from emulated import read_until, until
from flexneedle.errors import RigError, RunError
from flexneedle.geometry.quaternion import z_axis
from flexneedle.geometry.rigid import identity
from flexneedle.lab.igtl.messages import PositionMessage, TransformMessage
from flexneedle.lab.igtl.tracker import IgtlTrackerSettings, TransformReader, make_tracker
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.types import VISIBLE
from igtl_peers import DEVICE, PlusServer, pose, transform
from rooms import ManualClock

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to y, y to −x


def reader(**values):
    return TransformReader(IgtlTrackerSettings(device=DEVICE, **values))


def message(matrix, at=1000.0, name=DEVICE, **metadata):
    rows = tuple(map(tuple, matrix.tolist()))
    return TransformMessage(name=name, time=at, matrix=rows, metadata=metadata)


def reading(one):
    return one.readings["tip"]


def moving():
    """Messages of a sensor that advances by 1 mm along x, with x of the sensor along y of the tracker."""
    number = count()
    return lambda: [transform(pose(1.0 + next(number), 2.0, 3.0, TURN)), transform(pose(9.0), "Other")]


# Frames of messages


@pytest.mark.parametrize(
    ("axis", "direction"),
    [
        ("x", (0, 1, 0)),
        ("-x", (0, -1, 0)),
        ("y", (-1, 0, 0)),
        ("-y", (1, 0, 0)),
        ("z", (0, 0, 1)),
        ("-z", (0, 0, -1)),
    ],
)
def test_the_named_axis_is_the_needles(axis, direction):
    found = reading(reader(axis=axis).read(message(pose(1.0, 2.0, 3.0, TURN)), "a:1", 5.0, False))
    assert found.position == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(z_axis(np.array(found.orientation)), direction, atol=1e-12)


def test_without_an_axis_no_direction_is_measured():
    assert reading(reader().read(message(pose(1.0)), "a:1", 5.0, False)).orientation is None


def test_other_devices_and_types_are_no_frames():
    made = reader()
    other = PositionMessage(name=DEVICE, position=(1.0, 2.0, 3.0), orientation=(1.0, 0.0, 0.0, 0.0))
    assert made.read(message(pose(1.0), name="Other"), "a:1", 5.0, False) is None
    assert made.read(other, "a:1", 5.0, False) is None
    assert made.number == 0


def test_a_delayed_message_keeps_its_earlier_time_and_an_old_one_is_refused():
    made = reader()
    times = [
        made.read(message(pose(1.0), at), "a:1", arrival, arrival > 5.0).time
        for at, arrival in [(1000.0, 5.0), (1000.1, 5.1), (1000.2, 5.7)]
    ]
    np.testing.assert_allclose(times, [5.0, 5.1, 5.2])
    assert made.read(message(pose(1.0), 1000.15), "a:1", 5.8, True) is None
    assert made.refused.startswith("old data: ")


def test_a_message_without_a_stamp_is_refused_unless_arrival_counts():
    made = reader()
    assert made.read(message(pose(1.0), 0.0), "a:1", 5.0, False) is None
    assert made.refused.startswith("no time stamp")
    assert reader(stamps=False).read(message(pose(1.0), 0.0), "a:1", 5.0, False).time == 5.0


def test_a_second_peer_is_refused_until_the_first_is_gone():
    made = reader()
    assert made.read(message(pose(1.0), 1000.0), "a:1", 5.0, False)
    assert made.read(message(pose(2.0), 3.0), "b:1", 5.1, True) is None
    assert made.refused == f"a:1 and b:1 send {DEVICE}: must be one"
    assert made.read(message(pose(2.0), 3.0), "b:1", 5.2, False).time == 5.2  # its clock is another one


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (message(pose(1.0), Status="MISSING"), "Status MISSING"),
        (
            message(pose(1.0), NeedleToTrackerTransformStatus="OUT_OF_VIEW"),
            "NeedleToTrackerTransformStatus OUT_OF_VIEW",
        ),
        (message(np.eye(4)), "missing (the transform is the identity)"),
        (message(pose(1.0, turn=2.0 * np.eye(3))), "transform: must be a rotation"),
        (message(pose(1.0, turn=-np.eye(3))), "transform: must be a rotation, but is mirrored"),
        (message(pose(2e4)), "its position is beyond 10 m"),
    ],
)
def test_a_message_without_a_measurement_is_a_frame_without_a_position(bad, reason):
    found = reading(reader().read(bad, "a:1", 5.0, False))
    assert found.position is None
    assert found.status.startswith(reason)


def test_metadata_of_a_good_measurement_are_no_obstacle():
    assert reading(reader().read(message(pose(1.0), Status="OK"), "a:1", 5.0, False)).status == VISIBLE


# Sockets


def test_frames_of_a_plus_server_reach_the_stage():
    with PlusServer(moving()) as plus:
        settings = {"device": DEVICE, "port": plus.port, "axis": "x"}
        with make_tracker(settings, WallClock()) as tracker:
            stage, found = OnStage(tracker, identity()), []
            until(lambda: found.extend(stage.read()) or len(found) >= 5)
            assert tracker.status == VISIBLE
    np.testing.assert_allclose([(one.y, one.z) for one in found], np.tile((2.0, 3.0), (len(found), 1)))
    np.testing.assert_allclose(np.diff([one.x for one in found]), 1.0)
    assert (np.diff([one.time for one in found]) > 0).all()
    np.testing.assert_allclose(
        [one.direction for one in found], np.tile((np.pi / 2, 0.0), (len(found), 1)), atol=1e-6
    )


def test_it_connects_again_and_reports_the_loss(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.igtl.endpoint._RETRY_S", 0.01)
    plus = PlusServer(moving())
    with make_tracker({"device": DEVICE, "port": plus.port, "late_ms": 100.0}, WallClock()) as tracker:
        read_until(tracker, bool)
        plus.close()
        until(lambda: tracker.status != VISIBLE)
        tracker.read()
        assert tracker.read() == ()
        with PlusServer(moving(), port=plus.port):
            frames, _ = read_until(tracker, lambda found: len(found) > 3)
    assert (np.diff([frame.number for frame in frames]) > 0).all()


def test_the_status_is_the_reason_why_nothing_is_accepted():
    with PlusServer(lambda: [transform(pose(1.0), stamp=5.0)]) as plus:
        settings = {"device": DEVICE, "port": plus.port, "late_ms": 50.0}
        with make_tracker(settings, WallClock()) as tracker:
            read_until(tracker, bool)
            until(lambda: tracker.status.startswith("old data: "))


def test_a_program_may_connect_to_it():
    with make_tracker({"device": DEVICE, "port": 0, "listen": True, "late_ms": 50.0}, WallClock()) as tracker:
        until(lambda: "not connected" in tracker.status)
        with socket.create_connection(("127.0.0.1", tracker.port)) as one:
            one.sendall(transform(pose(4.0)))
            (frame,), _ = read_until(tracker, bool)
    assert reading(frame).position == (4.0, 0.0, 0.0)


def test_times_are_on_the_clock_of_the_run():
    clock = ManualClock()
    clock.time = 12.0
    with make_tracker({"device": DEVICE, "port": 0, "listen": True}, clock) as tracker:
        opened = time.monotonic()
        with socket.create_connection(("127.0.0.1", tracker.port)) as one:
            one.sendall(transform(pose(4.0)))
            (frame,), _ = read_until(tracker, bool)
    assert 11.9 < frame.time <= 12.0 + time.monotonic() - opened + 1.0


def test_a_port_that_is_taken_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            RunError, match=f"^cannot listen on 127.0.0.1, port {port}: Address already in use$"
        ):
            make_tracker({"device": DEVICE, "port": port, "listen": True}, WallClock())


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({}, "device"),
        ({"device": "a" * 21}, "device"),
        ({"device": DEVICE, "axis": "w"}, 'axis = "w"'),
        ({"device": DEVICE, "port": 70000}, "port = 70000"),
        ({"device": DEVICE, "late_ms": -1.0}, "late_ms = -1.0"),
        ({"device": DEVICE, "rate": 1.0}, "rate = 1.0"),
    ],
)
def test_invalid_settings_are_one_line(settings, key):
    with pytest.raises(RigError) as caught:
        make_tracker(settings, WallClock())
    (line,) = caught.value.problems
    assert line.startswith(key)
