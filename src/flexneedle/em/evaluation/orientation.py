"""Jitter of the orientation, from summed products of unit quaternions: q and −q are the same rotation and add alike.

The mean of quaternions q_j is the eigenvector m of A = Σ q_j q_jᵀ / n with the largest eigenvalue λ (Markley, Cheng,
Crassidis and Oshman 2007). The angle φ_j between q_j and m has cos(φ_j / 2) = |q_j · m|, so that 1 − λ is the mean of
sin²(φ_j / 2): 2 arcsin √(1 − λ) is the RMS angle, but for terms of fourth order.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.em.table.grid import Grid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Orientation:
    """RMS angle (degrees) of single samples from the mean orientation at their grid point, over all samples.

    axis_jitter_deg: of the sensor's z axis alone, the needle's, about which a 5-DOF sensor measures no rotation.
    NaN if no point has two samples.
    """

    n_samples: int
    jitter_deg: float
    worst_deg: float
    worst_at: str
    axis_jitter_deg: float


def orientation(grid: Grid) -> Orientation | None:
    """Return the jitter of the orientation, None if the table has none."""
    there = grid.points.turns > 0
    if not there.any():
        return None
    count, products = grid.points.turns[there], grid.points.products[there]
    if count.max() < 2:
        return Orientation(int(count.sum()), nan, nan, "", nan)
    squares = np.linalg.eigvalsh(products)[:, :3].sum(axis=1).clip(0.0, 1.0)  # 1 − λ, without cancelling
    worst = int(squares.argmax())
    return Orientation(
        n_samples=int(count.sum()),
        jitter_deg=_angle(float(squares @ count / count.sum())),
        worst_deg=_angle(float(squares[worst])),
        worst_at=grid.names[int(np.flatnonzero(there)[worst])],
        axis_jitter_deg=_angle(float(_off_axis(products) @ count / count.sum())),
    )


def _angle(square: float) -> float:
    """From the mean of sin²(φ/2) to the angle in degrees."""
    return float(np.degrees(2.0 * np.arcsin(np.sqrt(square))))


def _off_axis(a: Floats) -> Floats:
    """Return the mean of sin²(φ/2) of the angles of the z axes from their mean direction, from A (n, 4, 4).

    The z axis of q is (2(xz + wy), 2(yz − wx), 1 − 2(x² + y²)), linear in the products; the mean of n unit vectors
    has the length ⟨cos φ⟩ along its own direction.
    """
    w, x, y, z = range(4)
    axis = np.stack(
        [
            2.0 * (a[:, x, z] + a[:, w, y]),
            2.0 * (a[:, y, z] - a[:, w, x]),
            1.0 - 2.0 * (a[:, x, x] + a[:, y, y]),
        ],
        axis=1,
    )
    half: Floats = ((1.0 - np.linalg.norm(axis, axis=1)) / 2.0).clip(0.0, 1.0)
    return half
