"""Triangles of tubes and of fields' surfaces, against closed forms and trimesh."""

import numpy as np
import pytest
from trimesh import Trimesh

from flexneedle.lab.images.surfaces import find_surface, make_tube


def as_trimesh(mesh):
    return Trimesh(mesh.points, mesh.triangles, process=False)


def test_a_tube_is_closed_and_has_its_volume():
    """A polygon of 16 sides has 0.974 of the circle's area; a gentle bend changes little."""
    x = np.linspace(0.0, 60.0, 61)
    line = np.column_stack([x, 0.001 * x**2, -0.0005 * x**2])
    tube = as_trimesh(make_tube(line, 0.4))
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert tube.is_watertight
    assert tube.is_winding_consistent
    assert tube.volume == pytest.approx(0.974 * np.pi * 0.4**2 * length, rel=0.01)
    apart = np.linalg.norm(tube.vertices[:, None] - line[None], axis=2).min(axis=1)
    assert apart.max() == pytest.approx(0.4, abs=1e-9)


def field(low, spacing, shape):
    axes = [low[k] + spacing * np.arange(shape[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def test_the_surface_of_a_sphere():
    low, spacing = np.array([-10.0, -9.0, -8.0]), 0.5
    points = field(low, spacing, (41, 37, 33))
    found = find_surface(np.linalg.norm(points, axis=-1) - 6.0, low, spacing)
    mesh = as_trimesh(found)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * 6.0**3, rel=0.01)
    assert np.abs(np.linalg.norm(found.points, axis=1) - 6.0).max() < 0.1


def test_a_half_space_is_closed_at_the_faces_of_the_grid():
    low, spacing = np.zeros(3), 1.0
    points = field(low, spacing, (11, 11, 11))
    mesh = as_trimesh(find_surface(points[..., 0] - 5.2, low, spacing))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(5.2 * 10.0 * 10.0, rel=0.05)
    assert find_surface(points[..., 0] + 1.0, low, spacing) is None
