"""Zones in the reports of the page's worker."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.lab.page.protocol import describe_scene
from flexneedle.lab.page.shape_frames import ShapeFrame
from flexneedle.lab.page.worker.plan_jobs import needle, plan
from flexneedle.lab.page.worker.recordings import describe_recording
from flexneedle.lab.page.worker.zones import describe_zones, find_nearest
from flexneedle.simulator.zones import NO_ZONES, zones_of
from page_tasks import done, short, task
from synthetic import make_insertion
from zoned import PRIMITIVES, SPHERE, grid_files, with_zones

CENTER = np.array(SPHERE["center_mm"])


def test_the_scene_has_the_places_that_move_with_each_zone(tmp_path):
    with grid_files(tmp_path) as ring:
        places = describe_scene(with_zones("phantom", *PRIMITIVES, ring), 1).zones
    assert [list(each) for each in places] == [
        ["zone.0.center_mm"],
        ["zone.1.from_mm", "zone.1.to_mm"],
        ["zone.2.center_mm"],
        ["zone.3.point_mm"],
        [],
    ]
    assert places[0]["zone.0.center_mm"] == tuple(CENTER)


def test_a_zone_has_its_surface_and_the_one_of_its_margin():
    scenario = with_zones("phantom3d", SPHERE)
    (zone,) = describe_zones(scenario, zones_of(scenario), "scene").zones
    kept = zones_of(scenario).kept[0]
    assert (zone.name, zone.margin_mm) == ("node", 2.0)
    for surface, radius in ((zone.surface, 3.0), (zone.margin, 3.0 + kept)):
        points = np.reshape(surface.points, (-1, 3))
        np.testing.assert_allclose(np.linalg.norm(points - CENTER, axis=1), radius, atol=0.05)
        assert max(surface.triangles) == len(points) - 1


def test_the_nearest_zone_is_found_over_all_shapes_in_tissue():
    zones = zones_of(with_zones("phantom", SPHERE))
    straight = np.pad(np.arange(-60.0, 41.0)[:, None], ((0, 0), (0, 4)))
    near = find_nearest(zones, [straight - [30.0, 0.0, 0.0, 0.0, 0.0], straight], np.inf)
    assert (near.zone, near.needle) == ("node", (25.0, 0.0, 0.0))
    assert near.surface == pytest.approx((25.0, 6.0, 0.0), abs=1e-3)
    assert near.clearance_mm == pytest.approx(6.0 - zones.radius - zones.added[0], abs=1e-6)
    assert find_nearest(zones, [straight[:40]], np.inf) is None
    assert find_nearest(NO_ZONES, [straight], np.inf) is None


def test_the_worker_reports_zones_of_the_scene_and_the_nearest_one_of_a_plan():
    near = {**SPHERE, "center_mm": [5.0, 6.0, 0.0]}
    scenario = with_zones(short(), near)
    (message,) = done(needle, task("needle", scenario=scenario)).of("zones")
    assert (message.of, [zone.name for zone in message.zones]) == ("scene", ["node"])
    (planned,) = done(plan, task("plan", scenario=scenario)).of("plan")
    assert planned.nearest.zone == "node"
    assert 0.0 < planned.nearest.clearance_mm < 3.0


def test_a_recording_has_zones_after_the_insertion_and_the_nearest_in_each_row():
    made = replace(make_insertion(), scenario=with_zones("phantom", SPHERE))
    reports = [
        one for one in describe_recording(made, "mine", "first", "") if not isinstance(one, ShapeFrame)
    ]
    assert [one.type for one in reports] == ["insertion", "zones", "rows"]
    rows = reports[-1].rows
    assert rows[0]["nearest"] is None  # before the skin
    assert rows[-1]["nearest"]["zone"] == "node"
    assert {each["margin_mm"] for each in rows} == {2.0}


def test_a_recording_names_a_zone_whose_file_is_missing_without_its_path():
    lost = {"name": "ring", "shape": "file", "file": "/nowhere/ring.nrrd", "segment": "ring"}
    made = replace(make_insertion(), scenario=with_zones("phantom", lost, SPHERE))
    insertion, found, rows = (
        one for one in describe_recording(made, "mine", "first", "") if not isinstance(one, ShapeFrame)
    )
    assert insertion.summary.endswith(": ring")
    assert "nowhere" not in insertion.summary
    assert [len(zone.surface.points) > 0 for zone in found.zones] == [False, True]
    assert rows.rows[-1]["nearest"] is None
