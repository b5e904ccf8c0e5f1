"""The sensor `igtl`: points and positions of a peer become readings, placed as targets are."""

import struct
import time
from itertools import count

import numpy as np
import pyigtl
import pytest

from emulated import until
from flexneedle.errors import RigError
from flexneedle.lab.igtl.messages import NamedPoint, PointMessage, PositionMessage, TransformMessage
from flexneedle.lab.igtl.placement import Placer
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.igtl.sensor import IgtlSensorSettings, PointsReader, make_sensor
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.testing import NeedleSensorConformance
from flexneedle.types import VISIBLE
from igtl_messages import MATRIX
from igtl_peers import PlusServer, pose, transform

DEVICE = "Segmentation"
POINTS = Points(kind="points", to_mm=60.0, rate_hz=20.0)
SLICE = Slice(kind="slice", plane_mm=20.0, delay_s=0.1)
IMAGE = ImageRegistration.of_matrix(MATRIX)
PLACES = ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
FAR = (2e4, 0.0, 0.0)


def reader(sensor=POINTS, registration=None, **values):
    return PointsReader(IgtlSensorSettings(device=DEVICE, **values), sensor, registration)


def points(*places, at=1000.0, name=DEVICE, **metadata):
    named = tuple(NamedPoint(name=str(n), position=place) for n, place in enumerate(places))
    return PointMessage(name=name, time=at, points=named, metadata=metadata)


def moved(matrix, name=DEVICE, **metadata):
    rows = tuple(map(tuple, np.asarray(matrix).tolist()))
    return TransformMessage(name=name, time=1000.0, matrix=rows, metadata=metadata)


def position(**metadata):
    turn = (1.0, 0.0, 0.0, 0.0)
    return PositionMessage(name=DEVICE, time=1000.0, position=PLACES[0], orientation=turn, metadata=metadata)


def reading(message, sensor=POINTS, registration=None):
    return reader(sensor, registration).read(message, "a:1", 5.0, False)


@pytest.mark.parametrize(
    ("message", "sensor", "rows"),
    [
        (points(*PLACES), POINTS, PLACES),
        (points(PLACES[0]), SLICE, PLACES[:1]),
        (moved(pose(*PLACES[0])), SLICE, PLACES[:1]),
        (position(), SLICE, PLACES[:1]),
        (position(Status="OK"), POINTS, PLACES[:1]),
    ],
)
def test_points_without_an_image_are_in_the_needles_frame(message, sensor, rows):
    found = reading(message, sensor)
    assert (found.time, found.rows, found.status) == (5.0 - sensor.delay_s, rows, VISIBLE)


def test_points_are_placed_where_a_target_would_be():
    image = {"rotation": list(IMAGE.rotation), "translation_mm": list(IMAGE.translation)}
    scenario = load_scenario("phantom").with_values({"setup.axes": 2, "image": image})
    placed = Placer().place(scenario, PeerGeometry("peer", target=PLACES[0])).values
    target = [placed[f"target.{key}_mm"] for key in ("depth", "lateral", "lateral_z")]
    np.testing.assert_allclose(reading(points(*PLACES), registration=IMAGE).rows[0], target)
    with make_sensor({"device": DEVICE, "port": 0, "listen": True}, WallClock(), POINTS, scenario) as sensor:
        np.testing.assert_allclose(sensor._reader.read(points(*PLACES), "a:1", 5.0, False).rows[0], target)


@pytest.mark.parametrize(
    ("message", "sensor", "reason"),
    [
        (points(), POINTS, "no points"),
        (points(FAR), POINTS, "point 20000, 0, 0: farther than 10 m"),
        (points(*PLACES), SLICE, "2 points: a slice has one"),
        (points(*PLACES, PointsStatus="MISSING"), POINTS, "PointsStatus MISSING"),
        (position(Status="OUT_OF_VIEW"), SLICE, "Status OUT_OF_VIEW"),
        (moved(np.eye(4)), SLICE, "missing (the transform is the identity)"),
        (moved(pose(1.0, turn=2.0 * np.eye(3))), SLICE, "transform: must be a rotation"),
    ],
)
def test_a_message_without_a_point_is_a_reading_without_rows(message, sensor, reason):
    found = reading(message, sensor)
    assert found.rows == ()
    assert found.status.startswith(reason)


def test_a_point_that_is_too_far_is_missing_among_others():
    np.testing.assert_array_equal(reading(points(PLACES[0], FAR)).rows, [PLACES[0], (np.nan,) * 3])


def test_other_devices_old_messages_and_second_peers_are_no_readings():
    made = reader()
    assert made.read(points(*PLACES, name="Other"), "a:1", 5.0, False) is None
    assert made.read(points(*PLACES), "a:1", 5.0, False)
    assert made.read(points(*PLACES, at=999.0), "a:1", 5.1, True) is None
    assert made.refused.startswith("old data: ")
    assert made.read(points(*PLACES, at=1001.0), "b:1", 5.2, True) is None
    assert made.refused == f"a:1 and b:1 send {DEVICE}: must be one"


def test_without_stamps_the_delay_of_the_scenario_counts():
    found = reader(SLICE, stamps=False).read(points(PLACES[0], at=0.0), "a:1", 5.0, False)
    assert found.time == pytest.approx(4.9)


@pytest.mark.parametrize(
    ("own", "sent", "reason"),
    [
        (IMAGE, pose(1.0), "registration of the image: differs from [image] of the scenario by up to"),
        (IMAGE, 2.0 * pose(1.0), "registration"),
        (None, np.array(MATRIX), "registration of the image: the scenario has no [image]"),
    ],
)
def test_after_another_registration_points_are_refused_until_the_scenarios_comes(own, sent, reason):
    made = reader(registration=own)
    assert made.read(moved(sent, "ImageToNeedle"), "a:1", 5.0, True) is None
    assert made.read(points(*PLACES), "a:1", 5.0, False) is None
    assert made.refused.startswith(reason)
    if own is not None:
        made.read(moved(MATRIX, "ImageToNeedle"), "a:1", 5.1, True)
        assert made.read(points(*PLACES, at=1001.0), "a:1", 5.2, True).status == VISIBLE


@pytest.mark.parametrize(
    ("sensor", "settings", "line"),
    [
        (POINTS, {}, "device: missing"),
        (POINTS, {"device": DEVICE, "axis": "x"}, 'axis = "x": unknown key'),
        (POINTS, {"device": DEVICE, "late_ms": -1.0}, "late_ms = -1.0"),
        (Fbg(kind="fbg", sites_mm=(10.0,)), {"device": DEVICE}, "fbg of the scenario"),
    ],
)
def test_invalid_settings_are_one_line(sensor, settings, line):
    with pytest.raises(RigError) as caught:
        make_sensor(settings, WallClock(), sensor)
    (found,) = caught.value.problems
    assert found.startswith(line)


# Sockets


def sent_points(*places):
    return pyigtl.PointMessage(list(places), device_name=DEVICE, timestamp=time.time()).pack()


class OfServer(NeedleSensorConformance):
    """A sensor of a server whose messages pyigtl packs."""

    seconds, least_hz = 0.4, 25.0

    def make(self, clock):
        messages, sensor = self.case
        self.server = PlusServer(messages)
        made = make_sensor({"device": DEVICE, "port": self.server.port}, clock, sensor)
        until(lambda: made.read())
        return made

    def disconnect(self, sensor):
        self.server.close()
        until(lambda: sensor.status != VISIBLE)

    def teardown_method(self):
        if not self.server._ended.is_set():
            self.server.close()


NUMBER = count(1)


class TestPoints(OfServer):
    """A POINT with two points along the needle."""

    def needle():
        return [sent_points((0.0, 0.0, 0.0), (30.0, 1e-3 * next(NUMBER), 0.0))]

    case = needle, POINTS


class TestTransform(OfServer):
    """A TRANSFORM with the crossing."""

    def crossing():
        return [transform(pose(20.0, 1e-3 * next(NUMBER)), DEVICE)]

    case = crossing, SLICE


def test_the_status_names_a_message_that_is_not_valid():
    """A point that is not a number is refused with its message, and what follows is read."""
    good = sent_points((1.0, 2.0, 3.0))
    bad = bytearray(sent_points((np.nan, 2.0, 3.0)))
    assert struct.pack(">f", np.nan) in bad
    messages = [[bytes(bad)]]
    with PlusServer(lambda: messages[0]) as server:
        settings = {"device": DEVICE, "port": server.port, "late_ms": 20.0}
        with make_sensor(settings, WallClock(), POINTS) as sensor:
            until(lambda: "skipped: numbers must be finite" in sensor.status)
            assert sensor.read() == ()
            messages[0] = [good]
            found = []
            until(lambda: found.extend(sensor.read()) or found)
    assert found[0].rows == ((1.0, 2.0, 3.0),)


def test_readings_that_nobody_reads_are_bounded():
    stamps = count(1)

    def messages():
        times = (1e3 + next(stamps) for _ in range(300))
        return [pyigtl.PointMessage([PLACES[0]], device_name=DEVICE, timestamp=at).pack() for at in times]

    with PlusServer(messages) as server:
        settings = {"device": DEVICE, "port": server.port}
        with make_sensor(settings, WallClock(), POINTS) as sensor:
            until(lambda: sensor._reader.number > 2000)
            assert len(sensor.read()) <= 1000
