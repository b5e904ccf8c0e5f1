"""Frames: LPS and RAS, registrations of an image to the needle's frame, and the text printed at every import."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.errors import InputError
from flexneedle.lab.images.frames import (
    LPS,
    RAS,
    ImageRegistration,
    check_matrix,
    describe_import,
    swap_affine,
    swap_lps,
    swap_transform,
    to_ras,
)

coordinates = st.floats(-1000.0, 1000.0)
points = st.tuples(coordinates, coordinates, coordinates)
turns = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


def matrix_of(turn, translation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), translation
    return matrix


@given(points)
def test_left_and_posterior_change_their_signs(point):
    x, y, z = point
    np.testing.assert_array_equal(swap_lps(np.array([point])), [[-x, -y, z]])
    np.testing.assert_array_equal(swap_lps(swap_lps(np.array(point))), point)
    np.testing.assert_array_equal(to_ras(np.array(point), RAS), point)


@given(turns, points, points)
def test_affines_map_the_same_point_in_both_frames(turn, translation, point):
    """Voxels to LPS, then to RAS, is voxels to RAS; a map of LPS to LPS is the same map of RAS to RAS."""
    affine, start = matrix_of(turn, translation), np.array(point)
    mapped = affine[:3, :3] @ start + affine[:3, 3]
    for converted, before in ((swap_affine(affine), start), (swap_transform(affine), swap_lps(start))):
        after = converted[:3, :3] @ before + converted[:3, 3]
        np.testing.assert_allclose(after, to_ras(mapped, LPS), atol=1e-9)


@given(turns, points, points)
def test_a_registration_maps_as_its_matrix_and_back(turn, translation, point):
    """Against SciPy's rotations; directions are not translated."""
    registration, start = ImageRegistration.of_matrix(matrix_of(turn, translation)), np.array(point)
    turned = Rotation.from_rotvec(turn).apply(start)
    np.testing.assert_allclose(registration.apply(start), turned + translation, atol=1e-9)
    np.testing.assert_allclose(registration.turn(start), turned, atol=1e-9)
    np.testing.assert_allclose(registration.inverse().apply(registration.apply(start)), start, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda m: m[:3, :3].__imul__(1.01), "registration: must be a rotation, but is scaled or sheared"),
        (lambda m: m[0].__imul__(-1.0), "registration: must be a rotation, but is mirrored"),
        (lambda m: m.__setitem__((0, 1), 0.001), "scaled or sheared"),
        (lambda m: m.__setitem__((0, 3), np.nan), "must be 4 × 4 finite numbers"),
        (lambda m: m.__setitem__((3, 0), 1.0), "the last row must be 0 0 0 1"),
        (lambda m: m.__setitem__((slice(3), 1), m[:3, 0]), "must have an inverse"),
    ],
)
def test_a_matrix_that_is_not_rigid_is_refused_in_one_line(change, problem):
    matrix = np.eye(4)
    change(matrix)
    with pytest.raises(InputError, match=problem) as refused:
        ImageRegistration.of_matrix(matrix)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("matrix", [np.eye(3), "one", None, [[1.0]] * 4])
def test_another_shape_is_refused(matrix):
    with pytest.raises(InputError, match="must be 4 × 4 finite numbers"):
        check_matrix("registration", matrix)


@pytest.mark.parametrize(
    "values",
    [
        {"rotation": (1.0, 0.1, 0.0, 0.0)},
        {"rotation": (1.0, 0.0, 0.0)},
        {"rotation": (np.nan, 0.0, 0.0, 0.0)},
        {"translation": (0.0, np.inf, 0.0)},
        {"translation": "0 0 0"},
        {"sd": -0.1},
        {"sd": np.nan},
        {"sd": "0.5"},
    ],
)
def test_an_invalid_registration_is_refused(values):
    with pytest.raises(InputError, match=f"^{next(iter(values))} = "):
        ImageRegistration(**values)


def test_an_import_prints_its_transform_and_the_corners():
    turned = ImageRegistration.of_matrix(matrix_of([0.0, 0.0, np.pi / 2], [10.0, 20.0, 30.0]), sd=0.5)
    text = describe_import(turned, np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]))
    assert text.splitlines() == [
        "image (RAS) to needle frame: rotation (w x y z) 0.707107 0.000000 0.000000 0.707107, translation "
        "10.00 20.00 30.00 mm, sd 0.5 mm",
        "corners of the image in the needle frame (x y z, mm):",
        "  10.00 20.00 30.00, 10.00 120.00 30.00",
    ]
