"""The sensor `ros`: curvatures, shapes and points on topics become readings; no data are used twice."""

import math
import time
from itertools import count

import numpy as np
import pytest
import rosbags.typesys.stores.ros2_humble as ros
import tomli_w

from bench_rig import rig
from emulated import until
from flexneedle.errors import RigError
from flexneedle.lab.link.records import LinkRefusal
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.fbg.mounting import GratingSettings, SiteMap
from flexneedle.lab.rig.devices.sources import source_problems
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.ros.parsing import Subscription
from flexneedle.lab.ros.profile import POINT, POSE, SHAPE, TopicProfile, load_profile
from flexneedle.lab.ros.sensor import RosFbg, RosSensor, make_sensor
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.sensors.view import View
from flexneedle.testing import NeedleSensorConformance
from flexneedle.types import VISIBLE, Reading
from ros_peers import cdr, publishing, shape, target, tip

ROS, TRACKER = "flexneedle.lab.ros.sensor:make_sensor", "flexneedle.lab.ros.tracker:make_tracker"
NEUTRAL, FIBRE = map(load_profile, ("neutral", "smartneedle-fbg"))
FBG = Fbg(kind="fbg", sites_mm=(10.0, 15.0, 40.0), rate_hz=50.0)
POINTS = Points(kind="points", to_mm=60.0, rate_hz=20.0)
SLICE = Slice(kind="slice", plane_mm=20.0)
VIEW = View(
    kind="view", to_mm=50.0, projection=[(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 9.0)]
)
POSITIONS = {"positions_mm": [40.0, 20.0, 10.0]}
NAN = math.nan


def curvatures(values, *sizes, offset=0):
    """A message with these numbers; sizes: of the dimensions of its layout."""
    dimensions = [ros.std_msgs__msg__MultiArrayDimension("x", size, 8) for size in sizes]
    layout = ros.std_msgs__msg__MultiArrayLayout(dimensions, offset)
    return ros.std_msgs__msg__Float64MultiArray(layout, np.array(values, dtype=float))


def subscription(key, profile=NEUTRAL, **changes):
    """A subscription to `sensors.KEY` of a profile, with changes of its topic."""
    topic = profile.sensors[key].model_copy(update=changes)
    return Subscription(profile.model_copy(update={"sensors": {key: topic}}), f"sensors.{key}")


def read(key, message, profile=NEUTRAL, **changes):
    return subscription(key, profile, **changes).read(cdr(message), 100.0, sent=7.0)


# Curvatures in messages

KAPPA = np.arange(1.0, 7.0).reshape(2, 3)  # two rows, three gratings


@pytest.mark.parametrize(
    ("array", "sizes", "order"),
    [
        (KAPPA, (), None),
        (KAPPA, (6,), None),
        (KAPPA, (3, 2), None),  # three rows of two, as ROS states layouts
        (KAPPA, (16, 16), None),  # bytes of a column, in both dimensions: the SmartNeedle stack
        (KAPPA.T, (24, 24), None),  # the same of an array (3, 2)
        (KAPPA.T, (2, 3), None),
        (KAPPA.T, (), "components"),
        (KAPPA, (2, 3), "sites"),  # a layout that is wrong
    ],
)
def test_curvatures_are_a_fortran_array(array, sizes, order):
    found = read("curvatures", curvatures(array.ravel(order="F"), *sizes), order=order)
    assert found == Reading(100.0, ((1.0, 4.0), (2.0, 5.0), (3.0, 6.0)))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (curvatures([]), "0 numbers: "),
        (curvatures([1.0, 2.0, 3.0]), "3 numbers: "),
        (curvatures(np.zeros(20_002)), "20002 numbers: "),
        (curvatures(range(6), 7, 2), "layout (7, 2) of 6 numbers: set order"),
        (curvatures(range(4), 16, 16), "layout (16, 16) of 4 numbers: set order"),  # of (2, 2): either order
        (curvatures(range(6), 3, 2, 1), "layout (3, 2, 1) of 6 numbers: set order"),
        (curvatures(range(6), offset=2), "layout.data_offset"),
    ],
)
def test_other_arrays_are_refused(message, reason):
    found = read("curvatures", message)
    assert isinstance(found, LinkRefusal)
    assert found.reason.startswith(reason)


def test_curvatures_have_the_time_at_which_they_were_sent_and_old_ones_are_refused():
    one, data = subscription("curvatures"), cdr(curvatures(range(6)))
    times = [
        one.read(data, arrival, sent=sent).time for arrival, sent in ((5.0, 90.0), (5.1, 90.1), (5.7, 90.2))
    ]
    np.testing.assert_allclose(times, [5.0, 5.1, 5.2])
    assert one.read(data, 5.8, sent=90.15).reason.startswith("old data")
    assert one.read(data, 5.9, publishers=2, sent=90.4).reason.startswith("2 publishers")


# Points in messages


def test_points_are_placed_by_the_frame_of_their_topic():
    """In `needle`, in mm: x, y and z of the insertion are z, y and −x."""
    places = [(-1.0, 2.0, 30.0), (-2.0, 3.0, 40.0)]
    found = read("shape", shape(5.0, places, frame="needle"), FIBRE)
    np.testing.assert_allclose(found.rows, [(30.0, 2.0, 1.0), (40.0, 3.0, 2.0)], atol=1e-12)
    assert (found.time, found.status) == (100.0, VISIBLE)
    for message, kind in ((target(5.0, (0.02, 0.001, 0.0)), POINT), (tip(5.0, (0.02, 0.001, 0.0)), POSE)):
        np.testing.assert_allclose(read("crossing", message, type=kind).rows, [(20.0, 1.0, 0.0)])


def test_a_point_that_is_none_is_missing_and_without_any_the_reason_is_the_status():
    for bad, reason in ((NAN, "position (nan, 0, 0): not a number"), (20.0, "farther than 10 m")):
        found = read("points", shape(5.0, [(0.01, 0.0, 0.0), (bad, 0.0, 0.0)]))
        np.testing.assert_array_equal(found.rows, [(10.0, 0.0, 0.0), (NAN, NAN, NAN)])
        found = read("points", shape(5.0, [(bad, 0.0, 0.0)]))
        assert found.rows == ()
        assert reason in found.status
    unfilled = read("points", shape(5.0, [(0.0, 0.0, 0.0)], xyzw=(0.0, 0.0, 0.0, 0.0)))
    assert unfilled.status == "missing (position and orientation are 0)"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (shape(5.0, []), "0 poses"),
        (shape(5.0, [(0.0, 0.0, 0.0)], frame="map"), "frame_id 'map'"),
        (shape(0.0, [(0.0, 0.0, 0.0)]), "no time stamp"),
    ],
)
def test_other_shapes_are_refused(message, reason):
    assert read("points", message).reason.startswith(reason)


# Records to readings


class Node:
    """A node with records of the test."""

    status = VISIBLE

    def __init__(self, *records):
        self.records, self.obstacles = list(records), {}

    def poll(self):
        found, self.records = self.records, []
        return found


def fbg(*records, **mounting):
    sites = SiteMap(POSITIONS["positions_mm"], FBG.sites_mm, GratingSettings(**POSITIONS, **mounting))
    return RosFbg(Node(*records), WallClock(), 60.0, "sensors.curvatures", 0.02, sites)


def test_curvatures_at_gratings_become_those_at_sites():
    """From the gratings at 40, 20 and 10 mm to sites at 10, 15 and 40 mm, a quarter turn on and doubled."""
    now = time.monotonic()
    sensor = fbg(Reading(now, ((4e-3, 1e-3), (2e-3, 0.0), (1e-3, 0.0))), turn_deg=90.0, gain=2.0)
    (found,) = sensor.read()
    np.testing.assert_allclose(found.rows, [(0.0, 2e-3), (0.0, 3e-3), (-2e-3, 8e-3)], atol=1e-12)
    assert found.time == pytest.approx(now + sensor._offset - 0.02, abs=1e-9)
    assert sensor.read() == ()


@pytest.mark.parametrize(
    ("rows", "sites", "status"),
    [
        (((1e-3, 0.0),) * 2, None, "curvatures of 2 gratings, positions_mm has 3"),
        (((1.5, 0.0),) * 3, None, "no value is valid"),  # a radius below 1 mm
        (((NAN, 0.0),) * 3, None, "no value is valid"),
        (((1e-3, 0.0), (1e-3, 0.0), (0.0, math.inf)), [False, False, True], VISIBLE),
    ],
)
def test_a_grating_without_a_value_leaves_its_sites_without_one(rows, sites, status):
    (found,) = fbg(Reading(time.monotonic(), rows)).read()
    assert found.status == status
    if sites is None:
        assert found.rows == ()
    else:
        np.testing.assert_array_equal(np.isfinite(found.rows).all(axis=1), sites)


def test_the_status_is_the_reason_why_no_reading_arrives():
    node = Node(Reading(time.monotonic(), ((1.0, 2.0, 3.0),)))
    sensor = RosSensor(node, WallClock(), 0.0, "sensors.points", 0.0)
    assert [one.rows for one in sensor.read()] == [((1.0, 2.0, 3.0),)]
    assert sensor.status.startswith("no reading for ")
    node.obstacles = {"sensors.points": "a publisher has the type a/msg/B, which is not received"}
    assert sensor.status == node.obstacles["sensors.points"]
    node.records = [LinkRefusal(0.0, "/points", "old data")]
    assert sensor.read() == ()
    assert sensor.status == "/points: old data"
    node.status = "the ROS node has ended"
    assert sensor.status == "the ROS node has ended"


# Rig files


@pytest.mark.parametrize(
    ("sensor", "settings", "line"),
    [
        (FBG, {"topic": "curvatures"}, "positions_mm: missing"),
        (FBG, POSITIONS, 'profile = "neutral": must list sensors.fbg; it lists '),  # the default: its name
        (FBG, POSITIONS | {"topic": "points"}, 'topic = "points": '),
        (FBG, {"topic": "curvatures", "positions_mm": [20.0, 10.0]}, "sites_mm = 40.0: "),
        (SLICE, {"topic": "points"}, 'topic = "points": '),
        (POINTS, POSITIONS, "positions_mm = [40.0, 20.0, 10.0]: "),
        (POINTS, {"late_ms": 0.0}, "late_ms = 0.0"),
        (VIEW, {}, 'view of the scenario has kind = "view"'),
    ],
)
def test_invalid_settings_are_one_line(sensor, settings, line):
    with pytest.raises(RigError) as caught:
        make_sensor(settings, WallClock(), sensor)
    (found,) = caught.value.problems
    assert found.startswith(line)


def problems(*sensors, tracker=None):
    """Names of the sensors that are refused for the source of their data, each with its rule."""
    parts = [{"kind": ROS, "name": name, **settings} for name, settings in sensors]
    given = {} if tracker is None else {"tracker": {"kind": TRACKER, **tracker}}
    return [(one.value, one.rule) for one in source_problems(rig(sensor=parts, **given))]


def test_a_shape_is_not_used_together_with_its_curvatures():
    fibre = {"profile": "smartneedle-fbg"}
    rule = "{} also has data from /needle/state: use one of the two"
    both = ("curvatures", fibre | POSITIONS), ("shape", fibre)
    assert problems(*both) == [("shape", rule.format("sensor curvatures"))]
    assert problems(both[0], tracker=fibre | {"source": "shape"}) == [
        ("curvatures", rule.format("the tracker"))
    ]
    assert problems(both[0], tracker=fibre) == []
    tables = [{"kind": ROS, "name": name, **settings} for name, settings in both]
    given = fit_problems(rig(sensor=tables), load_scenario("phantom"))
    assert f'sensor[1].name = "shape": {rule.format("sensor curvatures")}' in given


def test_one_topic_is_not_used_twice_and_other_sources_are_fine(tmp_path):
    assert problems(("points", {}), ("crossing", {}), ("curvatures", {})) == []
    (found,) = problems(("crossing", {}), ("second", {"topic": "crossing"}))
    assert found[0] == "second"
    values = load_profile("neutral").model_dump(exclude_none=True)
    values["sensors"]["shape"]["source"] = "another fibre"
    (tmp_path / "own.toml").write_text(tomli_w.dumps(values))
    own = {"profile": str(tmp_path / "own.toml")}
    assert problems(("curvatures", own), ("shape", own)) == []
    values["sensors"]["crossing"]["source"] = "another fibre"
    (tmp_path / "own.toml").write_text(tomli_w.dumps(values))
    assert problems(("crossing", own), ("shape", own))[0][0] == "shape"


# Topics


def numbered(make):
    """Make messages, each of another number."""
    number = count(1)
    return lambda: make(next(number))


BENDS = numbered(lambda n: curvatures([1e-3, 1e-6 * n, 2e-3, 0.0, 3e-3, 0.0]))
NEEDLE = numbered(lambda n: shape(time.time(), [(0.0, 0.0, 0.0), (0.03, 1e-6 * n, 0.0)]))


class OnTopic(NeedleSensorConformance):
    """A sensor of a topic that another participant publishes at 50 Hz."""

    seconds, least_hz = 0.5, 30.0

    def make(self, clock):
        key, message, sensor, settings = self.case
        self.peer = publishing((NEUTRAL.sensors[key].topic, message, {}))
        self.peer.__enter__()
        self.publishes = True
        made = make_sensor({"topic": key, **settings}, clock, sensor)
        until(lambda: made.read())
        return made

    def disconnect(self, sensor):
        self.teardown_method()
        until(lambda: sensor.read() == () and sensor.status != VISIBLE)

    def teardown_method(self):
        if self.publishes:
            self.peer.__exit__(None, None, None)
        self.publishes = False


class TestCurvatures(OnTopic):
    """Gratings of a fibre."""

    case = "curvatures", BENDS, FBG, POSITIONS


class TestPoints(OnTopic):
    """Points along the needle."""

    case = "points", NEEDLE, POINTS, {}


def test_a_publisher_of_another_type_is_the_reason_why_nothing_arrives():
    topic = NEUTRAL.sensors["curvatures"].topic
    with publishing((topic, NEEDLE, {})):
        settings = {"topic": "curvatures", "late_ms": 1.0, **POSITIONS}
        with make_sensor(settings, WallClock(), FBG) as sensor:
            until(lambda: sensor.read() or "publisher" in sensor.status)
            assert sensor.status == f"a publisher has the type {SHAPE}, which is not received"


def test_a_profile_reads_the_listed_sensors_alone():
    reduced = FIBRE.select(sensors=("shape",))
    assert isinstance(reduced, TopicProfile)
    assert [key for key, _ in reduced.list_topics()] == ["sensors.shape"]
