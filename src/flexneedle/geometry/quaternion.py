"""Rotations as unit quaternions w, x, y, z: one (4,) or many (n, 4)."""

import numpy as np

from flexneedle.types import Floats

_PRODUCT = np.array(
    [
        [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, -1]],
        [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, 1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ],
    dtype=float,
)
"""Element i of a product is the sum over j, k of this times element j of the first and element k of the second."""


def product(first: Floats, second: Floats) -> Floats:
    """Return the rotation by `second`, then by `first`: (4,) or (n, 4), as both arguments."""
    rotation: Floats = np.einsum("ijk,...j,...k->...i", _PRODUCT, first, second)
    return rotation


def from_vector(vectors: Floats) -> Floats:
    """Return the rotations (n, 4) about `vectors` (n, 3) by their lengths in rad."""
    half = 0.5 * np.sqrt(np.sum(vectors**2, axis=-1, keepdims=True))
    # np.sinc is sin(πx)/(πx), smooth where the vector is zero.
    return np.concatenate((np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors), axis=-1)


def from_matrix(rotation: Floats) -> Floats:
    """Return the quaternion of a rotation matrix (3, 3), w ≥ 0.

    The eigenvector of the largest eigenvalue of a symmetric matrix (Bar-Itzhack, J. Guidance 23, 2000): without small
    divisors, and with the nearest rotation for a matrix that is not exactly orthogonal.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion: Floats = np.linalg.eigh(symmetric)[1][:, -1]
    return -quaternion if quaternion[0] < 0.0 else quaternion


def to_matrix(quaternion: Floats) -> Floats:
    """Return the rotation matrix (3, 3) of a quaternion (4,)."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def z_axis(rotations: Floats) -> Floats:
    """Return the z axis after rotations (n, 4) or (4,): unit vectors (n, 3) or (3,)."""
    w, x, y, z = rotations.T
    return np.array((2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)).T


def along(directions: Floats) -> Floats:
    """Return the shortest rotations (n, 4) or (4,) of the z axis to unit vectors (n, 3) or (3,).

    For −z, where the shortest rotation is not unique, half a turn about x.
    """
    x, y, z = directions.T
    opposite = z < -1.0 + 1e-12
    raw = np.array((np.where(opposite, 0.0, 1.0 + z), np.where(opposite, 1.0, -y), x, np.zeros_like(z)))
    rotations: Floats = (raw / np.sqrt(np.sum(raw**2, axis=0))).T
    return rotations
