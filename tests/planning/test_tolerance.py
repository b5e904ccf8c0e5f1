"""Tolerances of straight paths beside zones, by geometry and by many displaced paths."""

import numpy as np
import pytest

from flexneedle.planning.tolerance import MOST_ANGLE, MOST_OFFSET_MM, find_angles, find_offsets

DEPTHS = np.linspace(0.0, 40.0, 401)
STRAIGHT = np.stack([DEPTHS, 0.0 * DEPTHS, 0.0 * DEPTHS], axis=1)[None]
NONE = np.zeros(1)
CENTRE, REACH = np.array([20.0, 6.0, 0.0]), 4.0


def from_sphere(points):
    """Distance from the margin of a sphere beside the middle of the path."""
    return np.linalg.norm(points - CENTRE, axis=-1) - REACH


def from_half_space(points):
    """Distance from the margin of all points with y > 3 mm."""
    return 3.0 - points[..., 1]


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize(("slack", "most"), [(from_sphere, 2.0), (from_half_space, 3.0)])
def test_an_offset_is_the_distance_of_the_margin_beside_the_path(slack, most, axes):
    np.testing.assert_allclose(find_offsets(STRAIGHT, slack, NONE, axes), most, atol=1e-4)


def test_an_angle_in_the_plane_ends_where_the_turned_path_touches_the_margin():
    away = np.linalg.norm(CENTRE)
    tangent = np.arctan2(6.0, 20.0) - np.arcsin(REACH / away)
    np.testing.assert_allclose(find_angles(STRAIGHT, from_sphere, NONE, 1), tangent, rtol=5e-3)
    np.testing.assert_allclose(
        find_angles(STRAIGHT, from_half_space, NONE, 1), np.arcsin(3.0 / 40.0), rtol=5e-3
    )


@pytest.mark.parametrize("slack", [from_sphere, from_half_space])
def test_in_space_an_angle_is_a_bound_that_directions_between_make_smaller(slack):
    """By no more than the distance of two directions, a fifth of the angle."""
    plane, space = (find_angles(STRAIGHT, slack, NONE, axes)[0] for axes in (1, 2))
    assert 0.8 * plane <= space <= plane + 1e-9


def test_a_zone_beyond_the_end_does_not_limit_offsets():
    """It is passed in steps of its distance from the end, until another zone is met."""

    def slack(points):
        return np.minimum(40.7 - points[..., 0], from_half_space(points))

    np.testing.assert_allclose(find_offsets(STRAIGHT, slack, NONE, 1), 3.0, atol=0.02)


def test_without_zones_the_largest_that_are_tried_remain():
    def far(points):
        return np.full(points.shape[:-1], np.inf)

    assert find_offsets(STRAIGHT, far, NONE, 2) == MOST_OFFSET_MM
    assert find_angles(STRAIGHT, far, NONE, 2) == MOST_ANGLE


def test_what_a_path_lacks_is_taken_off_and_a_path_in_a_margin_has_no_tolerance():
    np.testing.assert_allclose(find_offsets(STRAIGHT, from_sphere, NONE + 0.5, 1), 1.5, atol=1e-4)
    assert find_offsets(STRAIGHT, from_sphere, NONE + 2.5, 2) == 0.0
    assert find_angles(STRAIGHT, from_sphere, NONE + 2.5, 2) == 0.0


def test_no_smaller_displacement_enters_a_margin():
    """Curved paths between spheres: none of many random displacements and turns within the tolerance does."""
    rng = np.random.default_rng(0)
    bend = rng.uniform(-2e-3, 2e-3, (30, 2, 1))
    paths = np.concatenate([np.broadcast_to(DEPTHS, (30, 1, 401)), bend * DEPTHS**2], axis=1).swapaxes(1, 2)
    centres = np.array([[10.0, 6.0, 2.0], [25.0, -5.0, 5.0], [38.0, 2.0, -7.0], [48.0, 0.0, 0.0]])

    def slack(points):
        return np.linalg.norm(points[..., None, :] - centres, axis=-1).min(axis=-1) - 3.0

    none = np.zeros(30)
    offsets, angles = find_offsets(paths, slack, none, 2), find_angles(paths, slack, none, 2)
    assert (offsets > 0.0).sum() > 20
    for _ in range(200):
        direction = rng.uniform(0.0, 2.0 * np.pi)
        across, share = np.array([0.0, np.cos(direction), np.sin(direction)]), np.sqrt(rng.uniform())
        moved = paths + share * offsets[:, None, None] * across
        assert (slack(moved).min(axis=1)[offsets > 0.0] >= 0.0).all()
        turned = paths @ turn(across, share * angles).swapaxes(1, 2)
        assert (slack(turned).min(axis=1)[angles > 0.0] >= 0.0).all()


def turn(across, angles):
    """Rotations (N, 3, 3) of x towards a direction across it."""
    x, up = np.array([1.0, 0.0, 0.0]), np.cross([1.0, 0.0, 0.0], across)
    frame = np.stack([x, across, up], axis=1)
    cosine, sine = np.cos(angles), np.sin(angles)
    plane = np.zeros((len(angles), 3, 3))
    plane[:, 0, 0] = plane[:, 1, 1] = cosine
    plane[:, 1, 0], plane[:, 0, 1], plane[:, 2, 2] = sine, -sine, 1.0
    return frame @ plane @ frame.T
