"""Rules of `[[sensor]]`: one line each, for places and names, and for kinds of a user."""

import sys
from types import ModuleType

import numpy as np
import pytest

from flexneedle import Sensor, Y, load_scenario
from flexneedle.errors import DriverError, ScenarioError
from flexneedle.scenario.plausible import find_doubts
from flexneedle.scenario.sensors.sensor import predict_values, read_values
from flexneedle.types import Needles, Reading

PHANTOM = load_scenario("phantom")
SLICE = {"kind": "slice", "plane_mm": 30.0}
POINTS = {"kind": "points", "to_mm": 40.0}
VIEW = {"kind": "view", "to_mm": 40.0}
SIDE = [[8.0, 0.0, 0.0, 0.0], [0.0, 8.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 10.0]]  # the axis passes the camera
ALONG = [[0.0, 0.0, 0.0, 5.0], [0.0, 8.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]  # the axis is a point
FBG = {"kind": "fbg", "sites_mm": [11.0, 26.0]}
ALONE = {"tracker.enabled": False, "control.start_axial_sd_mm": 0.0}
REFUSED = [
    ({"tracker.enabled": False}, "tracker.enabled = false"),
    ({"sensor": [{"kind": "fbg", "sites_mm": [10.0, 149.0]}]}, "sensor[0].sites_mm = 149.0"),
    ({"sensor": [SLICE | {"plane_mm": 81.5}]}, "sensor[0].plane_mm = 81.5"),
    ({"sensor": [SLICE | {"normal": [0.1, 1.0, 0.0]}]}, "sensor[0].normal = [0.1, 1.0, 0.0]"),
    ({"sensor": [SLICE | {"plane_mm": -180.0}]}, "sensor[0].plane_mm = -180.0"),
    ({"sensor": [POINTS | {"from_mm": 90.0, "to_mm": 99.0}]}, "sensor[0].from_mm = 90.0"),
    ({"sensor": [POINTS | {"to_mm": -1.0}]}, "sensor[0].to_mm = -1.0"),
    ({"sensor": [POINTS | {"from_mm": -250.0, "to_mm": -180.0}]}, "sensor[0].to_mm = -180.0"),
    ({"sensor": [SLICE, SLICE]}, 'sensor[1].name = "slice"'),
    ({"sensor": [SLICE | {"name": "tracker"}]}, 'sensor[0].name = "tracker"'),
    ({"sensor": [SLICE | {"rate_hz": 1e5}]}, "sensor[0].rate_hz = 100000.0"),
    ({"sensor": [VIEW | {"projection": SIDE}]}, "sensor[0].projection = [-1.0, 0.0, 0.0, 10.0]"),
    ({"sensor": [VIEW | {"projection": ALONG}]}, "sensor[0].projection = [0.0, 0.0, 0.0, 5.0]"),
    ({"sensor": [{"kind": "ct"}]}, 'sensor[0].kind = "ct"'),
    ({"sensor": [{"sites_mm": [10.0]}]}, "sensor[0].kind"),
    ({"sensor": [{"kind": "fbg", "sites_mm": [20.0, 10.0]}]}, "sensor[0].sites_mm = [20.0, 10.0]"),
    ({"sensor": [SLICE | {"noise_per_m": 1.0}]}, "sensor[0].noise_per_m = 1.0"),
]


@pytest.mark.parametrize(("changes", "key"), REFUSED)
def test_sensors_that_cannot_measure_are_refused_in_one_line(changes, key):
    with pytest.raises(ScenarioError) as caught:
        PHANTOM.with_values(changes)
    assert str(caught.value).startswith(f"{key}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"sensor": [SLICE | {"plane_mm": 40.0}]}, "sensor[0].plane_mm"),
        ({"sensor": [POINTS | {"from_mm": 40.0, "to_mm": 50.0}]}, "sensor[0].from_mm"),
        ({"sensor": [SLICE | {"rate_hz": 0.07}]}, "sensor[0].rate_hz"),  # 68.5 mm at 5 mm/s: 13.7 s
        ({"sensor": [SLICE | {"delay_s": 13.8}]}, "sensor[0].delay_s"),
        ({"control.essential_points": True}, "control.essential_points"),
        ({"tracker.enabled": False, "sensor": [FBG]}, "control.start_axial_sd_mm"),
        (ALONE | {"sensor": [SLICE]}, "tracker.enabled"),
        (ALONE | {"sensor": [POINTS | {"from_mm": -20.0}]}, "tracker.enabled"),  # the tip starts at -28.5 mm
    ],
)
def test_settings_without_effect_have_a_line(changes, key):
    (line,) = find_doubts(PHANTOM.with_values(changes))
    assert line.startswith(f"{key} = ")


def test_points_that_begin_at_the_start_are_enough_without_a_tracker():
    assert not find_doubts(PHANTOM.with_values(ALONE | {"sensor": [POINTS | {"from_mm": -40.0}]}))


def test_a_sensor_in_time_for_one_reading_raises_no_doubt():
    assert not find_doubts(PHANTOM.with_values({"sensor": [SLICE | {"rate_hz": 0.08, "delay_s": 13.6}]}))


def test_a_fibre_alone_needs_sites_no_farther_apart_than_the_needle_bends():
    thin = ALONE | {"target.depth_mm": 70.0}
    thin |= {"needle": {"outer_diameter_mm": 0.5, "youngs_modulus_gpa": 60.0, "length_mm": 150.0}}
    few = {"sensor": [{"kind": "fbg", "sites_mm": [10.0, 60.0]}]}
    (line,) = find_doubts(PHANTOM.with_values(thin | few))
    assert line.startswith("sensor[0].sites_mm: 50 mm of the inserted needle without a site")
    assert not find_doubts(
        PHANTOM.with_values(thin | {"sensor": [{"kind": "fbg", "sites_mm": [10.0, 25.0, 40.0, 55.0]}]})
    )
    assert not find_doubts(PHANTOM.with_values(thin | few | {"tracker.enabled": True}))


class Offset(Sensor):
    """The lateral position at the skin, mm."""

    noise_mm: float = 0.1

    @property
    def noise(self):
        return self.noise_mm

    def predict(self, needles, axes):
        del axes
        return needles.at(0.0)[:, [Y]]


def own(monkeypatch, **parts):
    """Return the scenario with a sensor of a kind that differs in some parts."""
    module = ModuleType("own_sensors")
    module.Kind = type("Kind", (parts.pop("base", Offset),), parts)
    monkeypatch.setitem(sys.modules, "own_sensors", module)
    return PHANTOM.with_values({"sensor": [{"kind": "own_sensors:Kind"}]})


def raising(*_):
    raise ZeroDivisionError("no needle")


WRONG = [
    ({"base": Sensor}, "noise, predict"),
    ({"base": object}, "flexneedle.Sensor"),
    ({"predict": lambda _, n, __: n.at(0.0)[:, Y]}, "predict must return an array"),
    ({"predict": lambda _, n, __: n.poses[:, :3, Y].T, "size": lambda *_: 3}, "predict must return an array"),
    ({"predict": lambda _, n, __: np.full((len(n.poses), 1), np.nan)}, "finite"),
    ({"predict": raising}, "ZeroDivisionError: no needle"),
    ({"noise": property(lambda _: 0.0)}, "noise must"),
    ({"size": lambda *_: 0}, "size must"),
    ({"rolls": True}, "paired"),
    ({"model_error": lambda *_: np.array([-1.0])}, "model_error must"),
    (
        {"sees": lambda _, n, __: np.ones(len(n.poses), dtype=bool)},
        "`sees` must return flags of the shape (21, 1)",
    ),
    ({"sees": lambda _, n, __: np.full((len(n.poses), 1), 0.5)}, "not float64"),
    ({"predict": lambda _, n, __: np.negative(n.poses, out=n.poses)[:, -1, [Y]]}, "must not be changed"),
]


@pytest.mark.parametrize(("parts", "rule"), WRONG)
def test_a_wrong_kind_is_refused_in_one_line(monkeypatch, parts, rule):
    with pytest.raises(ScenarioError) as caught:
        own(monkeypatch, **parts)
    assert str(caught.value).startswith('sensor[0].kind = "own_sensors:Kind": ')
    assert rule in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_kind_of_two_definitions_has_its_name(monkeypatch):
    (sensor,) = own(monkeypatch).sensor
    assert (sensor.title, sensor.size(2), sensor.rate_hz) == ("Kind", 1, 20.0)


def test_values_that_break_a_rule_during_an_insertion_name_the_sensor(monkeypatch):
    part = {"predict": lambda _, n, __: np.where(n.poses[:, :1, 0] < 0.0, 1.0, np.inf)}
    (sensor,), needles = own(monkeypatch, **part).sensor, Needles(np.zeros((1, 3, 5)), 1.0)
    with pytest.raises(DriverError, match=r"sensor Kind: .*finite"):
        predict_values(sensor, needles, 1)
    with pytest.raises(DriverError, match=r"sensor Kind: .*2 rows"):
        read_values(sensor, Reading(0.0, ((1.0,), (2.0,))), needles, 1)


def test_poses_at_a_depth_are_on_the_needle_and_straight_beyond_it():
    poses = np.zeros((2, 3, 5))
    poses[..., 0] = [[-10.0, 0.0, 10.0], [-20.0, -10.0, 0.0]]
    poses[..., 1] = 0.1 * poses[..., 0]
    found = Needles(poses, 10.0).at(5.0)
    np.testing.assert_allclose(found[:, :2], [[5.0, 0.5], [5.0, 0.5]])
    each = Needles(poses, 10.0).at(np.array([-5.0, 5.0]))
    np.testing.assert_allclose(each[:, :2], [[-5.0, -0.5], [5.0, 0.5]])
