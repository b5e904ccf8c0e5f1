"""Repeatability of single points in position and orientation, and errors of the distance between two points.

ASTM F2554 calls these the repeatability of the coordinates of a single point and the relative point-to-point accuracy
(linear). Neither needs a registration of tracker and stage. The values are computed from the means at grid points; the
standard also asks for several orientations of the tool and several operators.

The orientation jitter is computed from mean products of unit quaternions, in which q and −q, the same rotation, are
equal. The mean of quaternions q_j is the eigenvector m of A = Σ q_j q_jᵀ / n with the largest eigenvalue λ (Markley,
Cheng, Crassidis and Oshman 2007). The angle φ_j between q_j and m has cos(φ_j / 2) = |q_j · m|, so that 1 − λ is
the mean of sin²(φ_j / 2): 2 arcsin √(1 − λ) is the RMS angle up to terms of fourth order.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import P95, root_mean_square
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid

MOST_PAIRS = 1_000_000
"""Largest number of compared pairs of grid points (all pairs of 1414 points); of more, a sample with a fixed seed."""
_SAME_SPACING = 0.01  # neighbours: pairs up to 1 % farther apart than the closest

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Repeatability:
    """Standard deviation (mm) of single samples about the mean at their grid point, n − 1 at each point.

    axis_sd_mm: pooled, along the tracker's x, y, z; sd_mm: norm of these three. median_mm, worst_mm: over the values of
    single grid points. NaN if no point has two samples.
    """

    axis_sd_mm: tuple[float, ...]
    sd_mm: float
    median_mm: float
    worst_mm: float
    worst_at: str


@dataclass(frozen=True)
class RelativeDistance:
    """Measured minus true distance (mm) between grid points, over all pairs and over the closest neighbours.

    sampled: a random sample of the pairs was used. NaN for fewer than two points.
    """

    n_pairs: int
    sampled: bool
    mean_mm: float
    sd_mm: float
    rms_mm: float
    p95_mm: float
    max_mm: float
    neighbours_apart_mm: float
    neighbours: int
    neighbours_rms_mm: float


@dataclass(frozen=True)
class Orientation:
    """RMS angle (degrees) between single samples and the mean orientation at their grid point, over all samples.

    axis_jitter_deg: of the direction of the sensor's z axis, the needle's axis; a 5-DOF sensor does not measure the
    roll about it. NaN if no point has two samples.
    """

    n_samples: int
    jitter_deg: float
    worst_deg: float
    worst_at: str
    axis_jitter_deg: float


def compute_repeatability(grid: MeasuredGrid) -> Repeatability:
    """Return the repeatability of single points of a grid."""
    measured = grid.measured
    several = measured.count > 1
    if not several.any():
        return Repeatability((nan, nan, nan), nan, nan, nan, "")
    scatter, freedom = measured.scatter[several], measured.count[several] - 1
    axes = np.sqrt(scatter.sum(axis=0) / freedom.sum())
    deviation = np.sqrt(scatter.sum(axis=1) / freedom)
    worst = int(deviation.argmax())
    return Repeatability(
        tuple(axes.tolist()),
        float(np.linalg.norm(axes)),
        float(np.median(deviation)),
        float(deviation[worst]),
        grid.name_of(np.flatnonzero(several)[worst]),
    )


def compute_relative_distance(grid: MeasuredGrid, seed: int = 0) -> RelativeDistance:
    """Return the errors of the distances between grid points."""
    measured = grid.measured
    count = len(measured)
    first, second = _pairs(count, seed)
    if not len(first):
        return RelativeDistance(0, False, *(nan,) * 5, nan, 0, nan)
    true = np.linalg.norm(measured.true[first] - measured.true[second], axis=1)
    error = np.linalg.norm(measured.position[first] - measured.position[second], axis=1) - true
    closest = float(true[true > 0.0].min(initial=np.inf))
    neighbours = (true > 0.0) & (true <= closest * (1.0 + _SAME_SPACING))
    return RelativeDistance(
        n_pairs=len(error),
        sampled=len(error) < count * (count - 1) // 2,
        mean_mm=float(error.mean()),
        sd_mm=float(error.std(ddof=1)) if len(error) > 1 else nan,
        rms_mm=root_mean_square(error),
        p95_mm=float(np.quantile(np.abs(error), P95)),
        max_mm=float(np.abs(error).max()),
        neighbours_apart_mm=closest,
        neighbours=int(neighbours.sum()),
        neighbours_rms_mm=root_mean_square(error[neighbours]),
    )


def _pairs(count: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    if count * (count - 1) // 2 <= MOST_PAIRS:
        first, second = np.triu_indices(count, 1)
        return first, second
    rng = np.random.default_rng(seed)
    first, step = rng.integers(0, count, MOST_PAIRS), rng.integers(1, count, MOST_PAIRS)
    return first, (first + step) % count


def compute_orientation(grid: MeasuredGrid) -> Orientation | None:
    """Return the orientation jitter, None if the table has no orientations."""
    known = grid.points.orientations > 0
    if not known.any():
        return None
    count, products = grid.points.orientations[known], grid.points.products[known]
    if count.max() < 2:
        return Orientation(int(count.sum()), nan, nan, "", nan)
    squares = np.linalg.eigvalsh(products)[:, :3].sum(axis=1).clip(0.0, 1.0)  # 1 − λ, without cancellation
    worst = int(squares.argmax())
    return Orientation(
        n_samples=int(count.sum()),
        jitter_deg=_angle(float(squares @ count / count.sum())),
        worst_deg=_angle(float(squares[worst])),
        worst_at=grid.names[int(np.flatnonzero(known)[worst])],
        axis_jitter_deg=_angle(float(_off_axis(products) @ count / count.sum())),
    )


def _angle(square: float) -> float:
    """Return the angle φ (degrees) from the mean of sin²(φ/2)."""
    return float(np.degrees(2.0 * np.arcsin(np.sqrt(square))))


def _off_axis(a: Floats) -> Floats:
    """Return the mean of sin²(φ/2) of the angles φ between z axes and their mean direction, from A (n, 4, 4).

    The z axis of q is (2(xz + wy), 2(yz − wx), 1 − 2(x² + y²)), linear in the products; the mean of n unit vectors
    has the length ⟨cos φ⟩.
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
