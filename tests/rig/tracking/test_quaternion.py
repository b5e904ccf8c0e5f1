"""Turns: against rotation matrices, and there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.rig.tracking.quaternion import along, from_matrix, from_vector, product, z_axis

VECTORS = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def matrix(turn):
    return Rotation.from_quat(turn, scalar_first=True).as_matrix()


@given(vector=VECTORS)
@hypothesis_settings(deadline=None, derandomize=True)
def test_a_turn_about_a_vector_is_the_matrix_of_it(vector):
    turn = from_vector(vector[None])[0]
    np.testing.assert_allclose(matrix(turn), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(z_axis(turn), matrix(turn)[:, 2], atol=1e-12)


@given(first=VECTORS, second=VECTORS)
@hypothesis_settings(deadline=None, derandomize=True)
def test_a_product_turns_by_the_second_first(first, second):
    turns = from_vector(np.stack([first, second]))
    both = product(turns[0], turns[1])
    np.testing.assert_allclose(matrix(both), matrix(turns[0]) @ matrix(turns[1]), atol=1e-12)
    np.testing.assert_allclose(product(turns, turns[::-1])[0], both, atol=1e-15)


@given(vector=VECTORS)
@hypothesis_settings(deadline=None, derandomize=True)
def test_a_matrix_gives_its_turn_back(vector):
    rotation = Rotation.from_rotvec(vector).as_matrix()
    turn = from_matrix(rotation)
    assert turn[0] >= 0.0
    np.testing.assert_allclose(matrix(turn), rotation, atol=1e-12)


@given(vector=VECTORS)
@hypothesis_settings(deadline=None, derandomize=True)
def test_the_shortest_turn_to_a_direction_gets_there_without_a_roll(vector):
    direction = from_vector(vector[None])[0, 1:] + [0.0, 0.0, 1e-3]
    direction = direction / np.linalg.norm(direction)
    turn = along(direction)
    np.testing.assert_allclose(np.linalg.norm(turn), 1.0, atol=1e-12)
    np.testing.assert_allclose(z_axis(turn), direction, atol=1e-9)
    assert turn[3] == 0.0


def test_half_a_turn_where_no_turn_is_shortest():
    both = along(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(both, [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(z_axis(both)[0], [0.0, 0.0, -1.0], atol=1e-15)
    assert z_axis(both[0])[2] == pytest.approx(-1.0)
