"""Records of zones for the ROS node, made in the process of the insertion: the node loads no model."""

from collections.abc import Iterator

import numpy as np

from flexneedle.lab.ros.records import RosClearance, RosZones, ZoneSurface
from flexneedle.results import Period
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.surfaces import zone_surface
from flexneedle.simulator.zones import ZoneMap, workspace_corners, zones_of
from flexneedle.types import Point, X, Z


def make_zones(scenario: Scenario) -> RosZones:
    """Return the surfaces of the zones of a scenario and of their margins, as far as the needle may reach."""
    return RosZones(tuple(_surfaces(scenario, zones_of(scenario))))


def _surfaces(scenario: Scenario, zones: ZoneMap) -> Iterator[ZoneSurface]:
    low, high = map(np.array, workspace_corners(scenario))
    for number, name in enumerate(zones.names):
        for is_margin in (False, True):
            found = zone_surface(zones, number, low, high, float(zones.kept[number]) if is_margin else 0.0)
            yield ZoneSurface(name, is_margin, found.points[found.triangles].reshape(-1, 3))


def make_clearance(zones: ZoneMap, period: Period) -> RosClearance | None:
    """Return the least clearance of the estimated needle of a period; None before the skin and without zones."""
    near = zones.closest(period.shape, period.clearance)
    if near is None:
        return None
    return RosClearance(period.time, near.zone, near.clearance, _point(near.needle), _point(near.surface))


def _point(place: np.ndarray) -> Point:
    x, y, z = map(float, place[X : Z + 1])
    return x, y, z
