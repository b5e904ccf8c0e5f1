"""Surfaces of zones: their points, volumes and directions, against closed forms."""

import numpy as np
import pytest

from flexneedle.simulator.surfaces import surface_net, zone_surface
from flexneedle.simulator.zones import zones_of
from zoned import BOX, CAPSULE, HALF_SPACE, SPHERE, grid_files, with_zones

LOW, HIGH = np.array([0.0, -25.0, -25.0]), np.array([60.0, 25.0, 25.0])


def volume(surface):
    """Return the volume (mm³) inside a closed surface, positive if its triangles are counterclockwise from outside."""
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def is_closed(surface):
    """Return whether each edge has one triangle to each side."""
    pairs = np.concatenate([surface.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = {tuple(pair) for pair in pairs.tolist()}
    return len(edges) == len(pairs) and all((b, a) in edges for a, b in edges)


def test_the_net_of_a_ball_is_closed_and_near_it():
    grid = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), axis=-1)
    found = surface_net(np.linalg.norm(grid - 12.2, axis=-1) - 8.0)
    assert is_closed(found)
    np.testing.assert_allclose(np.linalg.norm(found.points - 12.2, axis=1), 8.0, atol=0.1)
    assert volume(found) == pytest.approx(4.0 / 3.0 * np.pi * 8.0**3, rel=0.02)


LENGTH = float(np.linalg.norm(np.subtract(CAPSULE["to_mm"], CAPSULE["from_mm"])))
R = CAPSULE["radius_mm"]


@pytest.mark.parametrize(
    ("zone", "distance", "expected"),
    [
        (SPHERE, 0.0, 4.0 / 3.0 * np.pi * 3.0**3),
        (SPHERE, 2.0, 4.0 / 3.0 * np.pi * 5.0**3),
        (CAPSULE, 0.0, np.pi * R**2 * LENGTH + 4.0 / 3.0 * np.pi * R**3),
        (BOX, 0.0, 3.0 * 6.0 * 10.0),
    ],
)
def test_the_surface_of_a_zone_encloses_its_volume(zone, distance, expected):
    found = zone_surface(zones_of(with_zones("phantom3d", zone)), 0, LOW, HIGH, distance)
    assert is_closed(found)
    assert len(found.triangles) < 12_000
    assert volume(found) == pytest.approx(expected, rel=0.1)  # nets round off the edges of boxes


def test_a_half_space_ends_at_the_corners():
    """The part of the box from x = 48 mm + y / 10 to 60 mm."""
    found = zone_surface(zones_of(with_zones("phantom3d", HALF_SPACE)), 0, LOW, HIGH)
    assert is_closed(found)
    assert volume(found) == pytest.approx(12.0 * 50.0 * 50.0, rel=0.02)


def test_the_surface_of_a_file_is_from_its_grid(tmp_path):
    """A torus of volume 2π² R r²."""
    with grid_files(tmp_path) as ring:
        found = zone_surface(zones_of(with_zones("phantom3d", ring)), 0, LOW, HIGH)
    assert is_closed(found)
    assert volume(found) == pytest.approx(2.0 * np.pi**2 * 6.0 * 2.0**2, rel=0.06)


def test_a_zone_out_of_reach_has_an_empty_surface():
    far = {**SPHERE, "center_mm": [25.0, 90.0, 0.0]}
    assert len(zone_surface(zones_of(with_zones("phantom3d", far)), 0, LOW, HIGH).triangles) == 0
