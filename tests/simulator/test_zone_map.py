"""Clearances of needles from the zones of a scenario, against distances by hand."""

from pathlib import Path

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.files import digest_of
from flexneedle.simulator.zone_doubts import find_zone_doubts
from flexneedle.simulator.zones import NO_ZONES, zones_of, zones_of_record
from zoned import BOX, CAPSULE, SPHERE, grid_files, with_zones

CENTER, RADIUS = np.array(SPHERE["center_mm"]), SPHERE["radius_mm"]
SCENARIO = with_zones("phantom3d", SPHERE)
ZONES = zones_of(SCENARIO)


def bent(spacing, base=-60.0, lateral=4.0):
    """Points (n, 3) of a needle in an arc that passes below the sphere."""
    x = np.arange(base, 40.0, spacing)
    return np.column_stack([x, lateral - 1e-3 * (x - 24.3) ** 2, 0.0 * x])


def test_distances_are_from_the_zones_of_the_scenario_without_what_is_added():
    points = np.random.default_rng(0).uniform([1.0, -20.0, -20.0], [50.0, 20.0, 20.0], (5, 40, 3))
    expected = np.linalg.norm(points - CENTER, axis=-1) - RADIUS
    np.testing.assert_allclose(ZONES.distances(points)[0], expected, atol=1e-12)
    added = ZONES.added[0] + 0.5 * SCENARIO.needle.outer_diameter
    np.testing.assert_allclose(ZONES.clearances(points)[0], expected - added, atol=1e-12)
    assert ZONES.kept[0] == pytest.approx(2.0 + added)


def test_the_clearance_of_a_shape_is_a_bound_however_far_its_nodes_are_apart():
    """The true distance is of a hundred points in each millimetre; the bound is at most a contact's sag below it."""
    dense = bent(0.01)
    true = np.linalg.norm(dense - CENTER, axis=1).min() - RADIUS - ZONES.radius
    for spacing in (0.5, 1.0, 2.5, 5.0):
        (found,) = ZONES.shape_clearances(bent(spacing)[None])
        chord = spacing**2 * 1e-3 / 4.0  # of the arc, whose second derivative is 2e-3/mm
        assert true - ZONES.added[0] - 1e-9 <= found <= true + chord


def test_a_stack_of_shapes_has_a_clearance_each_and_is_clear_before_the_skin():
    shapes = np.stack([bent(2.5), bent(2.5) - [110.0, 0.0, 0.0], bent(2.5, lateral=2.0)])
    found = ZONES.shape_clearances(shapes)
    assert found[1] == np.inf
    assert found[2] - found[0] == pytest.approx(2.0, abs=0.05)
    near = ZONES.closest(shapes)
    assert (near.zone, near.margin) == ("node", 2.0)
    assert near.clearance == found.min()
    assert np.linalg.norm(near.surface - CENTER) == pytest.approx(RADIUS, abs=1e-6)
    assert np.linalg.norm(near.surface - near.needle) == pytest.approx(
        near.clearance + ZONES.added[0] + ZONES.radius
    )
    assert ZONES.closest(shapes[1]) is None
    assert NO_ZONES.closest(shapes) is None
    assert NO_ZONES.shape_clearances(shapes).tolist() == [np.inf] * 3


def test_the_nearest_zone_is_named_with_its_own_margin(tmp_path):
    with grid_files(tmp_path) as ring:
        zones = zones_of(with_zones("phantom3d", BOX, {**ring, "margin_mm": 0.5}))
        near = zones.closest(bent(2.5, lateral=1.0))
    assert (near.zone, near.margin) == ("ring", 0.5)
    assert zones.added[1] == pytest.approx(zones.added[0] + 0.1)
    x, y, z = near.surface
    assert np.hypot(np.hypot(y, z) - 6.0, x - 30.0) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("lose", [lambda path: path.unlink(), lambda path: path.write_text("another")])
def test_of_a_record_the_zones_whose_file_is_missing_or_has_changed_are_lost_and_the_others_are_not(
    tmp_path, lose
):
    """The nearest zone is unknown then, and a needle that moves needs all zones."""
    with grid_files(tmp_path) as ring:
        path = Path(ring["file"])
        scenario = with_zones("phantom3d", {**ring, "sha256": digest_of(path)}, BOX)
        assert zones_of_record(scenario) is zones_of(scenario)
        lose(path)
        found, points = zones_of_record(scenario), bent(2.5)
        with pytest.raises(InputError, match="ring"):
            zones_of(scenario)
    assert list(found.lost) == [0]
    assert found.out_of_reach == ()
    assert (found.distances(points)[0] == np.inf).all()
    others = zones_of(with_zones("phantom3d", BOX)).distances(points)[0]
    np.testing.assert_array_equal(found.distances(points)[1], others)
    assert found.closest(points) is None


def test_zones_that_reach_above_the_skin_are_doubted():
    """Half a box of 3 by 6 mm, turned by 45°, is 4.5/√2 = 3.2 mm long."""
    box, sphere = (zone | {"center_mm": [0.5, 0.0, 0.0]} for zone in (BOX, SPHERE))
    capsule = CAPSULE | {"from_mm": [-1.0, 0.0, 0.0], "to_mm": [20.0, 0.0, 0.0]}
    found = find_zone_doubts(with_zones("phantom", box, sphere, capsule))
    assert [float(line.split(" mm above the skin")[0].split()[-1]) for line in found] == [2.7, 2.5, 2.5]
    assert find_zone_doubts(with_zones("phantom")) == []
