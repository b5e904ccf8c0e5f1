"""Distances from zones in files, against the nearest point of each voxel's box, and of closed forms."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trimesh import Trimesh
from trimesh.creation import capsule, icosphere

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import from_vector, to_matrix
from flexneedle.geometry.rigid import Rigid, identity
from flexneedle.lab.images import distances as made
from flexneedle.lab.images.distances import distances, error_bound
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.meshes import Mesh, write_mesh
from flexneedle.lab.images.surfaces import find_surface
from flexneedle.lab.images.volumes import write_label_map
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sections.zones import ZoneFile
from flexneedle.simulator.zone_doubts import find_zone_doubts
from flexneedle.simulator.zones import Workspace, zones_of

NEAR, FAR = 1.5, 4.0
WORKSPACE = Workspace(np.array([0.0, -20.0, -20.0]), np.array([40.0, 20.0, 20.0]), FAR, NEAR)
SIZES = st.tuples(*[st.sampled_from([0.3, 0.8, 1.0, 1.7, 5.0])] * 3)


def image(mask, sizes, vector=(0.3, -0.2, 0.5), origin=(3.0, -6.0, -5.0)):
    """A label map with one segment, turned and shifted against RAS."""
    affine = np.eye(4)
    affine[:3, :3] = to_matrix(from_vector(np.array(vector))) * sizes
    affine[:3, 3] = origin
    return LabelMap(mask[None].astype(np.uint8), affine, (Segment(0, 1, "vessel"),))


def zone(path, **values):
    return ZoneFile(shape="file", name="a zone", file=str(path), **values)


def written(tmp_path, label_map):
    path = tmp_path / "zone.seg.nrrd"
    write_label_map(label_map, path)
    return zone(path, segment="vessel")


def from_boxes(label_map, points):
    """Distances of points (p, 3), RAS, from the boxes of all voxels of a segment; 0 inside."""
    axes = label_map.affine[:3, :3]
    sizes = np.linalg.norm(axes, axis=0)
    local = (points - label_map.affine[:3, 3]) @ (axes / sizes)
    centres = np.argwhere(label_map.labels[0]) * sizes
    beyond = np.maximum(np.abs(local[:, None] - centres) - 0.5 * sizes, 0.0)
    return np.linalg.norm(beyond, axis=2).min(axis=1)


def interpolated(grid, points):
    """Values of a grid at points (p, 3), linear in each coordinate, at its edge outside."""
    at = np.clip((points - grid.first) / grid.spacing, 0.0, np.array(grid.values.shape) - 1.0)
    cell = np.minimum(at.astype(int), np.array(grid.values.shape) - 2)
    share, found = at - cell, np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, share, 1.0 - share).prod(axis=1)
        found += weight * grid.values[tuple((cell + corner).T)]
    return found


def blobs(seed, shape):
    """A random mask of a few blocks."""
    rng, mask = np.random.default_rng(seed), np.zeros(shape, bool)
    for _ in range(rng.integers(1, 6)):
        low = rng.integers(0, shape)
        high = low + rng.integers(1, 4, 3)
        mask[tuple(map(slice, low, high))] = True
    return mask


def check(grid, true, points):
    """A value is never above the true distance by more than the bound at `near` or more, nor above `near` if nearer."""
    values = interpolated(grid, points)
    away = (true >= NEAR) & (true <= FAR)
    assert (values - true)[away].max() <= grid.bound + 1e-9
    assert values[true < NEAR].max(initial=0.0) <= NEAR + grid.bound + 1e-9
    assert values[true > FAR].min(initial=FAR) >= FAR - 1.0
    return values


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), SIZES)
def test_a_value_exceeds_the_distance_from_the_boxes_of_all_voxels_by_no_more_than_the_bound(seed, sizes):
    label_map = image(blobs(seed, (9, 8, 7)), sizes)
    to_needle = Rigid(to_matrix(from_vector(np.array([0.2, 0.4, -0.3]))), np.array([10.0, 2.0, 3.0]))
    voxels = made.Voxels(label_map.labels[0], 1, made.matrix(to_needle) @ label_map.affine)
    grid = made._grid(voxels, WORKSPACE)
    assume(grid is not None)
    points = np.random.default_rng(seed).uniform(WORKSPACE.low, WORKSPACE.high, (3000, 3))
    check(grid, from_boxes(label_map, to_needle.inverse().apply(points)), points)


@pytest.mark.parametrize("sizes", [(0.8, 0.8, 0.8), (1.0, 1.0, 1.0), (0.7, 0.7, 5.0)])
def test_the_bound_is_not_far_above_the_largest_error(sizes):
    """A single voxel, along whose diagonal the error is largest."""
    label_map = image(np.pad(np.ones((1, 1, 1), bool), 2), sizes)
    voxels = made.Voxels(label_map.labels[0], 1, label_map.affine)
    grid = made._grid(voxels, WORKSPACE)
    points = np.random.default_rng(0).uniform([1.0, -8.0, -7.0], [9.0, 0.0, 1.0], (200_000, 3))
    true = from_boxes(label_map, points)
    near = (true > NEAR) & (true < NEAR + 0.2)
    errors = (interpolated(grid, points) - true)[near]
    assert 0.5 * grid.bound < errors.max() <= grid.bound
    assert -0.1 < np.median(errors) < 0.25


def test_a_large_voxel_is_divided_and_small_ones_are_joined():
    """Slices 5 mm apart have the bound of cubes; voxels so small that too many would remain are joined."""
    mask = np.ones((10, 10, 4), bool)
    thick = made._grid(made.Voxels(mask, 1, image(mask, (0.5, 0.5, 5.0)).affine), WORKSPACE)
    cubes = np.ones((10, 10, 40), bool)
    equal = made._grid(made.Voxels(cubes, 1, image(cubes, (0.5, 0.5, 0.5)).affine), WORKSPACE)
    assert thick.bound == pytest.approx(equal.bound)
    fine, sizes = np.zeros((400, 400, 400), bool), np.full(3, 0.1)
    fine[3, 5, 7] = True
    joined, affine, edges = made._resample(fine, np.diag([0.1, 0.1, 0.1, 1.0]), sizes, FAR)
    np.testing.assert_allclose(edges, 0.5)
    (at,) = np.argwhere(joined)
    # The voxel is in its box.
    np.testing.assert_array_less(np.abs(affine[:3, :3] @ at + affine[:3, 3] - [0.3, 0.5, 0.7]), 0.2001)


@pytest.mark.parametrize("near", [0.5, 1.0, 3.0])
def test_the_bound_falls_with_the_distance_and_the_distance_that_it_makes_rises(near):
    sizes = np.array([1.0, 1.0, 2.0])
    one, further = (error_bound(sizes, 0.5, each) for each in (near, near + 0.1))
    assert further < one < further + 0.1
    # h = 1: a corner's neighbour is half a diagonal from its centre, less half an edge.
    assert error_bound(np.ones(3), 1e-9, 1e9) == pytest.approx(0.5 * 3.0**0.5 - 0.5, abs=1e-6)


def test_a_sphere_as_a_label_map_in_the_frame_of_a_file(tmp_path):
    centre, radius = np.array([15.0, 3.0, -2.0]), 5.0
    sizes = np.array([0.8, 0.8, 1.25])
    axes = np.indices((80, 80, 60)).reshape(3, -1).T * sizes - [20.0, 30.0, 30.0]
    mask = (np.linalg.norm(axes - centre, axis=1) <= radius).reshape(80, 80, 60)
    label_map = image(mask, sizes, (0.0, 0.0, 0.0), (-20.0, -30.0, -30.0))
    grid = distances(written(tmp_path, label_map), identity(), WORKSPACE).grid
    points = np.random.default_rng(1).uniform(WORKSPACE.low, WORKSPACE.high, (20_000, 3))
    true = np.linalg.norm(points - centre, axis=1) - radius
    near = np.abs(true) < 3.0
    assert np.abs(interpolated(grid, points) - true)[near].max() < 0.9  # a diagonal of a voxel: 1.7
    assert np.abs(np.mean((interpolated(grid, points) - true)[near])) < 0.25


def test_what_is_out_of_reach_has_no_grid_and_what_the_workspace_cuts_goes_on_behind_it(tmp_path):
    mask = np.ones((10, 10, 10), bool)
    far = image(mask, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (100.0, 0.0, 0.0))
    assert distances(written(tmp_path, far), identity(), WORKSPACE).grid is None
    before = image(mask, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (-20.0, 0.0, 0.0))
    assert distances(written(tmp_path, before), identity(), WORKSPACE).grid is None
    across = image(mask, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (10.0, 15.0, 0.0))  # y from 14.5 to 24.5
    grid = distances(written(tmp_path, across), identity(), WORKSPACE).grid
    points = np.random.default_rng(2).uniform([10.0, 20.0, 0.0], [19.0, 24.0, 9.0], (500, 3))
    assert (interpolated(grid, points) < 0.5).all()


def test_no_more_than_a_million_cells(tmp_path):
    mask = np.zeros((60, 60, 60), bool)
    mask[::59, ::59, ::59] = True
    wide = image(mask, (2.0, 2.0, 2.0), (0.0, 0.0, 0.0), (0.0, -60.0, -60.0))
    workspace = Workspace(np.array([0.0, -60.0, -60.0]), np.array([120.0, 60.0, 60.0]), FAR, NEAR)
    grid = distances(written(tmp_path, wide), identity(), workspace).grid
    assert 0.9e6 < np.prod(np.array(grid.values.shape) - 1) <= 1e6
    assert 1.0 < grid.spacing < 1.5


def from_sphere(points):
    return np.linalg.norm(points, axis=1) - 6.0


def from_capsule(points):
    """Its line is from −8 to 8 along z."""
    line = np.clip(points[:, 2], -8.0, 8.0)[:, None] * [0.0, 0.0, 1.0]
    return np.linalg.norm(points - line, axis=1) - 2.0


@pytest.mark.parametrize(
    ("shape", "true"),
    [
        (icosphere(subdivisions=4, radius=6.0), from_sphere),
        (capsule(height=16.0, radius=2.0, count=[64, 64]), from_capsule),
    ],
)
def test_a_closed_surface(tmp_path, shape, true):
    """Its triangles are up to 0.02 mm inside of the round shape."""
    vertices = np.asarray(shape.vertices) - shape.bounds.mean(axis=0)
    turned = Rigid(to_matrix(from_vector(np.ones(3))), np.array([18.0, 1.0, 2.0]))
    write_mesh(Mesh(vertices, np.asarray(shape.faces)), tmp_path / "zone.stl")
    grid = distances(zone(tmp_path / "zone.stl"), turned, WORKSPACE).grid
    points = np.random.default_rng(3).uniform(WORKSPACE.low, WORKSPACE.high, (30_000, 3))
    expected = true(turned.inverse().apply(points))
    values = check(grid, expected + 0.02, points)
    near = np.abs(expected) < 3.0
    assert (values - expected)[near].min() > -1.1  # a diagonal of a voxel, and of the grid near a surface
    assert values[expected < -1.0].max() < -0.5


def test_a_surface_whose_file_names_no_frame_is_in_the_frame_of_the_zone(tmp_path):
    ball = icosphere(subdivisions=2, radius=5.0)
    ball.apply_translation([12.0, 3.0, 0.0])
    ball.export(tmp_path / "ball.stl")
    half_turn = Rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    for frame, to_needle in (("RAS", identity()), ("LPS", half_turn)):
        grid = distances(zone(tmp_path / "ball.stl", frame=frame), to_needle, WORKSPACE).grid
        assert interpolated(grid, np.array([[12.0, 3.0, 0.0]]))[0] < -3.0


def test_a_surface_of_two_blocks_that_touch_at_an_edge_is_closed(tmp_path):
    """Their common edge has four triangles."""
    field = np.ones((24, 24, 12))
    field[4:12, 4:12, 2:10] = field[12:20, 12:20, 2:10] = -1.0
    surface = find_surface(field, np.array([2.0, -12.0, -6.0]), 1.0)
    assert not Trimesh(surface.points, surface.triangles).is_watertight
    write_mesh(surface, tmp_path / "blocks.ply")
    grid = distances(zone(tmp_path / "blocks.ply"), identity(), WORKSPACE).grid
    points = np.array([[10.0, -4.0, 0.0], [18.0, 4.0, 0.0], [10.0, 4.0, 0.0], [18.0, -4.0, 0.0]])
    assert (np.sign(interpolated(grid, points)) == [-1, -1, 1, 1]).all()


def test_files_that_cannot_be_used(tmp_path):
    mask = np.ones((4, 4, 4), bool)
    one = written(tmp_path, image(mask, (1.0, 1.0, 1.0)))
    sheared = np.eye(4)
    sheared[0, 1] = 0.2
    written_sheared = LabelMap(mask[None].astype(np.uint8), sheared, (Segment(0, 1, "vessel"),))
    write_label_map(written_sheared, tmp_path / "sheared.seg.nrrd")
    empty = LabelMap(mask[None].astype(np.uint8), np.eye(4), (Segment(0, 2, "vessel"),))
    write_label_map(empty, tmp_path / "empty.seg.nrrd")
    hole = icosphere(subdivisions=1, radius=6.0)
    write_mesh(Mesh(np.asarray(hole.vertices), np.asarray(hole.faces)[1:]), tmp_path / "open.stl")
    cases = [
        (zone(tmp_path / "sheared.seg.nrrd", segment="vessel"), "78.69: must be 90 degrees"),
        (zone(tmp_path / "empty.seg.nrrd", segment="vessel"), "vessel: has no voxels"),
        (zone(one.file, label=3), "label 3: has no voxels"),
        (zone(one.file, segment="artery"), r"no such segment \(segments: vessel\)"),
        (zone(one.file), r"name one with segment \(segments: vessel\)"),
        (zone(tmp_path / "open.stl"), "the surface is not closed"),
        (zone(tmp_path / "open.stl", segment="vessel"), "neither segment nor label"),
        (zone(one.file, segment="vessel", frame="LPS"), "frame = 'LPS': leave it out: "),
        (zone(tmp_path / "none.seg.nrrd", segment="vessel"), "none.seg.nrrd: cannot be read: No such file"),
    ]
    for each, message in cases:
        with pytest.raises(InputError, match=message) as error:
            distances(each, identity(), WORKSPACE)
        assert str(error.value).startswith("zone a zone: ")
        assert "\n" not in str(error.value)


def test_a_zone_of_a_scenario(tmp_path):
    """Through the entry point of the package: the clearance of the needle's surface from a block is a bound."""
    mask = np.ones((8, 8, 8), bool)
    block = written(tmp_path, image(mask, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (20.5, 6.5, -3.5)))  # y > 6
    scenario = load_scenario("phantom3d").with_values(
        {"zone": [block.model_dump(exclude_none=True)], "image.sd_mm": 0.5, "zones.margin_mm": 2.0}
    )
    zones = zones_of(scenario)
    points = np.column_stack([np.linspace(21.0, 27.0, 50), np.full(50, 2.5), np.zeros(50)])
    found = zones.clearances(points)[0]
    radius, always = 0.5 * scenario.needle.outer_diameter, 1.0
    bound = zones.added[0] - always
    assert (found <= 3.5 - radius - always).all()
    assert (found >= 3.5 - radius - always - bound - 0.1).all()
    assert 0.0 < bound < 0.6


def test_an_image_that_ends_within_the_reach_of_the_needle(tmp_path):
    """5 mm beside the straight way, of a reach of 10 mm: a segment of a circle, (θ − sin θ)/2π with θ = 2π/3."""
    mask = np.zeros((100, 100, 100), bool)
    mask[60, 30, 50] = True
    around = image(mask, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (-9.5, -94.5, -49.5))
    scenario = load_scenario("phantom3d").with_values(
        {
            "zone": [written(tmp_path, around).model_dump(exclude_none=True)],
            "target.depth_mm": 60.0,
            "target.lateral_mm": 0.0,
            "target.lateral_z_mm": 0.0,
        }
    )
    (line,) = find_zone_doubts(scenario)
    assert "ends up to 5.0 mm before the end of the needle's reach, 20 % of which" in line
    assert find_zone_doubts(scenario.with_values({"entry.lateral_mm": -6.0, "target.lateral_mm": -6.0})) == []
