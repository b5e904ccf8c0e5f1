"""Rotations by quaternions, compared with rotation matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.geometry.quaternion import along, from_matrix, from_vector, product, z_axis

VECTORS = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def matrix(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


@given(vector=VECTORS)
def test_a_rotation_vector_gives_its_matrix(vector):
    quaternion = from_vector(vector[None])[0]
    np.testing.assert_allclose(matrix(quaternion), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(z_axis(quaternion), matrix(quaternion)[:, 2], atol=1e-12)


@given(first=VECTORS, second=VECTORS)
def test_a_product_rotates_by_the_second_first(first, second):
    rotations = from_vector(np.stack([first, second]))
    both = product(rotations[0], rotations[1])
    np.testing.assert_allclose(matrix(both), matrix(rotations[0]) @ matrix(rotations[1]), atol=1e-12)
    np.testing.assert_allclose(product(rotations, rotations[::-1])[0], both, atol=1e-15)


@given(vector=VECTORS)
def test_a_matrix_gives_its_quaternion(vector):
    rotation = Rotation.from_rotvec(vector).as_matrix()
    quaternion = from_matrix(rotation)
    assert quaternion[0] >= 0.0
    np.testing.assert_allclose(matrix(quaternion), rotation, atol=1e-12)


@given(vector=VECTORS)
def test_the_shortest_rotation_to_a_direction_has_no_roll(vector):
    direction = from_vector(vector[None])[0, 1:] + [0.0, 0.0, 1e-3]
    direction = direction / np.linalg.norm(direction)
    quaternion = along(direction)
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-12)
    np.testing.assert_allclose(z_axis(quaternion), direction, atol=1e-9)
    assert quaternion[3] == 0.0


def test_the_rotation_to_the_opposite_direction_is_half_a_turn():
    both = along(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(both, [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(z_axis(both)[0], [0.0, 0.0, -1.0], atol=1e-15)
    assert z_axis(both[0])[2] == pytest.approx(-1.0)
