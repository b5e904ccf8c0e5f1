"""Clearance of rollouts from zones, against distances by hand at the poses of the needle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from flexneedle.mechanics import zones as made
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DG_Y
from reference.interpreted import interpreted

PLAIN = interpreted(made)
POINTS = np.random.default_rng(0).uniform(-12.0, 12.0, (400, 3))
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


def distances(zone, points):
    """Distances of points (p, 3) from a zone, by the kernel's formula in Python."""
    packed = made.pack([zone], 100.0)
    distance = PLAIN.distance_from
    return np.array([distance(packed.rows[0], packed.fields, *point) for point in points.tolist()])


def nearest(surface, points):
    """Distances of points (p, 3) from the nearest of many points of a surface (s, 3)."""
    return np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)


def on_sphere(count):
    """Return points (count, 3) spread evenly on the unit sphere."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def test_a_sphere_and_a_half_space():
    centre, normal = np.array([1.0, -2.0, 3.0]), np.array([1.0, 2.0, -2.0])
    np.testing.assert_allclose(
        distances(made.capsule(centre, centre, 4.0), POINTS), np.linalg.norm(POINTS - centre, axis=1) - 4.0
    )
    np.testing.assert_allclose(
        distances(made.half_space(centre, normal), POINTS), (POINTS - centre) @ normal / 3.0, atol=1e-12
    )


def test_a_capsule_is_a_row_of_spheres():
    a, b = np.array([-5.0, 1.0, 0.0]), np.array([3.0, -2.0, 4.0])
    between = a + np.linspace(0.0, 1.0, 4001)[:, None] * (b - a)
    np.testing.assert_allclose(
        distances(made.capsule(a, b, 2.0), POINTS), nearest(between, POINTS) - 2.0, atol=1e-5
    )


def test_a_turned_box_with_round_edges():
    """Outside by its nearest point, inside by its nearest face."""
    centre, half = np.array([1.0, 0.0, -1.0]), np.array([4.0, 2.0, 3.0])
    local = (POINTS - centre) @ TURN.T
    outside = np.linalg.norm(local - np.clip(local, -half, half), axis=1)
    expected = np.where(outside > 0.0, outside, (np.abs(local) - half).max(axis=1)) - 0.5
    np.testing.assert_allclose(distances(made.box(centre, half, TURN, 0.5), POINTS), expected, atol=1e-12)


def test_a_grid_interpolates_in_each_cell_and_ends_at_its_edge():
    """Exact for what is linear in each coordinate."""
    axes = [np.linspace(-6.0, 6.0, count) for count in (7, 9, 13)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    zone = made.grid(1.0 + x - 2.0 * y + 0.1 * x * y * z, (-6.0, -6.0, -6.0), (2.0, 1.5, 1.0))
    inside = np.clip(POINTS, -6.0, 6.0)
    # x y z is linear in each coordinate.
    expected = 1.0 + inside[:, 0] - 2.0 * inside[:, 1] + 0.1 * inside.prod(axis=1)
    np.testing.assert_allclose(distances(zone, POINTS), expected, atol=1e-10)


ZONES = st.sampled_from(
    [
        made.capsule((0.0, 1.0, 2.0), (3.0, -4.0, 1.0), 1.5),
        made.box((1.0, 1.0, 0.0), (2.0, 1.0, 3.0), TURN, 0.2),
        made.half_space((1.0, 0.0, 2.0), (0.2, -0.5, 1.0)),
    ]
)
POINT = st.tuples(*[st.floats(-20.0, 20.0)] * 3)


@settings(deadline=None)
@given(ZONES, POINT, POINT)
def test_a_distance_changes_by_no_more_than_the_point_moves(zone, one, other):
    here, there = distances(zone, np.array([one, other]))
    assert abs(here - there) <= np.linalg.norm(np.subtract(one, other)) + 1e-9


def densely(shapes):
    """Return points (…, 300, 3) of shapes (…, n, 5), cubic between the poses."""
    x, tangent = shapes[..., 0], np.tan(shapes[..., 3:5])
    dense = np.linspace(x[..., 0], x[..., -1], 300, axis=-1)
    points = np.empty((*dense.shape, 3))
    for at in np.ndindex(x.shape[:-1]):
        points[at] = np.column_stack(
            [dense[at], CubicHermiteSpline(x[at], shapes[at][:, 1:3], tangent[at])(dense[at])]
        )
    return points


def rolled_out(name, zones, far):
    """Clearances and shapes of 12 insertions with guide motions, some as deep as the zones."""
    scenario = load_scenario(name)
    simulator = Simulator(scenario, 1, zones=made.pack(zones, far))
    rng, rows = np.random.default_rng(2), np.repeat(controls(80, db_x=0.8)[None], 12, 0)
    rows[:, 20:50, DG_Y : DG_Y + scenario.setup.axes] = rng.uniform(-0.15, 0.15, (12, 1, scenario.setup.axes))
    found = simulator.rollout(simulator.start(), rows, outputs=("clearance", "shapes"))
    return found, 0.5 * scenario.needle.outer_diameter, rows, simulator


@pytest.mark.parametrize("name", ["phantom", "phantom3d"])
def test_the_clearance_is_the_least_along_the_inserted_needle_at_each_step(name):
    """Up to the distance of the nodes, 1 mm, and of the shape's points."""
    zones = [
        made.capsule((15.0, 3.0, 1.0), (15.0, 3.0, 1.0), 1.5),
        made.capsule((8.0, -6.0, -3.0), (35.0, -4.0, 3.0), 1.0),
        made.box((25.0, 4.0, 0.0), (3.0, 1.0, 2.0), TURN),
        made.half_space((35.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ]
    found, radius, rows, simulator = rolled_out(name, zones, 5.0)
    chosen = np.s_[::3, 7::8]
    points, clearance = densely(found.shapes[chosen]), found.clearance[chosen]
    near = np.min(
        [distances(zone, points.reshape(-1, 3)).reshape(points.shape[:-1]) for zone in zones], axis=0
    )
    expected = np.minimum(np.where(points[..., 0] > 0.0, near, np.inf).min(axis=2), 5.0) - radius
    assert expected.min() < -0.1
    # At a surface a node may be half a spacing from the nearest point, seen from which the nodes are 1 mm apart.
    assert (clearance - expected).min() > -0.01
    assert (clearance - expected).max() < 0.5
    assert np.mean(clearance - expected) < 0.05
    without = Simulator(simulator.scenario, 1).rollout(simulator.start(), rows, outputs=("shapes",))
    assert without.shapes.tobytes() == found.shapes.tobytes()
    assert without.clearance.size == 0


def test_before_the_skin_and_without_zones_there_is_no_distance():
    found, radius, _, simulator = rolled_out(
        "phantom", [made.half_space((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))], 3.0
    )
    air = found.tips[:, :, 0] <= 0.0
    np.testing.assert_allclose(found.clearance[air], 3.0 - radius)
    assert (found.clearance[~air] < 0.0).all()
    none = Simulator(simulator.scenario, 1)
    assert np.isinf(
        none.rollout(none.start(), controls(3, db_x=1.0)[None], outputs=("clearance",)).clearance
    ).all()
