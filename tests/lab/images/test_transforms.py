"""Transforms in ITK's files: the direction and the frame of 3D Slicer, and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flexneedle.errors import InputError
from flexneedle.lab.images.transforms import read_transform, write_transform

OF_SLICER = (
    "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    "Parameters: 0 1 0 -1 0 0 0 0 1 50 0 -30\nFixedParameters: -20 10 30\n"
)
"""Written by 3D Slicer 5.13 for a node with the matrix `TO_PARENT`."""
TO_PARENT = [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]


def test_the_matrix_of_a_file_is_the_one_that_3d_slicer_shows(tmp_path):
    (tmp_path / "node.tfm").write_text(OF_SLICER)
    np.testing.assert_allclose(read_transform(tmp_path / "node.tfm"), TO_PARENT, atol=1e-12)


def test_a_translation_is_stored_as_its_inverse_in_lps(tmp_path):
    """To parent (12, 14, 6) in RAS is from parent (12, 14, −6) in LPS."""
    matrix = np.eye(4)
    matrix[:3, 3] = 12, 14, 6
    write_transform(matrix, tmp_path / "node.tfm")
    (line,) = (
        line for line in (tmp_path / "node.tfm").read_text().splitlines() if line.startswith("Parameters")
    )
    assert list(map(float, line.split()[1:])) == [1, 0, 0, 0, 1, 0, 0, 0, 1, 12, 14, -6]


@given(st.integers(0, 2**32 - 1))
def test_transforms_come_back(tmp_path_factory, seed):
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("files") / "node.tfm"
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(rng=rng).as_matrix() * 1.1, rng.uniform(-500, 500, 3)
    write_transform(matrix, path)
    np.testing.assert_allclose(read_transform(path), matrix, atol=1e-9)


def test_a_matrix_without_inverse_is_not_written(tmp_path):
    with pytest.raises(InputError, match=r"transform = .*: must have an inverse"):
        write_transform(np.diag([1.0, 1.0, 0.0, 1.0]), tmp_path / "node.tfm")
    with pytest.raises(InputError, match=r"node.h5 must end in .tfm, .txt"):
        write_transform(np.eye(4), tmp_path / "node.h5")
